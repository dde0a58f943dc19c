"""``caper evaluate``: measures a model on labeled data."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from caper_jax.cli import common
from caper_jax.data.readers import formats
from caper_jax.errors import CaperError

if TYPE_CHECKING:
    from caper_jax.data.types import Dataset
    from caper_jax.estimator import Estimator
    from caper_jax.evaluation.protocol import Evaluation

WORST_FILE = "worst.png"
PREDICTORS = ("model", "truth", "mean")


def build_parser() -> argparse.ArgumentParser:
    parser = common.create_parser(
        "evaluate",
        "Estimates every frame of a labeled dataset and writes to a folder: metrics.json (mean\n"
        "and median of every error, failed frames included) and predictions.npz (every estimate).",
        [
            ("--category box --data ReArtMix --format reartmix --out outputs/box", "real frames"),
            ("--category box --data box_test.h5 --out outputs/box", "generated"),
            (
                "--category box --data box_test.h5 --worst 6 --out outputs/box",
                "see why",
            ),
        ],
    )
    parser.add_argument(
        "--category", required=True, help="e.g. box, or FILE.py:NAME for one of your own"
    )
    parser.add_argument("--data", required=True, type=Path, help="dataset's root folder or .h5")
    parser.add_argument(
        "--format",
        default="caper",
        help=f"layout of the data: {', '.join(formats(labeled=True))} (default: caper)",
    )
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
    parser.add_argument(
        "--worst",
        type=common.positive_int,
        metavar="N",
        help="also a picture of the N frames whose rotations are most off, worst.png",
    )
    common.add_model_options(parser)
    parser.add_argument("--out", required=True, type=Path, help="folder for the results")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    arguments = build_parser().parse_args(sys.argv[1:] if argv is None else argv)
    from caper_jax import categories
    from caper_jax.data.readers import open_dataset
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
    if arguments.worst and arguments.predictor != "model":
        raise CaperError("--worst shows what the model finds; leave out --predictor")
    weights = None
    predictor: protocol.Predictor = protocol.truth_predictor
    if arguments.predictor != "truth":
        from caper_jax.estimator import load

        estimator = load(category.name, *common.model_options(arguments))
        weights = str(arguments.weights or f"shipped with the package ({category.name})")
        if arguments.predictor == "model":
            predictor = protocol.model_predictor(estimator)
            if arguments.camera_roll:
                weights += f", told of a camera roll of {arguments.camera_roll:g} deg"
        elif "mean_pose" in estimator.card:
            predictor = protocol.mean_predictor(category, estimator.card["mean_pose"], weights)
        else:
            raise CaperError(f"model {weights}: its card has no mean_pose; choose another model")

    evaluation = protocol.evaluate(dataset, predictor, arguments.limit)
    result = report.summarize(evaluation, dataset, arguments.predictor, weights)
    arguments.out.mkdir(parents=True, exist_ok=True)
    report.write_report(arguments.out, evaluation, result)
    print(report.format_report(result))
    written = [report.METRICS_FILE, report.PREDICTIONS_FILE]
    if arguments.worst:
        _write_worst(arguments.out / WORST_FILE, dataset, estimator, evaluation, arguments.worst)
        written.append(WORST_FILE)
    print(f"\nwritten: {arguments.out / written[0]}, {', '.join(written[1:])}")
    return 0


def _write_worst(
    path: Path, dataset: Dataset, estimator: Estimator, evaluation: Evaluation, count: int
) -> None:
    """Draws the frames with the largest error of any part's rotation, and names them.

    Raises:
      CaperError: every frame failed, or the file cannot be written.
    """
    import jax
    import numpy as np

    from caper_jax.evaluation.protocol import NUM_POINTS, cloud_of
    from caper_jax.lie import so3
    from caper_jax.visualization.picture import write_picture
    from caper_jax.visualization.scene import Scene

    found, truth = evaluation.estimate.rotation, evaluation.truth.rotation
    off = np.degrees(so3.geodesic_distance(found, truth)).max(-1)
    off = np.where(evaluation.failed, -1.0, off)
    order = [
        int(index)
        for index in np.argsort(-off, kind="stable")[:count]
        if not evaluation.failed[index]
    ]
    if not order:
        raise CaperError("no frame to draw: the estimate of every one failed")
    scenes = []
    print("\nlargest errors of rotation:")
    for index in order:
        frame = dataset[index]
        print(f"  {off[index]:6.1f} deg  {frame.name}")
        seen = estimator(cloud_of(frame, NUM_POINTS))
        scenes.append(
            Scene(
                name=frame.name,
                category=dataset.category,
                points=np.asarray(seen.points),
                labels=np.asarray(seen.labels),
                pose=jax.tree.map(np.asarray, seen.pose),
                truth=frame.truth,
                depth=frame.depth,
                mask=frame.mask,
                intrinsics=frame.intrinsics,
            )
        )
    write_picture(path, scenes)
