"""``caper evaluate``: measures a model on labeled data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from caper_jax.cli import common
from caper_jax.cli.common import Count, Positive, Size
from caper_jax.errors import CaperError

if TYPE_CHECKING:
    from caper_jax.articulation.category import Category
    from caper_jax.data.types import Dataset
    from caper_jax.estimator import Estimator
    from caper_jax.evaluation.protocol import Evaluation, Predictor

WORST_FILE = "worst.png"
_OF_DATA = ("format", "split", "official_split", "frames")
EXAMPLES = (
    ("--category box --data ReArtMix --format reartmix --out outputs/box", "real frames"),
    ("--category box --data box_test.h5 --out outputs/box", "generated"),
    ("--category box --data box_test.h5 --worst 6 --out outputs/box", "see why"),
    ("--category box --generate 1000 --out outputs/box", "generated as it goes, no file"),
)


@dataclass(frozen=True)
class Evaluate:
    """Estimates every frame of a labeled dataset and measures how far off it is.

    Writes to a folder: metrics.json (mean and median of every error, failed frames included) and
    predictions.npz (every estimate).

    Attributes:
      category: e.g. box, or FILE.py:NAME for one of your own
      out: folder for the results
      data: dataset's root folder or .h5
      generate: instead of --data, so many generated frames of instances that training never saw
      noise: of the generated depth
      seed: of the generated frames and instances
      format: layout of the data: artimage, caper, captra, pm-videos, reart-videos or reartmix
      split: split to read (default: all there is)
      official_split: tell train from test by the published object ids, not by the lists of the
        root
      predictor: the model, the dataset's own truth (must score perfectly), or the mean of the
        training set (what any model must beat)
      weights: model directory (default: the shipped one of the category)
      frames: at most so many frames, from the first (default: all)
      worst: also a picture of so many frames whose rotations are most off, worst.png
      object_scale: the objects are so many times as large as those the model was trained on, e.g.
        3.7 for the laptops of PM-Videos and ArtImage (PartNet units read as meters)
      camera_roll: degrees by which the images show things turned clockwise, 180 for upside down
      use_gravity: tell the model which way things fall, where the data know it
      hypotheses: readings of each frame that the model states, at most 4 (default: as many as it
        can); metrics.json says how often one of them is right
    """

    category: str
    out: Path
    data: Path | None = None
    generate: Count | None = None
    noise: Literal["none", "gauss3mm", "kinect", "realsense"] = "kinect"
    seed: Size = 0
    format: str = "caper"
    split: str | None = None
    official_split: bool = False
    predictor: Literal["model", "truth", "mean"] = "model"
    weights: Path | None = None
    frames: Count | None = None
    worst: Count | None = None
    object_scale: Positive = 1.0
    camera_roll: float = 0.0
    use_gravity: bool = False
    hypotheses: Count | None = None


def parse(argv: Sequence[str]) -> Evaluate:
    options = common.parse(Evaluate, argv, EXAMPLES)
    if (options.data is None) == (options.generate is None):
        raise CaperError("give either --data or --generate, how many frames to draw")
    for name in ("noise", "seed") if options.data is not None else _OF_DATA:
        if getattr(options, name) != getattr(Evaluate, name):
            other = "--generate" if options.data is not None else "--data"
            raise CaperError(f"{common.flag(Evaluate, name)} goes with {other}")
    if options.worst and options.predictor != "model":
        raise CaperError("--worst shows what the model estimates; leave out --predictor")
    common.check_folder(options.out, "--out")
    return options


def run(options: Evaluate) -> int:
    """Runs the command; returns its exit code."""
    from caper_jax import categories
    from caper_jax.evaluation import protocol, report

    category = categories.get(options.category)
    dataset = _dataset(options, category)
    predictor: Estimator | Predictor = protocol.truth_predictor
    estimator = weights = None
    if options.predictor != "truth":
        estimator, predictor, weights = _predictor(options, category)
    evaluation = protocol.evaluate(
        dataset, predictor, options.frames, use_gravity=options.use_gravity
    )
    result = report.summarize(evaluation, dataset, options.predictor, weights)
    options.out.mkdir(parents=True, exist_ok=True)
    report.write_report(options.out, evaluation, result)
    print(report.format_report(result))
    written = [report.METRICS_FILE, report.PREDICTIONS_FILE]
    if options.worst and estimator is not None:
        _write_worst(options.out / WORST_FILE, dataset, estimator, evaluation, options.worst)
        written.append(WORST_FILE)
    print(f"\nwritten: {options.out / written[0]}, {', '.join(written[1:])}")
    return 0


def _dataset(options: Evaluate, category: Category) -> Dataset:
    """The frames to evaluate on.

    Raises:
      CaperError: see ``open_dataset``; a category that cannot be drawn.
    """
    from caper_jax.data.readers import open_dataset

    if options.data is not None:
        return open_dataset(
            options.format, options.data, category.name, options.split, options.official_split
        )
    from caper_jax.reproduce.data import FRAME_DATA
    from caper_jax.reproduce.options import SPLIT
    from caper_jax.synthetic.dataset import GeneratedDataset
    from caper_jax.synthetic.frames import Generator

    assert options.generate is not None
    generator = Generator(
        category, replace(FRAME_DATA, noise=(options.noise,)), SPLIT, options.seed
    )
    return GeneratedDataset(generator, options.generate, options.seed)


def _predictor(
    options: Evaluate, category: Category
) -> tuple[Estimator, Estimator | Predictor, str]:
    """The estimator, what it (or its training set's mean) predicts with, and which model it is.

    Raises:
      CaperError: see ``estimator.load``; a model that does not know its training set's mean.
    """
    from caper_jax.estimator import load
    from caper_jax.evaluation import protocol

    estimator = load(
        category.name,
        options.weights,
        options.object_scale,
        options.camera_roll,
        hypotheses=options.hypotheses,
    )
    weights = str(options.weights or f"shipped with the package ({category.name})")
    if options.predictor == "model":
        if options.camera_roll:
            weights += f", told of a camera roll of {options.camera_roll:g} deg"
        return estimator, estimator, weights
    if "mean_pose" not in estimator.card:
        raise CaperError(f"model {weights}: its card has no mean_pose; choose another model")
    mean = protocol.mean_predictor(category, estimator.card["mean_pose"], weights)
    return estimator, mean, weights


def _write_worst(
    path: Path, dataset: Dataset, estimator: Estimator, evaluation: Evaluation, count: int
) -> None:
    """Draws the frames with the largest error of any part's rotation, and names them.

    Raises:
      CaperError: every frame failed, or the file cannot be written.
    """
    import numpy as np

    from caper_jax.evaluation.loading import cloud_of
    from caper_jax.lie import so3
    from caper_jax.visualization.picture import write_picture
    from caper_jax.visualization.scene import Scene

    estimates, truth = evaluation.estimate.rotation, evaluation.truth.rotation
    off = np.degrees(so3.geodesic_distance(estimates, truth)).max(-1)
    off = np.where(evaluation.failed, -1.0, off)
    worst = np.argsort(-off, kind="stable")[:count].tolist()
    order = [index for index in worst if not evaluation.failed[index]]
    if not order:
        raise CaperError("no frame to draw: the estimate of every one failed")
    scenes = []
    print("\nlargest errors of rotation:")
    for index in order:
        frame = dataset[index]
        print(f"  {off[index]:6.1f} deg  {frame.name}")
        prediction = estimator(cloud_of(frame, estimator.network.num_points))
        scenes.append(Scene.of_prediction(frame, dataset.category, prediction))
    write_picture(path, scenes)
