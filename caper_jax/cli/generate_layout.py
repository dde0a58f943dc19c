"""``caper generate --layout``: generated images as a root folder in a public layout."""

from __future__ import annotations

import argparse

from caper_jax.cli import common
from caper_jax.errors import CaperError

LAYOUTS = ("artimage", "pm-videos")
# The camera of ArtImage.
SIZE, FOCAL = 640, 914.0
# Numbers of the objects in the files, by split; far from those of PartNet.
_FIRST_OBJECT = {"train": 900000, "val": 950000, "test": 970000}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds --layout."""
    parser.add_argument(
        "--layout",
        choices=LAYOUTS,
        help="write images to a root folder in this public layout instead: --frames images, or "
        "--videos videos in each of which one part moves, of --instances shapes; run it again with "
        "another --split to add that split",
    )


def write_layout(arguments: argparse.Namespace) -> None:
    """Writes the frames of one split.

    Args:
      arguments: those of ``caper generate``.

    Raises:
      CaperError: options of the other layout, or a root that cannot take the frames.
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

    videos = arguments.layout == "pm-videos"
    if videos and not arguments.videos:
        raise CaperError("--layout pm-videos needs --videos, the number of videos")
    if not videos and arguments.videos:
        raise CaperError("--layout artimage has no videos; use --frames, or --layout pm-videos")
    for option in ("images", "mode"):
        if getattr(arguments, option):
            raise CaperError(f"--layout and --{option} exclude each other")
    length = arguments.frames_per_video or FRAMES_PER_VIDEO
    check_length(length)
    category = categories.get(arguments.category)
    common.check_folder(arguments.out, "--out")
    count = arguments.videos if videos else arguments.frames
    instances = min(arguments.instances, count)
    models = draw_instances(category, instances, arguments.split, arguments.seed)
    bank = build_bank(models)
    intrinsics = np.array([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]])
    writer = LayoutWriter(arguments.out, category, arguments.split, intrinsics, (SIZE, SIZE))
    first = _FIRST_OBJECT[arguments.split]
    for index, model in enumerate(models):
        writer.add_object(first + index, model)
    key = split_key(arguments.split, arguments.seed)
    with progress("rendering", total=count) as bar:
        for index in range(count):
            which = index % instances
            instance = jax.tree.map(lambda values, i=which: np.asarray(values[i]), bank)
            frame_key = jax.random.fold_in(key, index)
            shown = (frame_key, instance, category, arguments.noise, intrinsics, SIZE)
            if videos:
                moving = index % category.num_joints
                writer.add_video(first + which, render_clip(*shown, length, moving), moving + 1)
            else:
                writer.add_frame(first + which, render_still(*shown))
            bar.update(1)
    writer.close()
    kind = "videos" if videos else "frames"
    print(f"written: {count} {kind} of {instances} objects in {arguments.out}/{category.name}")
