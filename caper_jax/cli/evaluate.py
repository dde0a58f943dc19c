"""``caper evaluate``: measures a model on labelled data."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from caper_jax.cli import common
from caper_jax.data import FORMATS
from caper_jax.errors import CaperError

PREDICTORS = ("model", "truth", "mean")


def build_parser() -> argparse.ArgumentParser:
    parser = common.create_parser(
        "evaluate",
        "Estimates every frame of a labelled dataset and writes to a folder: metrics.json (mean\n"
        "and median of every error, failed frames included) and predictions.npz (every estimate).",
        [
            ("--category box --data ReArtMix --format reartmix --out outputs/box", "real frames"),
            ("--category box --data box_test.h5 --format caper --out outputs/box", "generated"),
        ],
    )
    parser.add_argument(
        "--category", required=True, help="e.g. box, or FILE.py:NAME for one of your own"
    )
    parser.add_argument("--data", required=True, type=Path, help="dataset's root folder or .h5")
    parser.add_argument("--format", required=True, help=f"layout of the data: {', '.join(FORMATS)}")
    common.add_splits(parser)
    parser.add_argument(
        "--predictor",
        default="model",
        choices=PREDICTORS,
        help="the model, the dataset's own truth (must score perfectly), or the mean of the "
        "training set (what any model must beat)",
    )
    parser.add_argument(
        "--weights", type=Path, help="model directory (default: the shipped one of the category)"
    )
    parser.add_argument(
        "--limit", type=common.positive_int, help="at most so many frames, from the first"
    )
    common.add_object_scale(parser)
    parser.add_argument("--out", required=True, type=Path, help="folder for the results")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    arguments = build_parser().parse_args(sys.argv[1:] if argv is None else argv)
    from caper_jax import categories
    from caper_jax.data import open_dataset
    from caper_jax.evaluation import protocol, report

    category = categories.get(arguments.category)
    common.check_folder(arguments.out, "--out")
    dataset = open_dataset(
        arguments.format,
        arguments.data,
        category.name,
        arguments.split,
        arguments.official_split,
    )
    weights = None
    predictor: protocol.Predictor = protocol.truth_predictor
    if arguments.predictor != "truth":
        from caper_jax.estimator import load

        estimator = load(category.name, arguments.weights, arguments.object_scale)
        weights = str(arguments.weights or f"shipped with the package ({category.name})")
        if arguments.predictor == "model":
            predictor = protocol.model_predictor(estimator)
        elif "mean_pose" in estimator.card:
            predictor = protocol.mean_predictor(category, estimator.card["mean_pose"], weights)
        else:
            raise CaperError(f"model {weights}: its card has no mean_pose; choose another model")

    evaluation = protocol.evaluate(dataset, predictor, arguments.limit)
    result = report.summarise(evaluation, dataset, arguments.predictor, weights)
    arguments.out.mkdir(parents=True, exist_ok=True)
    report.write_report(arguments.out, evaluation, result)
    print(report.format_report(result))
    print(f"\nwritten: {arguments.out / report.METRICS_FILE}, {report.PREDICTIONS_FILE}")
    return 0
