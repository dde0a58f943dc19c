"""What a table is measured with: models, and frames or videos that are generated or read.

Generated test sets are drawn once and kept; an earlier call's with the same arguments are read.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from caper_jax import categories
from caper_jax._version import __version__
from caper_jax.articulation.category import Category
from caper_jax.config import GeneratorConfig
from caper_jax.data import hdf5
from caper_jax.data.readers import categories_in, open_dataset
from caper_jax.data.types import Dataset, Frame
from caper_jax.errors import CaperError
from caper_jax.estimator import Estimator, load, shipped_weights
from caper_jax.models.files import CARD_FILE, read_card
from caper_jax.reproduce.options import SPLIT, Options
from caper_jax.synthetic.frames import Generator, collect_frames
from caper_jax.synthetic.instances import InstanceBank
from caper_jax.synthetic.videos import MODES, VideoGenerator, collect_videos

NO_MODEL = "no model"
NO_DATA = "no data"
NUM_FRAMES = 1000  # of a generated set of single frames
# The paper's clouds have 1,024 points; its sensor noise is not stated.
VIDEO_DATA = GeneratorConfig(instances=100, grid=128, num_points=1024, noise=("kinect",))
# As ``caper generate`` draws them: the evaluation picks from more points than the networks see.
FRAME_DATA = replace(VIDEO_DATA, num_points=4096, measure_visibility=True)
_BATCH = 2  # videos drawn at a time


@dataclass(frozen=True)
class Videos:
    """Labeled videos of one category.

    Attributes:
      category: what they show.
      dataset: holds their frames.
      index: name of each video -> its frames in ``dataset``, in the order of time.
      description: one line of a report.
    """

    category: Category
    dataset: Dataset
    index: dict[str, list[int]]
    description: str

    def frames(self, name: str) -> Iterator[Frame]:
        """The frames of one video."""
        return (self.dataset[index] for index in self.index[name])


def find_model(category: str, options: Options) -> Estimator | None:
    """The model of a category; None where there is none, which is no error.

    Args:
      category: its name, or FILE.py:NAME.
      options: "weights" is a model directory, or a folder with one per category, named like it;
        None for the package's own.

    Raises:
      CaperError: unknown category, a damaged model, or a folder without any.
    """
    category, weights = categories.get(category).name, options.weights
    directory = weights
    if weights is None:
        present = (shipped_weights() / category).is_dir()
    elif (weights / CARD_FILE).is_file():
        present = read_card(weights).get("category") == category
    elif any(weights.glob(f"*/{CARD_FILE}")):
        directory = weights / category
        present = directory.is_dir()
    else:
        raise CaperError(f"--weights {weights}: neither a model directory nor a folder of them")
    return load(category, directory, options.object_scale) if present else None


def find_models(options: Options) -> dict[str, Estimator]:
    """The models of the chosen categories; of all that have one, where none is chosen.

    Raises:
      CaperError: a chosen category without a model, or no model at all.
    """
    known = {
        categories.get(name).name: find_model(name, options)
        for name in options.category or categories.names()
    }
    models = {name: model for name, model in known.items() if model is not None}
    missing = [name for name in known if name not in models]
    if not models or (options.category and missing):
        raise CaperError(
            f"there is no model of {', '.join(missing)}; train some and pass their folder as "
            "--weights"
        )
    return models


def open_frames(options: Options, category: Category) -> tuple[Dataset, str] | None:
    """Frames of a category and one line that says what they are; None where the data have none.

    Args:
      options: name the data set, or how to generate.
      category: to show.

    Raises:
      CaperError: options that contradict each other; see ``generated_frames``, ``open_dataset``.
    """
    source = options.dataset()
    if source is None:
        folder, count = options.out / "frames", options.frames or NUM_FRAMES
        config = options.generator(FRAME_DATA)
        return generated_frames(folder, category, count, options.seed, config)
    format, root, split = source
    if category.name not in categories_in(format, root):
        return None
    dataset = open_dataset(format, root, category.name, split)
    count = min(len(dataset), options.frames or len(dataset))
    return dataset, f"{count} frames of {root} ({format}, split {split})"


def generated_frames(
    folder: Path,
    category: Category,
    frames: int,
    seed: int = 0,
    config: GeneratorConfig = FRAME_DATA,
) -> tuple[Dataset, str]:
    """Frames of test instances.

    Args:
      folder: keeps one file per set of arguments; made if it does not exist.
      category: has procedural shapes.
      frames: how many.
      seed: of shapes and frames.
      config: what the frames look like.

    Raises:
      CaperError: see ``Generator``; a damaged file.
    """
    generator = Generator(category, config, SPLIT, seed)

    def draw() -> dict[str, Any]:
        title = f"generating {category.name} frames"
        return collect_frames(generator, seed, frames, title=title)

    noise = ",".join(config.noise)
    path = folder / f"{category.name}_{noise}_{frames}x{config.num_points}_seed{seed}.h5"
    description = (
        f"{frames} generated frames, noise {noise}, seed {seed}, of {config.instances} test "
        "instances, which training never shows"
    )
    return _kept(path, category, _attributes(config, seed, generator.bank), draw), description


def open_videos(
    options: Options, category: Category, videos: int, frames: int, mode: str = "paper"
) -> Videos | None:
    """The videos to measure on; None where the data set has none of this category.

    Args:
      options: name the data set, or how to generate.
      category: to show.
      videos, frames, mode: of generated videos, as far as the options do not say otherwise.

    Raises:
      CaperError: options that contradict each other; see ``generated_videos`` and
        ``dataset_videos``.
    """
    source = options.dataset()
    if source is None:
        return generated_videos(
            options.out / "videos",
            category,
            options.mode or mode,
            options.videos or videos,
            options.frames or frames,
            options.seed,
            options.generator(VIDEO_DATA),
        )
    for name in ("mode", "frames"):
        if getattr(options, name) is not None:
            raise CaperError(f"--{name} is of generated videos; leave out --data or --{name}")
    format, root, split = source
    return dataset_videos(format, root, category, split, options.videos)


def generated_videos(
    folder: Path,
    category: Category,
    mode: str,
    videos: int,
    frames: int,
    seed: int = 0,
    config: GeneratorConfig = VIDEO_DATA,
) -> Videos:
    """Videos of test instances.

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
    noise, length = ",".join(config.noise), f"{videos}x{frames}x{config.num_points}"
    path = folder / f"{category.name}_{mode}_{noise}_{length}_seed{seed}.h5"

    def draw() -> dict[str, Any]:
        title = f"generating {category.name} videos"
        return collect_videos(generator, seed, videos, _BATCH, title)

    attributes = {**_attributes(config, seed, generator.bank), "mode": mode}
    dataset = _kept(path, category, attributes, draw)
    # A given first pose of a root that never moves stays right by itself: readers must know.
    still = " (camera and root stand still)" if MODES[mode].camera_speed == 0 else ""
    return Videos(
        category,
        dataset,
        dataset.videos(),
        f"{videos} generated videos of {frames} frames, mode {mode}{still}, noise {noise}, "
        f"seed {seed}, of test instances, which training never shows",
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


def find_case(
    name: str, options: Options, videos: int, frames: int
) -> tuple[Estimator, Videos] | str:
    """The model of a category and the videos to measure it on, or why there are none.

    Args:
      name: of the category.
      options, videos, frames: see ``open_videos``.

    Raises:
      CaperError: see ``find_model`` and ``open_videos``.
    """
    estimator = find_model(name, options)
    if estimator is None:
        return NO_MODEL
    source = open_videos(options, estimator.category, videos, frames)
    return NO_DATA if source is None else (estimator, source)


def _attributes(config: GeneratorConfig, seed: int, bank: InstanceBank) -> dict[str, Any]:
    """All that decides what a generated file holds, besides what its name says."""
    return {
        "generator": __version__,
        "noise": ",".join(config.noise),
        "seed": seed,
        "instances": config.instances,
        "grid": config.grid,
        "shapes": fingerprint(bank),
    }


def _kept(
    path: Path,
    category: Category,
    attributes: dict[str, Any],
    draw: Callable[[], dict[str, Any]],
) -> hdf5.Hdf5Dataset:
    """The test set in a file with these attributes; drawn and written where there is none."""
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
    arrays: Sequence[Any] = (bank.size, bank.box_center, bank.limits, bank.joint_pivot)
    return zlib.crc32(b"".join(np.asarray(array).tobytes() for array in arrays))
