"""Reads a whole root and says everything that is wrong with it, not only what comes first."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.data.clouds import MIN_POINTS
from caper_jax.data.readers import open_dataset, splits_in
from caper_jax.data.types import Dataset, Frame, NoFramesError, frame_problems, pose_shapes
from caper_jax.errors import CaperError
from caper_jax.progress import progress

_FEWEST_OF_PART = 16  # points, below which they say nothing about a part's box

_FIELDS = ("points", "labels", "visible", "visibility", *pose_shapes(2))
# Points of a part may lie off its box by this share of the object's diagonal (sensors, masks), and
# half of them further: a label, pose or camera of another image misses by more.
_MARGIN = 0.05
_LEAST_INSIDE = 0.5


@dataclass(frozen=True)
class Problem:
    """Something wrong with a file or a frame.

    Attributes:
      message: ``frame: field: what`` or ``file: what``, one line.
      frame: the frame's name; None where a whole category is concerned.
      field: the frame's field; None where it could not be read.
    """

    message: str
    frame: str | None = None
    field: str | None = None


@dataclass
class CategoryReport:
    """What was seen of one category.

    Attributes:
      category: its name.
      splits: split -> number of frames; None where the split cannot be opened.
      frames: number of frames read.
      instances: number of objects shown; None when no frame tells.
      few_points: frames that show too little for a cloud.
      bad_frames: frames with problems.
      problems: all of them, in the order of the frames.
    """

    category: str
    splits: dict[str, int | None] = field(default_factory=dict)
    frames: int = 0
    instances: int | None = None
    few_points: int = 0
    bad_frames: int = 0
    problems: list[Problem] = field(default_factory=list)


def check_category(
    format: str,
    root: str | Path,
    category: str,
    split: str | None = None,
    workers: int = 4,
) -> CategoryReport:
    """Reads and checks every frame of a category; what is broken becomes a problem, not an error.

    Args:
      format: one of ``data.readers.formats(labeled=True)``.
      root: the file or the root folder.
      category: one that the root holds.
      split: check this split only; None for all frames.
      workers: threads that read.
    """
    report = CategoryReport(category)
    messages: dict[str, None] = {}

    def note(error: Exception) -> None:
        messages.setdefault(_finding(error, str(root)))

    def opened(name: str | None) -> Dataset:
        return open_dataset(format, root, category, name, on_broken=note)

    try:
        listed = splits_in(format, root, category)
    except Exception as error:
        note(error)
        listed = []
    for name in listed:
        try:
            report.splits[name] = len(opened(name))
        except NoFramesError:
            report.splits[name] = 0  # e.g. an empty list of test frames
        except Exception as error:
            report.splits[name] = None
            note(error)
    dataset = None
    try:
        dataset = opened(split)
    except Exception as error:
        note(error)
    report.problems = [Problem(message) for message in messages]
    if dataset is not None:
        _check_frames(dataset, report, workers)
    return report


def _check_frames(dataset: Dataset, report: CategoryReport, workers: int) -> None:
    def check(index: int) -> tuple[str | None, bool, list[Problem]]:
        name = dataset.names[index]
        try:
            frame = dataset[index]
            problems = check_frame(frame, dataset.category)
        except Exception as error:
            return None, False, [Problem(_finding(error, name), name)]
        return frame.instance, len(frame.points) < MIN_POINTS, problems

    results = []
    with (
        progress(f"reading {report.category}", total=len(dataset)) as bar,
        ThreadPoolExecutor(workers) as pool,
    ):
        for result in pool.map(check, range(len(dataset))):
            results.append(result)
            bar.update(1)
    instances = {instance for instance, _, _ in results if instance is not None}
    report.frames = len(results)
    report.instances = len(instances) or None
    report.few_points = sum(few for _, few, _ in results)
    report.bad_frames = sum(bool(problems) for _, _, problems in results)
    report.problems += [problem for _, _, problems in results for problem in problems]


def check_frame(frame: Frame, category: Category) -> list[Problem]:
    """Everything that is wrong with a frame that could be read.

    A frame without points is none of it: readers give such frames where too little is seen.
    """
    phrases = frame_problems(frame, category)
    if len(frame.points) == 0:
        phrases = [phrase for phrase in phrases if not phrase.startswith("points has shape")]
    elif not phrases:
        phrases = _misplaced(frame, category)
    problems = []
    for phrase in phrases:
        name, _, what = phrase.partition(" ")
        known = name if name in _FIELDS else None
        text = f"{name}: {what}" if known else phrase
        problems.append(Problem(f"{frame.name}: {text}", frame.name, known))
    return problems


def _misplaced(frame: Frame, category: Category) -> list[str]:
    """Parts whose points lie elsewhere than the part."""
    truth, labels = frame.truth, frame.labels
    if truth is None or labels is None:
        return []
    low = (truth.box_center - truth.size / 2).min(0)
    high = (truth.box_center + truth.size / 2).max(0)
    margin = _MARGIN * np.linalg.norm(high - low)
    phrases = []
    for part, name in enumerate(category.parts):
        points = frame.points[labels == part]
        if len(points) < _FEWEST_OF_PART:
            continue
        local = (points - truth.translation[part]) @ truth.rotation[part]
        excess = np.abs(local - truth.box_center[part]) - truth.size[part] / 2
        inside = np.mean(np.linalg.norm(np.maximum(excess, 0), axis=-1) <= margin)
        if inside < _LEAST_INSIDE:
            phrases.append(
                f"labels put only {100 * inside:.0f} % of the points of part {name!r} in or near "
                "its box: do labels, depth, camera and poses belong together?"
            )
    return phrases


def one_line(error: Exception) -> str:
    """The error's message without line breaks."""
    return " ".join(str(error).split())


def _finding(error: Exception, where: str) -> str:
    """What a reader raised, as the message of a problem with ``where``.

    Readers name what they know can be broken. Whatever else stops them must not cost the report of
    all other frames.
    """
    if isinstance(error, CaperError):
        return one_line(error)
    return f"{where}: unreadable ({type(error).__name__}: {one_line(error)})"
