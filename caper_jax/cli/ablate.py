"""``caper ablate``: trains variants with several seeds side by side, and compares them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from caper_jax import machine
from caper_jax.cli import common
from caper_jax.cli.common import Count, Settings
from caper_jax.cli.reproduce import SECTIONS, show_report
from caper_jax.cli.train import default_sections

EXAMPLES = (
    ("--config configs/ablations/loss.toml --out outputs/loss", "nine settings of the loss"),
    ("--config ablations --category box --seeds 4", "what each idea is worth, on one category"),
    ("--config mine.toml --steps 500", "your own variants, a quick look"),
    ("--config loss --preset fast --training.batch-size 32", "the full size, larger batches"),
)


@dataclass(frozen=True)
class Ablate:
    """Compares variants of a training, each with several seeds.

    Trains all that one compiled program can hold side by side, measures every model on unseen
    frames, and compares each variant with the baseline, paired by seed: the difference, its
    confidence interval, and how many seeds it would take to see it. The same command resumes.
    Writes a table (.md), all numbers (.json, and .jsonl with a line per model), a picture of the
    intervals (.png), and the models in runs/.

    Attributes:
      config: TOML file of the study (configs/ablations has examples), or the name of one that
        ships: ablations, loss, refiner, registration, table7, table9, figure11
      out: folder of results and runs
      category: a name, several with commas, or all (default: the study's)
      seeds: models of each variant, with the seeds 0, 1, ... (default: the study's)
      steps: of each training (default: the study's)
      preset: that all variants start from (default: the study's)
      frames: unseen frames to measure on (default: the study's)
      initial: model that each training starts from, as for caper train
      settings: of all trainings, "section.key=value"
    """

    config: str
    out: Path = Path("outputs") / "ablate"
    category: tuple[str, ...] = ()
    seeds: Count | None = None
    steps: Count | None = None
    preset: Literal["fast", "paper", "ablation"] | None = None
    frames: Count | None = None
    initial: Annotated[Path | None, tyro.conf.arg(name="from")] = None
    settings: Annotated[tuple[str, ...], tyro.conf.Suppress] = ()


def parse(argv: Sequence[str]) -> Any:
    settings = Settings(SECTIONS, default_sections)
    options, given = common.parse_with_settings(Ablate, argv, EXAMPLES, settings)
    common.check_folder(options.out, "--out")
    return options, tuple(given)


def run(parsed: tuple[Ablate, tuple[str, ...]]) -> int:
    """Runs the command; returns its exit code."""
    machine.split_cores()
    from caper_jax.reproduce import ablations
    from caper_jax.reproduce.options import Options

    given, settings = parsed
    name = Path(given.config).stem
    options = Options(
        category=tuple(common.chosen_categories(given.category, ())),
        seeds=given.seeds,
        steps=given.steps,
        preset=given.preset,
        frames=given.frames,
        initial=given.initial and common.model_folder(given.initial),
        out=given.out,
        settings=settings,
    )
    show_report(ablations.run_file(given.config, name, options), name, given.out)
    return 0
