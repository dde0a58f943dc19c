"""Fits all that a trained model says of its own estimates, and writes it into its directory."""

from __future__ import annotations

from pathlib import Path

from caper_jax.articulation.category import Category
from caper_jax.config import GeneratorConfig
from caper_jax.estimator import load
from caper_jax.models.files import write_card
from caper_jax.training import fit_hypotheses, fit_plausibility, fit_uncertainty

_CLASSIFIED = 3  # frames that the classifier is fitted on, for each of the standard deviations
_READ = 1.5  # frames whose readings are looked at, likewise


def add_calibration(
    directory: str | Path, category: str | Category, config: GeneratorConfig, frames: int, seed: int
) -> None:
    """Fits whether estimates are plausible, how likely other readings are, and how far off.

    Args:
      directory: of the model; what was fitted to it before is replaced.
      category: its name, FILE.py:NAME, or the category itself.
      config: what frames look like, see ``fit_uncertainty.calibrate``.
      frames: for the standard deviations; three times as many for the classifier, half as many
        again for the readings.
      seed: of shapes and frames.

    Raises:
      CaperError: too few frames; or see ``estimator.load``. The model is left as it was.
    """
    fit_plausibility.add_plausibility(directory, category, config, _CLASSIFIED * frames, seed)
    fit_hypotheses.add_hypotheses(directory, category, config, round(_READ * frames), seed)
    estimator = load(category, directory)
    section = fit_uncertainty.calibrate(estimator, config, frames, seed)
    write_card(directory, {**estimator.card, "calibration": section})
