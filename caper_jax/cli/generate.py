"""``caper generate``: writes synthetic labelled data to a file."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from caper_jax.cli import common
from caper_jax.errors import CaperError

BATCH = 25


def build_parser() -> argparse.ArgumentParser:
    parser = common.create_parser(
        "generate",
        "Draws labelled frames of a category from its procedural shapes and writes them to one\n"
        "HDF5 file. Splits never share an instance; the same arguments give the same frames.",
        [
            ("--category box --split test --frames 1000 --noise kinect --out box_test.h5", ""),
            ("--category laptop --split val --frames 200 --noise none --out val.h5", ""),
            ("--category box --frames 3 --images --out frames", "depth images to estimate from"),
        ],
    )
    parser.add_argument(
        "--category", required=True, help="e.g. box, or FILE.py:NAME for one of your own"
    )
    parser.add_argument("--split", default="test", choices=("train", "val", "test"))
    parser.add_argument("--frames", type=common.positive_int, default=1000)
    parser.add_argument(
        "--seed", type=common.non_negative_int, default=0, help="(default: %(default)s)"
    )
    parser.add_argument(
        "--noise", default="kinect", help="none, gauss3mm, kinect or realsense (default: kinect)"
    )
    parser.add_argument(
        "--instances", type=common.positive_int, default=100, help="shapes (default: %(default)s)"
    )
    parser.add_argument(
        "--points", type=common.positive_int, default=4096, help="per frame (default: %(default)s)"
    )
    parser.add_argument(
        "--grid", type=common.positive_int, default=128, help="rays per side (default: %(default)s)"
    )
    parser.add_argument(
        "--images",
        action="store_true",
        help="write whole images on a table instead: a folder per frame with depth.png, mask.png, "
        "intrinsics.json and truth.json, each of another instance",
    )
    parser.add_argument(
        "--out", required=True, type=Path, help="the file, e.g. box_test.h5 (a folder: --images)"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing file")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    arguments = build_parser().parse_args(sys.argv[1:] if argv is None else argv)
    if arguments.images:
        _write_images(arguments)
    else:
        _write_file(arguments)
    return 0


def _write_images(arguments: argparse.Namespace) -> None:
    """Rendered frames, a folder each."""
    import jax
    import numpy as np

    from caper_jax import categories
    from caper_jax.data.synthetic.bank import build_bank, draw_models
    from caper_jax.data.synthetic.render import render_image, write_frame
    from caper_jax.progress import progress

    category = categories.get(arguments.category)
    common.check_folder(arguments.out, "--out")
    models = draw_models(category, arguments.frames, arguments.split, arguments.seed)
    bank = build_bank(models)
    key = jax.random.key(arguments.seed)
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
    """Labelled clouds, one HDF5 file."""
    import jax
    import numpy as np

    from caper_jax import categories
    from caper_jax.data import hdf5
    from caper_jax.data.synthetic.scene import Generator, GeneratorConfig
    from caper_jax.progress import progress

    category = categories.get(arguments.category)
    hdf5.check_writable(arguments.out, arguments.overwrite)
    config = GeneratorConfig(
        instances=arguments.instances,
        grid=arguments.grid,
        num_points=arguments.points,
        noise=(arguments.noise,),
    )
    generator = Generator(category, config, arguments.split, arguments.seed)
    key = jax.random.key(arguments.seed)
    parts = []
    with progress("generating", total=arguments.frames) as bar:
        for start in range(0, arguments.frames, BATCH):
            count = min(BATCH, arguments.frames - start)
            batch = generator.batch(jax.random.fold_in(key, start), BATCH)
            parts.append(jax.tree.map(lambda array, n=count: np.asarray(array)[:n], batch))
            bar.update(count)
    batch = jax.tree.map(lambda *arrays: np.concatenate(arrays), *parts)
    names = [
        f"{category.name}_{arguments.split}{instance:04d}_{index:06d}"
        for index, instance in enumerate(batch.instance)
    ]
    hdf5.write(
        arguments.out,
        category=category,
        split=arguments.split,
        points=batch.points,
        labels=batch.labels,
        pose=batch.pose,
        visible=batch.visible,
        names=names,
        attributes={
            "noise": arguments.noise,
            "seed": arguments.seed,
            "instances": arguments.instances,
            "grid": arguments.grid,
        },
        overwrite=arguments.overwrite,
    )
    print(f"written: {arguments.out} ({arguments.frames} frames of {arguments.points} points)")
