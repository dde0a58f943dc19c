"""``caper calibrate``: fits the standard deviations of a model on generated frames."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from caper_jax.cli import common


def build_parser() -> argparse.ArgumentParser:
    parser = common.create_parser(
        "calibrate",
        "Fits what a model says about its own errors (rotation_std, translation_std, state_std)\n"
        "on generated frames of instances that training never shows, and writes it into the\n"
        "model's card; with --sides first the network that corrects its estimates by the sides of\n"
        "their boxes. Training on generated frames does both at its end.",
        [
            ("--category box --weights runs/box", "a model trained on data of your own"),
            ("--category box --weights runs/box --sides", "and its sides"),
        ],
    )
    parser.add_argument("--category", required=True, help="e.g. box, or FILE.py:NAME")
    parser.add_argument(
        "--weights", required=True, type=Path, help="model directory; its model.json is rewritten"
    )
    parser.add_argument(
        "--frames", type=common.positive_int, help="to fit on (default: 4096)", metavar="N"
    )
    parser.add_argument(
        "--sides",
        type=common.positive_int,
        nargs="?",
        const=True,
        metavar="N",
        help="fit the sides first, on N frames (default: 40000)",
    )
    parser.add_argument(
        "--seed",
        type=common.non_negative_int,
        default=0,
        help="of shapes and frames (default: %(default)s)",
    )
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    arguments = build_parser().parse_args(sys.argv[1:] if argv is None else argv)
    from caper_jax.config import TRAINING_DATA
    from caper_jax.estimator import load
    from caper_jax.models.files import CARD_FILE, write_card
    from caper_jax.training.fit_uncertainty import FRAMES, calibrate, check_frame_count

    frames = arguments.frames or FRAMES
    check_frame_count(frames)  # before anything is written
    if arguments.sides:
        from caper_jax.config import RefinerConfig
        from caper_jax.training import fit_refiner

        number = RefinerConfig().frames if arguments.sides is True else arguments.sides
        options = {"frames": number, "seed": arguments.seed}
        fit_refiner.add_refiner(arguments.weights, arguments.category, TRAINING_DATA, **options)
    estimator = load(arguments.category, arguments.weights)
    section = calibrate(estimator, TRAINING_DATA, frames, arguments.seed)
    write_card(arguments.weights, {**estimator.card, "calibration": section})
    print(f"written: {arguments.weights / CARD_FILE} (calibrated on {frames} frames)")
    return 0
