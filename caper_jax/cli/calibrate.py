"""``caper calibrate``: fits what a model says of its own estimates on generated frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from caper_jax.cli import common
from caper_jax.cli.common import Count, Size
from caper_jax.errors import CaperError

EXAMPLES = (
    ("--category box --weights runs/box", "a model trained on data of your own"),
    ("--category box --weights runs/box --refiner", "and its refiner"),
)


@dataclass(frozen=True)
class Calibrate:
    """Fits what a model says about its own errors, and whether an estimate is plausible at all.

    Standard deviations (rotation_std, translation_std, size_std, state_std), the probabilities of
    readings (hypotheses) and the classifier that tells right objects from wrong ones are fitted on
    generated frames. With --refiner the network that corrects the model's estimates by the sides of
    their boxes is fitted first. Training on generated frames does both at its end.

    Attributes:
      category: e.g. box, or FILE.py:NAME for one of your own
      weights: model directory; its model.json, plausibility.npz and hypotheses.npz are rewritten
      frames: to calibrate on; three times as many for the classifier, 1.5 for the readings
      refiner: fit the refiner first
      refiner_frames: to fit the refiner on
      seed: of shapes and frames
    """

    category: str
    weights: Path
    frames: Count = 4096
    refiner: bool = False
    refiner_frames: Count = 40_000
    seed: Size = 0


def parse(argv: Sequence[str]) -> Calibrate:
    options = common.parse(Calibrate, argv, EXAMPLES)
    if options.refiner_frames != Calibrate.refiner_frames and not options.refiner:
        raise CaperError("--refiner-frames goes with --refiner")
    return options


def run(options: Calibrate) -> int:
    """Runs the command; returns its exit code."""
    from caper_jax.config import TRAINING_DATA
    from caper_jax.models.files import CARD_FILE
    from caper_jax.training import fit_refiner
    from caper_jax.training.calibration import add_calibration
    from caper_jax.training.fit_uncertainty import check_frame_count

    weights, category = options.weights, options.category
    check_frame_count(options.frames)  # before anything is written
    if options.refiner:
        fit_refiner.add_refiner(
            weights, category, TRAINING_DATA, frames=options.refiner_frames, seed=options.seed
        )
    add_calibration(weights, category, TRAINING_DATA, options.frames, options.seed)
    print(f"written: {weights / CARD_FILE} (calibrated on {options.frames} frames)")
    return 0
