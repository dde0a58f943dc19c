"""``caper generate``: writes synthetic labeled data to a file."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from annotated_types import Ge

from caper_jax.cli import common
from caper_jax.cli.common import Count, Settings, Size
from caper_jax.errors import CaperError

if TYPE_CHECKING:
    from caper_jax.articulation.category import Category
    from caper_jax.config import GeneratorConfig

EXAMPLES = (
    ("--category box --out box_test.h5", "1,000 frames of 100 test instances"),
    ("--category laptop --split val --frames 200 --noise none --out val.h5", "no noise"),
    ("--category laptop --videos 30 --mode cam --out videos.h5", "moving camera"),
    ("--category box --data.table 0.5 --out table.h5", "the table in half the masks"),
    ("--category box --frames 3 --images --out frames", "depth images to estimate from"),
    ("--category box --frames 50 --layout artimage --out root", "a root as of ArtImage"),
    ("--category robotarm --urdf panda.urdf --out panda.h5", "an object of your own"),
)
SECTIONS = {"data": "what the frames look like"}
POINTS, GRID = 4096, 128  # per frame, and rays per side, of a file
VIDEO_BATCH = 4
# The camera of ArtImage.
SIZE, FOCAL = 640, 914.0
# Numbers of the objects in the files, by split; far from those of PartNet.
_FIRST_OBJECT = {"train": 900000, "val": 950000, "test": 970000}
# What has no effect on other outputs than the usual file.
_UNUSED = {
    "images": ("instances", "points", "grid", "settings"),
    "layout": ("points", "grid", "settings"),
    "urdf": ("instances", "settings"),
}
_URDF_OPTIONS = ("up", "front", "rest", "parts", "scale")


@dataclass(frozen=True)
class Generate:
    """Draws labeled frames of a category from its procedural shapes and writes them to a file.

    One HDF5 file holds single frames, or videos of one object each whose joints move. Splits never
    share an instance; the same arguments give the same frames. How a URDF file is understood is
    drawn to <out>_check/NAME.png and written to NAME.txt: look at them, and correct with --up,
    --front, --rest, --parts and --scale what was not detected rightly.

    Attributes:
      category: e.g. box, or FILE.py:NAME for one of your own
      out: the file, e.g. box_test.h5 (a folder: --images, --layout)
      split: whose instances
      frames: single frames (default: 1000)
      videos: write so many videos instead of single frames
      mode: of the videos: paper (static camera, every joint opens), cam (the camera moves too),
        hard (it moves twice as fast, and the joints reverse) or still (nothing moves) (default:
        paper)
      frames_per_video: (default: 30)
      seed: of shapes and frames
      noise: of the sensor
      instances: shapes that the frames show (default: 100; --images: one per frame)
      points: per frame (default: 4096)
      grid: rays per side of the object's box in the image (default: 128)
      images: write whole images on a table instead: a folder per frame with depth.png, mask.png,
        intrinsics.json and truth.json, each of another instance
      layout: write images to a root folder in this public layout instead: --frames images, or
        --videos videos in each of which one part moves, of --instances shapes; run it again with
        another --split to add that split
      urdf: show this object instead of generated shapes: a URDF file, its folder (e.g. one of
        PartNet-Mobility), or a folder of such folders
      up: with --urdf, the file's direction that is up (canonical y), e.g. z
      front: likewise, that is canonical z, e.g. --front=-x, or three numbers 0,1,0
      rest: likewise, states of the file's joints at rest, degrees or meters: one number, or
        JOINT=NUMBER,... (a link's name stands for the joint that carries it)
      parts: likewise, LINK,...: one link of each part, in the order of the category's parts
      scale: likewise, factor for all lengths, or mean for the category's mean size (default: 1)
      overwrite: replace an existing file
      settings: of the frames, "key=value"
    """

    category: str
    out: Path
    split: Literal["train", "val", "test"] = "test"
    frames: Count | None = None
    videos: Count | None = None
    mode: Literal["paper", "cam", "hard", "still"] | None = None
    frames_per_video: Count | None = None
    seed: Size = 0
    noise: Literal["none", "gauss3mm", "kinect", "realsense"] = "kinect"
    instances: Count | None = None
    points: Annotated[int, Ge(16)] | None = None
    grid: Annotated[int, Ge(8)] | None = None
    images: bool = False
    layout: Literal["artimage", "pm-videos"] | None = None
    urdf: Path | None = None
    up: str | None = None
    front: str | None = None
    rest: str | None = None
    parts: str | None = None
    scale: str | None = None
    overwrite: bool = False
    settings: Annotated[tuple[str, ...], tyro.conf.Suppress] = ()

    @property
    def num_frames(self) -> int:
        return self.frames or 1000

    @property
    def num_instances(self) -> int:
        return self.instances or 100


def parse(argv: Sequence[str]) -> Generate:
    made, given = common.parse_with_settings(
        Generate, argv, EXAMPLES, Settings(SECTIONS, _default_sections)
    )
    settings = tuple(setting.removeprefix("data.") for setting in given)
    options = dataclasses.replace(made, settings=settings)
    _check_options(options)
    return options


def _default_sections() -> Mapping[str, Any]:
    from caper_jax.config import GeneratorConfig

    return {"data": GeneratorConfig()}


def _check_options(options: Generate) -> None:
    """Refuses, before anything is written, options that contradict each other.

    Raises:
      CaperError: names them.
    """

    def given(*names: str) -> list[str]:
        values = {name: getattr(options, name) for name in names}
        return [name for name, value in values.items() if value not in (None, False, ())]

    kinds = given("images", "layout", "urdf")
    if len(kinds) > 1:
        raise CaperError(f"--{kinds[0]} and --{kinds[1]} exclude each other")
    for kind in kinds:
        for name in given(*_UNUSED[kind]):
            name = "data.*" if name == "settings" else name
            raise CaperError(f"--{name} has no effect with --{kind}: leave it out")
    if options.videos:
        for name in given("frames", "images", "urdf"):
            raise CaperError(f"--videos and --{name} exclude each other")
    else:
        for name in given("mode", "frames_per_video"):
            raise CaperError(f"--{name.replace('_', '-')} is of videos: add --videos N")
    if options.layout and options.mode:
        raise CaperError("--layout and --mode exclude each other")
    if options.layout == "pm-videos" and not options.videos:
        raise CaperError("--layout pm-videos needs --videos, the number of videos")
    if options.layout == "artimage" and options.videos:
        raise CaperError("--layout artimage has no videos; use --frames, or --layout pm-videos")
    if options.urdf is None:
        for name in given(*_URDF_OPTIONS):
            raise CaperError(f"--{name} belongs to --urdf PATH")


def run(options: Generate) -> int:
    """Runs the command; returns its exit code."""
    if options.urdf:
        from caper_jax.cli.generate_urdf import write_urdf_frames

        write_urdf_frames(options, options.urdf)
    elif options.layout:
        _write_layout(options)
    elif options.images:
        _write_images(options)
    else:
        _write_file(options)
    return 0


def _write_images(options: Generate) -> None:
    """Rendered frames, a folder each."""
    import jax
    import numpy as np

    from caper_jax import categories
    from caper_jax.progress import progress
    from caper_jax.synthetic.images import render_image, write_frame
    from caper_jax.synthetic.instances import build_bank, draw_instances, split_key

    category = categories.get(options.category)
    common.check_folder(options.out, "--out")
    models = draw_instances(category, options.num_frames, options.split, options.seed)
    bank = build_bank(models)
    key = split_key(options.split, options.seed)
    with progress("rendering", total=options.num_frames) as bar:
        for index in range(options.num_frames):
            name = f"{category.name}_{index}"
            folder = options.out / name
            if folder.exists() and not options.overwrite:
                raise CaperError(f"{folder} exists; choose another --out or pass --overwrite")
            instance = jax.tree.map(lambda values, i=index: np.asarray(values[i]), bank)
            frame_key = jax.random.fold_in(key, index)
            image = render_image(frame_key, instance, category, options.noise)
            write_frame(folder, image, category, f"{name}_{options.split}")
            bar.update(1)
    print(f"written: {options.num_frames} frames in {options.out}")


def _write_layout(options: Generate) -> None:
    """Rendered frames or videos, a root folder in a public layout.

    Raises:
      CaperError: a root that cannot take the frames.
    """
    import jax
    import numpy as np

    from caper_jax import categories
    from caper_jax.progress import progress
    from caper_jax.synthetic.artimage_writer import LayoutWriter
    from caper_jax.synthetic.images import render_clip, render_still
    from caper_jax.synthetic.instances import build_bank, draw_instances, split_key
    from caper_jax.synthetic.videos import FRAMES as FRAMES_PER_VIDEO
    from caper_jax.synthetic.videos import check_length

    length = options.frames_per_video or FRAMES_PER_VIDEO
    check_length(length)
    category = categories.get(options.category)
    common.check_folder(options.out, "--out")
    videos = options.videos is not None
    count = options.videos or options.num_frames
    instances = min(options.num_instances, count)
    models = draw_instances(category, instances, options.split, options.seed)
    bank = build_bank(models)
    intrinsics = np.array([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]])
    writer = LayoutWriter(options.out, category, options.split, intrinsics, (SIZE, SIZE))
    first = _FIRST_OBJECT[options.split]
    for index, model in enumerate(models):
        writer.add_object(first + index, model)
    key = split_key(options.split, options.seed)
    with progress("rendering", total=count) as bar:
        for index in range(count):
            which = index % instances
            instance = jax.tree.map(lambda values, i=which: np.asarray(values[i]), bank)
            frame_key = jax.random.fold_in(key, index)
            shown = (frame_key, instance, category, options.noise, intrinsics, SIZE)
            if videos:
                moving = index % category.num_joints
                writer.add_video(first + which, render_clip(*shown, length, moving), moving + 1)
            else:
                writer.add_frame(first + which, render_still(*shown))
            bar.update(1)
    writer.close()
    kind = "videos" if videos else "frames"
    print(f"written: {count} {kind} of {instances} objects in {options.out}/{category.name}")


def _write_file(options: Generate) -> None:
    """Labeled clouds, one HDF5 file."""
    from caper_jax import __version__, categories
    from caper_jax.config import GeneratorConfig, override
    from caper_jax.data import hdf5

    category = categories.get(options.category)
    hdf5.check_writable(options.out, options.overwrite)
    config = GeneratorConfig(
        instances=options.num_instances,
        grid=options.grid or GRID,
        num_points=options.points or POINTS,
        noise=(options.noise,),
        measure_visibility=True,
    )
    config = override(config, *options.settings)
    draw = _draw_videos if options.videos else _draw_frames
    fields, attributes = draw(category, config, options)
    hdf5.write(
        options.out,
        category=category,
        split=options.split,
        **fields,
        attributes={
            "generator": __version__,
            "noise": ",".join(config.noise),
            "seed": options.seed,
            "instances": config.instances,
            "grid": config.grid,
            **attributes,
        },
        overwrite=options.overwrite,
    )
    count = f"{len(fields['points'])} frames of {config.num_points} points"
    if options.videos:
        count = f"{options.videos} videos, {count}"
    print(f"written: {options.out} ({count})")


def _draw_frames(category: Category, config: GeneratorConfig, options: Generate):
    """Single frames: what ``hdf5.write`` is to be given, and nothing more to say."""
    from caper_jax.synthetic.frames import Generator, collect_frames

    generator = Generator(category, config, options.split, options.seed)
    return collect_frames(generator, options.seed, options.num_frames), {}


def _draw_videos(category: Category, config: GeneratorConfig, options: Generate):
    """Videos one after the other: what ``hdf5.write`` is to be given, and the mode."""
    from caper_jax.synthetic.videos import FRAMES as LENGTH
    from caper_jax.synthetic.videos import VideoGenerator, collect_videos

    mode, length = options.mode or "paper", options.frames_per_video or LENGTH
    generator = VideoGenerator(category, config, mode, length, options.split, options.seed)
    count = options.videos or 1
    return collect_videos(generator, options.seed, count, VIDEO_BATCH), {"mode": mode}
