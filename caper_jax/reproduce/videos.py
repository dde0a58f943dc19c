"""Videos to measure on: generated ones, drawn once and kept, or those of a data set."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from caper_jax._version import __version__
from caper_jax.articulation.category import Category
from caper_jax.config import GeneratorConfig
from caper_jax.data import hdf5
from caper_jax.data.readers import categories_in, open_dataset
from caper_jax.data.types import Dataset, Frame
from caper_jax.errors import CaperError
from caper_jax.reproduce.options import SPLIT
from caper_jax.synthetic.instances import InstanceBank
from caper_jax.synthetic.videos import MODES, VideoGenerator, collect_videos

# The paper's clouds have 1,024 points; its sensor noise is not stated.
TEST_DATA = GeneratorConfig(instances=100, grid=128, num_points=1024, noise=("kinect",))
_BATCH = 2  # videos drawn at a time


@dataclass(frozen=True)
class Videos:
    """Labeled videos of one category.

    Attributes:
      category: what they show.
      dataset: holds their frames.
      index: name of each video -> its frames in ``dataset``, in the order of time.
      description: for people.
    """

    category: Category
    dataset: Dataset
    index: dict[str, list[int]]
    description: str

    def frames(self, name: str) -> Iterator[Frame]:
        """The frames of one video."""
        return (self.dataset[index] for index in self.index[name])


def generated_videos(
    folder: Path,
    category: Category,
    mode: str,
    videos: int,
    frames: int,
    seed: int = 0,
    config: GeneratorConfig = TEST_DATA,
) -> Videos:
    """Videos of test instances; those of an earlier call with the same arguments are read again.

    Args:
      folder: keeps one file per set of arguments; made if it does not exist.
      category: has procedural shapes.
      mode: of ``synthetic.videos.MODES``.
      videos, frames: how many, and of what length.
      seed: of shapes and videos.
      config: what the frames look like.

    Raises:
      CaperError: see ``VideoGenerator``; a damaged file.
    """
    generator = VideoGenerator(category, config, mode, frames, SPLIT, seed)
    noise = ",".join(config.noise)
    wanted: dict[str, Any] = {
        "generator": __version__,
        "noise": noise,
        "seed": seed,
        "instances": config.instances,
        "grid": config.grid,
        "mode": mode,
        "shapes": fingerprint(generator.bank),
    }
    points = config.num_points
    length = f"{videos}x{frames}x{points}"
    path = folder / f"{category.name}_{mode}_{noise}_{length}_seed{seed}.h5"

    def draw() -> dict[str, Any]:
        title = f"generating {category.name} videos"
        return collect_videos(generator, seed, videos, _BATCH, title)

    kept = kept_file(path, category, wanted, draw)
    # A given first pose of a root that never moves stays right by itself: readers must know.
    stands = " (camera and root stand still)" if MODES[mode].camera_speed == 0 else ""
    return Videos(
        category,
        kept,
        kept.videos(),
        f"{videos} generated videos of {frames} frames, mode {mode}{stands}, noise {noise}, "
        f"seed {seed}, "
        "of test instances, which training never shows",
    )


def dataset_videos(
    format: str, root: Path, category: Category, split: str | None, videos: int | None
) -> Videos | None:
    """The first videos of a data set; None where it holds none of this category.

    Args:
      format, root, split: see ``open_dataset``.
      category: to read.
      videos: at most so many.

    Raises:
      CaperError: see ``open_dataset``; data that are no videos.
    """
    if category.name not in categories_in(format, root):
        return None
    dataset = open_dataset(format, root, category.name, split)
    index: dict[str, list[int]] = getattr(dataset, "videos", dict)()
    if not index:
        raise CaperError(f"{root}: {format} holds single frames, no videos, of {category.name}")
    index = dict(list(index.items())[:videos])
    frames = sum(map(len, index.values()))
    description = f"{len(index)} videos, {frames} frames, of {root} ({format}, split {split})"
    return Videos(category, dataset, index, description)


def kept_file(
    path: Path,
    category: Category,
    attributes: dict[str, Any],
    draw: Callable[[], dict[str, Any]],
) -> hdf5.Hdf5Dataset:
    """The test set in a file with these attributes; drawn and written where there is none.

    Args:
      path: of the file; its folder is made if it does not exist.
      category: what it shows.
      attributes: all that decides what the file holds.
      draw: gives the other arguments of ``hdf5.write``.

    Raises:
      CaperError: a damaged file.
    """
    if path.is_file():
        kept = hdf5.Hdf5Dataset(path, category.name, SPLIT)
        if all(kept.attributes.get(key) == value for key, value in attributes.items()):
            return kept
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {**draw(), "category": category, "split": SPLIT, "attributes": attributes}
    hdf5.write(path, **content, overwrite=True)
    return hdf5.Hdf5Dataset(path, category.name, SPLIT)


def fingerprint(bank: InstanceBank) -> int:
    """Changes with the shapes, so that a test set of other shapes is not taken for theirs."""
    arrays = (bank.size, bank.box_center, bank.limits, bank.joint_pivot)
    return zlib.crc32(b"".join(np.asarray(array).tobytes() for array in arrays))
