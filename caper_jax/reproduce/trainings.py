"""Models that a reproduction trains itself, with equal budgets: what ablations compare."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from caper_jax.config import RefinerConfig, override
from caper_jax.errors import CaperError
from caper_jax.estimator import Estimator, load
from caper_jax.models.files import CARD_FILE
from caper_jax.reproduce.options import Options
from caper_jax.training import train as training

PRESET = "fast"
MINUTES = 60.0


def trained(
    category: str, label: str, changes: Sequence[str], seed: int, options: Options
) -> Estimator:
    """A model of one kind; trained now, resumed, or read where an earlier call finished it.

    Args:
      category: its name.
      label: of the kind, in the name of its folder under ``options.out``.
      changes: KEY=VALUE, what makes it of this kind, besides ``options.overrides``.
      seed: of weights and data.
      options: give budget and start.

    Raises:
      CaperError: see ``training.train.train``; a run kept there with other settings.
      KeyboardInterrupt: training was stopped before its budget was used up; the same call goes on.
    """
    check_budget(options)
    budget = f"{options.steps}steps" if options.steps else f"{_minutes(options):g}min"
    directory = options.out / "runs" / f"{category}_{label}_{budget}_seed{seed}"
    config = override(training.preset(PRESET, category), *options.overrides, *changes)
    config = replace(
        config,
        # What both stages find is compared, and nobody asks these models how sure they are.
        network=replace(config.network, refiner=RefinerConfig()),
        calibration_frames=0,
        training=replace(
            config.training,
            steps=options.steps,
            minutes=None if options.steps else _minutes(options),
            seed=seed,
        ),
    )
    there = (directory / CARD_FILE).is_file()
    if not there and not training.train(config, directory, options.initial).finished:
        raise KeyboardInterrupt
    estimator = load(category, directory)
    if estimator.network != config.network:
        raise CaperError(
            f"{directory} holds a finished run of another network; choose another --out"
        )
    return estimator


def check_budget(options: Options) -> None:
    """Raises CaperError for a budget in both steps and minutes."""
    if options.steps is not None and options.minutes is not None:
        raise CaperError("--steps and --minutes exclude each other")


def describe(options: Options) -> str:
    """Budget and start of each run, for people."""
    budget = f"{options.steps} steps" if options.steps else f"{_minutes(options):g} minutes"
    start = "random weights" if options.initial is None else f"the model in {options.initial}"
    return f"{budget} each, preset {PRESET}, from {start}, on generated frames"


def _minutes(options: Options) -> float:
    return options.minutes or MINUTES
