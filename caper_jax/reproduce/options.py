"""The choices of a reproduction; each takes the options it names and leaves the others."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from caper_jax.config import GeneratorConfig, override
from caper_jax.errors import CaperError, unknown_name

SPLIT = "test"
DEFAULT_MINUTES = 60.0


@dataclass(frozen=True)
class Options:
    """Choices of one run; None stands for the reproduction's own default.

    Attributes:
      out: folder of the results; generated videos and trained runs are kept there too.
      category: a subset of the reproduction's categories; empty for all.
      videos, frames: of each category's test set, and of each of its generated videos; frames is
        the size of a test set where that is single frames.
      mode: how generated videos move, see ``synthetic.videos.MODES``.
      data, format, split: a data set to measure on instead of generated videos.
      weights: a model directory, or a folder with one per category.
      object_scale: see ``estimator.load``.
      seed: of the generated frames or videos.
      noise: of their depth, a preset of ``synthetic.sensor``.
      given_masks: add runs with the data's part labels.
      network_alone: track by the network's increment, without registration.
      seeds: runs to train of each kind.
      minutes, steps: budget of each of them; one of the two.
      initial: model directory that each starts from, see ``training.train.train``.
      overrides: KEY=VALUE, other settings of these runs.
    """

    out: Path
    category: tuple[str, ...] = ()
    videos: int | None = None
    frames: int | None = None
    mode: str | None = None
    data: Path | None = None
    format: str | None = None
    split: str | None = None
    weights: Path | None = None
    object_scale: float = 1.0
    seed: int = 0
    noise: str | None = None
    given_masks: bool = False
    network_alone: bool = False
    seeds: int = 3
    minutes: float | None = None
    steps: int | None = None
    initial: Path | None = None
    overrides: tuple[str, ...] = ()

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
        return config if self.noise is None else override(config, f"noise=['{self.noise}']")

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

    def budget(self) -> str:
        """Of each run to train, as in the name of its folder: ``3000steps`` or ``60min``.

        Raises:
          CaperError: a budget in both steps and minutes.
        """
        if self.steps is not None and self.minutes is not None:
            raise CaperError("--steps and --minutes exclude each other")
        return f"{self.steps}steps" if self.steps else f"{self.minutes or DEFAULT_MINUTES:g}min"
