"""``caper generate``: writes synthetic labeled data to a file."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from caper_jax.cli import common, generate_layout, generate_urdf
from caper_jax.errors import CaperError, unknown_name

if TYPE_CHECKING:
    from caper_jax.articulation.category import Category
    from caper_jax.config import GeneratorConfig

DEFAULTS = {"frames": 1000, "instances": 100, "points": 4096, "grid": 128}
VIDEO_BATCH = 4
# What has no effect on other outputs than the usual file.
_UNUSED = {
    "images": ("instances", "points", "grid"),
    "layout": ("points", "grid"),
    "urdf": ("instances",),
}


def build_parser() -> argparse.ArgumentParser:
    parser = common.create_parser(
        "generate",
        "Draws labeled frames of a category from its procedural shapes and writes them to one\n"
        "HDF5 file: single frames, or videos of one object each whose joints move. Splits never\n"
        "share an instance; the same arguments give the same frames.",
        [
            ("--category box --out box_test.h5", "1,000 frames of 100 test instances"),
            ("--category laptop --split val --frames 200 --noise none --out val.h5", "no noise"),
            ("--category laptop --videos 30 --mode cam --out videos.h5", "moving camera"),
            ("--category box --frames 3 --images --out frames", "depth images to estimate from"),
            ("--category box --frames 50 --layout artimage --out root", "a root as of ArtImage"),
            ("--category robotarm --urdf panda.urdf --out panda.h5", "an object of your own"),
        ],
    )
    parser.add_argument(
        "--category", required=True, help="e.g. box, or FILE.py:NAME for one of your own"
    )
    parser.add_argument(
        "--split",
        default="test",
        choices=("train", "val", "test"),
        help="whose instances (default: %(default)s)",
    )
    parser.add_argument(
        "--frames",
        type=common.positive_int,
        help=f"single frames (default: {DEFAULTS['frames']})",
    )
    parser.add_argument(
        "--videos",
        type=common.positive_int,
        metavar="N",
        help="write N videos instead of single frames",
    )
    parser.add_argument(
        "--mode",
        help="of the videos: paper (static camera, every joint opens), cam (the camera moves too), "
        "hard (it moves twice as fast, and the joints reverse) or still (nothing moves) "
        "(default: paper)",
    )
    parser.add_argument(
        "--frames-per-video", type=common.positive_int, metavar="T", help="(default: 30)"
    )
    parser.add_argument(
        "--seed", type=common.non_negative_int, default=0, help="(default: %(default)s)"
    )
    parser.add_argument(
        "--noise",
        default="kinect",
        help="of the sensor: none, gauss3mm, kinect or realsense (default: %(default)s)",
    )
    parser.add_argument(
        "--instances",
        type=common.positive_int,
        help=f"shapes that the frames show (default: {DEFAULTS['instances']}; --images: one per "
        "frame)",
    )
    parser.add_argument(
        "--points",
        type=common.positive_int,
        help=f"per frame (default: {DEFAULTS['points']})",
    )
    parser.add_argument(
        "--grid",
        type=common.positive_int,
        help=f"rays per side of the object's box in the image (default: {DEFAULTS['grid']})",
    )
    parser.add_argument(
        "--images",
        action="store_true",
        help="write whole images on a table instead: a folder per frame with depth.png, mask.png, "
        "intrinsics.json and truth.json, each of another instance",
    )
    generate_layout.add_arguments(parser)
    generate_urdf.add_arguments(parser)
    parser.add_argument(
        "--out",
        required=True,
        type=Path,
        help="the file, e.g. box_test.h5 (a folder: --images, --layout)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing file")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    arguments = build_parser().parse_args(sys.argv[1:] if argv is None else argv)
    _check_options(arguments)
    generate_urdf.check_options(arguments)
    for option, value in DEFAULTS.items():
        if getattr(arguments, option) is None:
            setattr(arguments, option, value)
    if arguments.urdf:
        generate_urdf.write_urdf_frames(arguments)
    elif arguments.layout:
        generate_layout.write_layout(arguments)
    elif arguments.images:
        _write_images(arguments)
    else:
        _write_file(arguments)
    return 0


def _check_options(arguments: argparse.Namespace) -> None:
    """Refuses, before anything is written, options that are wrong or contradict each other.

    Raises:
      CaperError: names them.
    """
    LEAST = {"grid": 8, "points": 16}
    from caper_jax.synthetic.sensor import PRESETS

    if arguments.videos:
        for option in ("frames", "images"):
            if getattr(arguments, option):
                raise CaperError(f"--videos and --{option} exclude each other")
    else:
        for option in ("mode", "frames_per_video"):
            if getattr(arguments, option):
                raise CaperError(f"--{option.replace('_', '-')} is of videos: add --videos N")
    for kind, unused in _UNUSED.items():
        for option in unused:
            if getattr(arguments, kind) and getattr(arguments, option) is not None:
                raise CaperError(f"--{option} has no effect with --{kind}: leave it out")
    for option in LEAST:
        value = getattr(arguments, option)
        if value is not None and value < LEAST[option]:
            raise CaperError(f"--{option} must be at least {LEAST[option]}, got {value}")
    if arguments.noise not in PRESETS:
        raise unknown_name("--noise", arguments.noise, PRESETS)


def _write_images(arguments: argparse.Namespace) -> None:
    """Rendered frames, a folder each."""
    import jax
    import numpy as np

    from caper_jax import categories
    from caper_jax.progress import progress
    from caper_jax.synthetic.images import render_image, write_frame
    from caper_jax.synthetic.instances import build_bank, draw_instances, split_key

    category = categories.get(arguments.category)
    common.check_folder(arguments.out, "--out")
    models = draw_instances(category, arguments.frames, arguments.split, arguments.seed)
    bank = build_bank(models)
    key = split_key(arguments.split, arguments.seed)
    with progress("rendering", total=arguments.frames) as bar:
        for index in range(arguments.frames):
            name = f"{category.name}_{index}"
            folder = arguments.out / name
            if folder.exists() and not arguments.overwrite:
                raise CaperError(f"{folder} exists; choose another --out or pass --overwrite")
            instance = jax.tree.map(lambda values, i=index: np.asarray(values[i]), bank)
            frame_key = jax.random.fold_in(key, index)
            image = render_image(frame_key, instance, category, arguments.noise)
            write_frame(folder, image, category, f"{name}_{arguments.split}")
            bar.update(1)
    print(f"written: {arguments.frames} frames in {arguments.out}")


def _write_file(arguments: argparse.Namespace) -> None:
    """Labeled clouds, one HDF5 file."""
    from caper_jax import __version__, categories
    from caper_jax.config import GeneratorConfig
    from caper_jax.data import hdf5

    category = categories.get(arguments.category)
    hdf5.check_writable(arguments.out, arguments.overwrite)
    config = GeneratorConfig(
        instances=arguments.instances,
        grid=arguments.grid,
        num_points=arguments.points,
        noise=(arguments.noise,),
        measure_visibility=True,
    )
    draw = _draw_videos if arguments.videos else _draw_frames
    fields, attributes = draw(category, config, arguments)
    hdf5.write(
        arguments.out,
        category=category,
        split=arguments.split,
        **fields,
        attributes={
            "generator": __version__,
            "noise": arguments.noise,
            "seed": arguments.seed,
            "instances": arguments.instances,
            "grid": arguments.grid,
            **attributes,
        },
        overwrite=arguments.overwrite,
    )
    count = f"{len(fields['points'])} frames of {arguments.points} points"
    if arguments.videos:
        count = f"{arguments.videos} videos, {count}"
    print(f"written: {arguments.out} ({count})")


def _draw_frames(category: Category, config: GeneratorConfig, arguments: argparse.Namespace):
    """Single frames: what ``hdf5.write`` is to be given, and nothing more to say."""
    from caper_jax.synthetic.frames import Generator, collect_frames

    generator = Generator(category, config, arguments.split, arguments.seed)
    return collect_frames(generator, arguments.seed, arguments.frames), {}


def _draw_videos(category: Category, config: GeneratorConfig, arguments: argparse.Namespace):
    """Videos one after the other: what ``hdf5.write`` is to be given, and the mode."""
    from caper_jax.synthetic.videos import FRAMES as LENGTH
    from caper_jax.synthetic.videos import VideoGenerator, collect_videos

    mode, length = arguments.mode or "paper", arguments.frames_per_video or LENGTH
    generator = VideoGenerator(category, config, mode, length, arguments.split, arguments.seed)
    return collect_videos(generator, arguments.seed, arguments.videos, VIDEO_BATCH), {"mode": mode}
