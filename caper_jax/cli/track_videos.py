"""The part of ``caper track`` that goes through recorded videos."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax

from caper_jax.config import to_dict
from caper_jax.data.readers import formats, open_dataset
from caper_jax.data.readers.depth_folder import FORMAT as FOLDER
from caper_jax.data.readers.depth_folder import is_depth_folder
from caper_jax.data.types import Dataset, Frame
from caper_jax.errors import CaperError, unknown_name
from caper_jax.evaluation.records import json_line
from caper_jax.evaluation.report import METRICS_FILE
from caper_jax.evaluation.tracking import (
    Start,
    Track,
    format_tracks,
    summarize_tracks,
    track_records,
    track_video,
)
from caper_jax.files import write_atomically
from caper_jax.progress import Progress, progress
from caper_jax.tracker import Tracker
from caper_jax.visualization.scene import Scene
from caper_jax.visualization.track import Tile, evenly_spaced, write_sheet, write_states


def open_videos(
    data: Path,
    category: str,
    *,
    format: str | None = None,
    split: str | None = None,
    official_split: bool = False,
    depth_scale: float | None = None,
) -> tuple[Dataset, dict[str, list[int]]]:
    """The dataset and its videos: name -> indices of the frames, in the order of time.

    Raises:
      CaperError: no such data, a layout that cannot be told or has no videos, or options that do
        not go with it.
    """
    layout = format or _guess_format(data)
    if layout not in formats(videos=True):
        raise unknown_name("format of videos", layout, formats(videos=True))
    if layout != FOLDER and depth_scale is not None:
        raise CaperError(f"--depth-scale goes with --format {FOLDER}, not {layout}")
    options: dict[str, Any] = {"depth_scale": depth_scale} if layout == FOLDER else {}
    dataset = open_dataset(layout, data, category, split, official_split, **options)
    videos = dataset.videos()
    if not videos:
        raise CaperError(
            f"{data}: holds single frames, no videos; measure them with caper evaluate"
        )
    return dataset, videos


def choose(
    videos: dict[str, list[int]], names: Sequence[str], count: int | None
) -> dict[str, list[int]]:
    """The videos of these names, or all; at most so many.

    Raises:
      CaperError: a video that is not there.
    """
    for name in names:
        if name not in videos:
            raise unknown_name("video", name, videos)
    chosen = [name for name in videos if not names or name in names]
    return {name: videos[name] for name in chosen[:count]}


def _guess_format(data: Path) -> str:
    if not data.exists():
        raise CaperError(f"--data {data}: no such file or folder")
    if data.is_file():
        return "caper"
    if is_depth_folder(data):
        return FOLDER
    raise CaperError(f"--data {data}: give --format, one of {', '.join(formats(videos=True))}")


def track_all(
    tracker: Tracker,
    dataset: Dataset,
    videos: dict[str, list[int]],
    out: Path,
    *,
    start: Start,
    given_masks: bool,
    weights: Path | None,
) -> None:
    """Tracks through the videos, writes everything to a folder and prints the tables.

    Every video's files are written before the next one begins.

    Args:
      tracker: of the dataset's category.
      dataset, videos: see ``open_videos``.
      out: the folder; made where it is missing.
      start, given_masks: see ``track_video``.
      weights: where the model came from, for metrics.json; None for the one that ships.
    """
    category, config = dataset.category, tracker.config
    out.mkdir(parents=True, exist_ok=True)
    tracks = []
    with progress("loading, compiling, tracking", sum(map(len, videos.values()))) as bar:
        for (name, indices), stem in zip(videos.items(), file_stems(videos), strict=True):
            kept: dict[int, Frame] = {}
            frames = _frames(dataset, indices, kept, bar)
            track = track_video(tracker, name, frames, start, given_masks)
            _write_video(out, stem, track, kept, tracker)
            tracks.append(track)
    facts = (start, dataset.mask_source, "given" if given_masks else "predicted")
    measured = [track for track in tracks if track.truth is not None]
    metrics = None
    (out / METRICS_FILE).unlink(missing_ok=True)  # an earlier run's would stand beside these tracks
    if sum(len(track.frames) - 1 for track in measured):
        metrics = summarize_tracks(measured, category, *facts)
        metrics |= {
            "format": dataset.format,
            "split": dataset.split,
            "weights": str(weights or f"shipped with the package ({category.name})"),
            "tracker": to_dict(config),
        }
        text = json.dumps(metrics, indent=2, allow_nan=False)
        write_atomically(out / METRICS_FILE, text.encode() + b"\n")
    print(format_tracks(tracks, category, config, *facts, metrics))
    written = [METRICS_FILE] if metrics is not None else []
    stem = file_stems(videos)[0] if len(videos) == 1 else "<video>"
    written += [f"{stem}.jsonl", f"{stem}.png", f"{stem}_states.png"]
    print(f"\nwritten to {out}: {', '.join(written)}")


def _write_video(
    out: Path, stem: str, track: Track, kept: dict[int, Frame], tracker: Tracker
) -> None:
    """Poses, contact sheet and curves of one video."""
    category, config = tracker.estimator.category, tracker.config
    lines = "".join(json_line(row) + "\n" for row in track_records(track, category))
    write_atomically(out / f"{stem}.jsonl", lines.encode())
    tiles = [_tile(number, frame, track, tracker) for number, frame in kept.items()]
    write_sheet(out / f"{stem}.png", track.name, tiles)
    threshold = config.threshold if config.policy in ("dynamic", "promote") else None
    write_states(out / f"{stem}_states.png", track, category, threshold)


def file_stems(videos: Iterable[str]) -> list[str]:
    """A name for the files of each video: no separators, none twice on any file system."""
    stems: list[str] = []
    taken: set[str] = set()
    for name in videos:
        plain = re.sub(r"[^\w.-]+", "-", name).strip(".-") or "video"
        stem, number = plain, 1
        while taken & _names_of(stem):
            number += 1
            stem = f"{plain}-{number}"
        taken |= _names_of(stem)
        stems.append(stem)
    return stems


def _names_of(stem: str) -> set[str]:
    return {stem.casefold(), f"{stem}_states".casefold()}


def _frames(
    dataset: Dataset, indices: Sequence[int], kept: dict[int, Frame], bar: Progress
) -> Iterator[Frame]:
    """The frames of a video; those for its contact sheet stay in ``kept``, by number."""
    wanted = set(evenly_spaced(len(indices)))
    for number, index in enumerate(indices):
        frame = dataset[index]
        if number in wanted:
            kept[number] = frame
        yield frame
        bar.update(1)


def _tile(number: int, frame: Frame, track: Track, tracker: Tracker) -> Tile:
    observation = tracker.observe(frame.points)
    # What a frame without the object shows is no part of it.
    shown = slice(None) if observation.present else slice(0)
    assert track.labels is not None  # every tracker predicts them
    points, labels = observation.points[shown], track.labels[number][shown]
    pose = jax.tree.map(lambda array: array[number], track.pose)
    scene = Scene.of_frame(frame, tracker.estimator.category, points, labels, pose)
    return Tile(number, scene, bool(track.keyframe[number]), bool(track.lost[number]))
