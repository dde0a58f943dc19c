"""The choices of a reproduction, from the command line; each takes those that it names.

Imports nothing that takes time: ``--help`` is made of them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from annotated_types import Ge, Gt

from caper_jax.errors import CaperError, unknown_name

if TYPE_CHECKING:
    from caper_jax.config import GeneratorConfig

SPLIT = "test"
Count = Annotated[int, Ge(1)]
Positive = Annotated[float, Gt(0)]


@dataclass(frozen=True)
class Options:
    """Measures what a table of the paper shows.

    Prints the paper's figures, ours, and what ours were measured on. Writes the same as markdown
    and JSON, and pictures of curves.

    Attributes:
      category: a name, several with commas, or all (default: all of the table)
      videos: per category (default: the paper's)
      frames: of each video, or of a test set of single frames (default: the paper's, or 1,000)
      mode: how generated videos move (default: paper)
      data: measure on a data set instead
      format: layout of --data, as for caper evaluate
      split: of --data (default: test)
      weights: model directory, or folder with one per category (default: the shipped ones)
      object_scale: the objects are so many times as large as those the model was trained on, e.g.
        3.7 for the laptops of PM-Videos and ArtImage (PartNet units read as meters)
      seed: of generated frames and videos
      noise: of generated depth (default: kinect)
      sweep: occlusion, noise, distance, points, mask or roll, several with commas (default: all)
      given_masks: add rows with the data's part labels
      network_alone: track without registration, as the paper does
      seeds: models to train of each variant, with the seeds 0, 1, ... (default: the study's)
      steps: of each training (default: the study's)
      preset: that all variants start from: fast, paper or ablation (default: the study's)
      initial: model that each run starts from, as for caper train (default: none)
      out: folder of results, generated videos and runs
      settings: of the runs, "section.key=value"
    """

    category: tuple[str, ...] = ()
    videos: Count | None = None
    frames: Count | None = None
    mode: Literal["paper", "cam", "hard"] | None = None
    data: Path | None = None
    format: str | None = None
    split: str | None = None
    weights: Path | None = None
    object_scale: Positive = 1.0
    seed: Annotated[int, Ge(0)] = 0
    noise: Literal["none", "gauss3mm", "kinect", "realsense"] | None = None
    sweep: tuple[str, ...] = ()
    given_masks: bool = False
    network_alone: bool = False
    seeds: Count | None = None
    steps: Count | None = None
    preset: Literal["fast", "paper", "ablation"] | None = None
    initial: Annotated[Path | None, tyro.conf.arg(name="from")] = None
    out: Path = Path("outputs") / "reproduce"
    settings: Annotated[tuple[str, ...], tyro.conf.Suppress] = ()

    def chosen(self, known: Iterable[str]) -> list[str]:
        """The categories to measure, in the order of ``known``.

        Raises:
          CaperError: one that the table does not have.
        """
        known = list(known)
        for name in self.category:
            if name not in known:
                raise unknown_name("category of this table", name, known)
        return [name for name in known if name in self.category or not self.category]

    def generator(self, config: GeneratorConfig) -> GeneratorConfig:
        """What generated frames look like: as in ``config``, with the noise of these options."""
        return config if self.noise is None else replace(config, noise=(self.noise,))

    def dataset(self) -> tuple[str, Path, str] | None:
        """(format, root, split) of the data set to measure on; None for generated data.

        Raises:
          CaperError: a format or split without data, data without a format, noise with data.
        """
        if self.data is None:
            for name in ("format", "split"):
                if getattr(self, name) is not None:
                    raise CaperError(f"--{name} goes with --data")
            return None
        if self.format is None:
            raise CaperError("--data needs --format, the layout of the data")
        if self.noise is not None:
            raise CaperError("--noise is of generated depth; leave out --data or --noise")
        return self.format, self.data, self.split or SPLIT
