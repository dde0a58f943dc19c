"""Single frames to measure on: generated ones, drawn once and kept, or those of a data set."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from caper_jax._version import __version__
from caper_jax.articulation.category import Category
from caper_jax.config import GeneratorConfig
from caper_jax.data.readers import categories_in, open_dataset
from caper_jax.data.types import Dataset
from caper_jax.reproduce.options import SPLIT, Options
from caper_jax.reproduce.videos import TEST_DATA, fingerprint, kept_file
from caper_jax.synthetic.frames import Generator, collect_frames

# As ``caper generate`` draws them: the evaluation picks from more points than the networks see.
FRAME_DATA = replace(TEST_DATA, num_points=4096, measure_visibility=True)


def open_frames(options: Options, category: Category, frames: int) -> tuple[Dataset, str] | None:
    """Frames of a category and what they are, for people; None where the data have none of it.

    Args:
      options: name the data set, or how to generate.
      category: to show.
      frames: of a generated set, where the options do not say how many.

    Raises:
      CaperError: options that contradict each other; see ``generated_frames``, ``open_dataset``.
    """
    source = options.dataset()
    if source is None:
        folder, count = options.out / "frames", options.frames or frames
        return generated_frames(folder, category, count, options.seed, options.drawn(FRAME_DATA))
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
    """Frames of test instances; those of an earlier call with the same arguments are read again.

    Args:
      folder: keeps one file per set of arguments; made if it does not exist.
      category: has procedural shapes.
      frames: how many.
      seed: of shapes and frames.
      config: what the frames look like.

    Raises:
      CaperError: see ``Generator``; a damaged file.
    """
    noise = ",".join(config.noise)
    generator = Generator(category, config, SPLIT, seed)
    attributes: dict[str, Any] = {
        "generator": __version__,
        "noise": noise,
        "seed": seed,
        "instances": config.instances,
        "grid": config.grid,
        "shapes": fingerprint(generator.bank),
    }

    def draw() -> dict[str, Any]:
        title = f"generating {category.name} frames"
        return collect_frames(generator, seed, frames, title=title)

    path = folder / f"{category.name}_{noise}_{frames}x{config.num_points}_seed{seed}.h5"
    description = (
        f"{frames} generated frames, noise {noise}, seed {seed}, of {config.instances} test "
        "instances, which training never shows"
    )
    return kept_file(path, category, attributes, draw), description
