"""``caper track``: follows one object through recorded videos or a live stream of clouds."""

from __future__ import annotations

import dataclasses
import socket
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from caper_jax.cli import common
from caper_jax.cli.common import Count, Positive, Settings
from caper_jax.errors import CaperError

if TYPE_CHECKING:
    from caper_jax.data.live import LiveFrame
    from caper_jax.tracker import Tracker

EXAMPLES = (
    ("--category laptop --data kitchen --out outputs/kitchen", "a folder of images"),
    ("--category box --data boxes.h5 --start truth --out outputs/b", "as the paper"),
    ("--category box --data boxes.h5 --tracker.policy fixed --out outputs/f", "a setting"),
    ("--category box --live 192.168.0.7:5000", "a stream, see below"),
)
SECTIONS = {"tracker": "keyframes, registration, variances"}
STANDARD_INPUT = "-"
# Options of recorded videos.
_RECORDED = (
    *("data", "out", "format", "split", "official_split", "depth_scale"),
    *("video", "videos", "given_masks"),
)
_CONNECT_S = 10.0
NOTES = """\

a folder of one's own (--format folder) holds depth/*.png (16-bit millimeters),
mask/*.png of the same names and intrinsics.json (fx, fy, cx, cy), or folders that
do; a frame without a mask does not show the object.

--live reads frames from standard input (-, every frame) or from HOST:PORT (the
newest frame, the others are counted) and prints one JSON object per frame. A frame
is b"CAPR", then version 1, number of points N and a sequence number as little-endian
uint32, then N x 3 float32: meters, camera frame; see caper_jax/data/live.py. A
RealSense camera sends them by (pip install pyrealsense2):
  python -m caper_jax.cli.realsense --box 200,120,440,360 | \\
      caper track --category laptop --live -
"""


@dataclass(frozen=True)
class Track:
    """Tracks one object through each video, or through a live stream.

    Writes to a folder, per video: the poses of all frames (.jsonl), a contact sheet (.png) and
    curves of joint states and energy (_states.png); and metrics.json where the data have ground
    truth. Of a stream it prints the poses.

    Attributes:
      category: e.g. box, or FILE.py:NAME for one of your own
      data: folder or .h5 with one video or several
      live: HOST:PORT of a stream instead, or - for standard input
      out: folder for the results of --data
      format: layout of the data: caper, captra, folder, pm-videos or reart-videos (default: caper
        for .h5, folder for a folder with depth/)
      split: split to read (default: all there is)
      official_split: tell train from test by the published object ids, not by the lists of the
        root
      depth_scale: meters per unit of the depth images of a folder
      video: only the video of this name
      videos: at most so many videos
      start: where the first frame's pose comes from (the paper's tracker begins with the truth)
      given_masks: hand over the data's masks of the parts instead of predicting them
      weights: model directory (default: the shipped one of the category)
      object_scale: the objects are so many times as large as those the model was trained on, e.g.
        3.7 for the laptops of PM-Videos and ArtImage (PartNet units read as meters)
      camera_roll: degrees by which the images show things turned clockwise, 180 for upside down
        (models know level cameras, within 15)
      settings: of the tracker, "key=value"
    """

    category: str
    data: Path | None = None
    live: str | None = None
    out: Path | None = None
    format: str | None = None
    split: str | None = None
    official_split: bool = False
    depth_scale: Positive | None = None
    video: tuple[str, ...] = ()
    videos: Count | None = None
    start: Literal["estimator", "truth"] = "estimator"
    given_masks: bool = False
    weights: Path | None = None
    object_scale: Positive = 1.0
    camera_roll: float = 0.0
    settings: Annotated[tuple[str, ...], tyro.conf.Suppress] = ()


def parse(argv: Sequence[str]) -> Track:
    made, given = common.parse_with_settings(
        Track, argv, EXAMPLES, Settings(SECTIONS, _default_sections), notes=NOTES
    )
    # As ``load_tracker`` takes them.
    settings = tuple(setting.removeprefix("tracker.") for setting in given)
    options = dataclasses.replace(made, settings=settings)
    if (options.data is None) == (options.live is None):
        raise CaperError("give either --data, videos, or --live, a stream")
    if options.live is not None:
        _check_live(options, options.live)
    elif options.out is None:
        raise CaperError("--data needs --out, the folder for the results")
    else:
        common.check_folder(options.out, "--out")
    return options


def _default_sections() -> Mapping[str, Any]:
    from caper_jax.config import TrackerConfig

    return {"tracker": TrackerConfig()}


def _check_live(options: Track, source: str) -> None:
    for option in _RECORDED:
        if getattr(options, option) not in (None, False, ()):
            raise CaperError(f"--{option.replace('_', '-')} goes with --data, not --live")
    if options.start == "truth":
        raise CaperError("--start truth goes with --data: a stream has no ground truth")
    if source == STANDARD_INPUT:
        if sys.stdin.isatty():
            raise CaperError(
                "--live - reads binary frames from standard input, and that is a terminal; pipe "
                "frames into it, or give HOST:PORT"
            )
        return
    host, _, port = source.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 1 << 16:
        raise CaperError(f"--live {source}: give HOST:PORT, e.g. localhost:5000, or -")


def run(options: Track) -> int:
    """Runs the command; returns its exit code."""
    from caper_jax import categories
    from caper_jax.tracker import load_tracker

    model: dict[str, Any] = {
        "category": categories.get(options.category).name,
        "weights": options.weights,
        "config": options.settings,
        "object_scale": options.object_scale,
        "camera_roll": options.camera_roll,
    }
    if options.live is None:
        _track_recorded(options, model)
        return 0
    tracker = load_tracker(**model)
    warm_up(tracker)
    print("ready", file=sys.stderr, flush=True)
    with open_stream(options.live) as frames:
        track_stream(tracker, frames)
    return 0


def _track_recorded(options: Track, model: dict[str, Any]) -> None:
    from caper_jax.cli.track_videos import choose, open_videos, track_all
    from caper_jax.tracker import load_tracker

    assert options.data is not None and options.out is not None
    dataset, videos = open_videos(
        options.data,
        model["category"],
        format=options.format,
        split=options.split,
        official_split=options.official_split,
        depth_scale=options.depth_scale,
    )
    videos = choose(videos, options.video, options.videos)
    track_all(
        load_tracker(**model),
        dataset,
        videos,
        options.out,
        start=options.start,
        given_masks=options.given_masks,
        weights=options.weights,
    )


# ----------------------------------------------------------------------------- live streams


def warm_up(tracker: Tracker) -> None:
    """Compiles the step on an empty frame, so that the first real one does not wait for it."""
    import jax
    import numpy as np

    jax.block_until_ready(tracker(np.zeros((0, 3), np.float32), gravity=np.zeros(3)))
    tracker.reset()


@contextmanager
def open_stream(source: str) -> Iterator[Iterable[LiveFrame]]:
    """Frames of standard input, every one, or of a TCP server, the newest.

    Args:
      source: "-", or HOST:PORT to connect to.

    Raises:
      CaperError: nobody listens there.
    """
    from caper_jax.data.live import Newest, read_frames

    if source == STANDARD_INPUT:
        yield read_frames(sys.stdin.buffer)
        return
    host, _, port = source.rpartition(":")
    try:
        connection = socket.create_connection((host.strip("[]"), int(port)), _CONNECT_S)
    except OSError as error:
        raise CaperError(
            f"--live {source}: cannot connect ({error.strerror or error}); start the sender first"
        ) from error
    with connection, connection.makefile("rb") as stream:
        connection.settimeout(None)  # a camera may pause
        try:
            yield Newest(read_frames(stream))
        finally:
            # Its thread may wait for a frame, and nobody can close what is being read.
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)


def track_stream(tracker: Tracker, frames: Iterable[LiveFrame]) -> None:
    """Prints one JSON object per frame until the stream ends, then a summary to standard error.

    Args:
      tracker: compiled and reset, see ``warm_up``.
      frames: e.g. from ``open_stream``.

    Raises:
      CaperError: a broken stream, or points that cannot be meters.
    """
    import jax
    import numpy as np

    from caper_jax.evaluation.records import frame_record, json_line

    category = tracker.estimator.category
    skipped, lost, implausible, doubt, seconds = 0, 0, 0, None, []
    try:
        for frame in frames:
            began = time.perf_counter()
            gravity = np.zeros(3) if frame.gravity is None else frame.gravity
            try:
                result = jax.block_until_ready(tracker(frame.points, gravity=gravity))
            except CaperError as error:
                raise CaperError(f"frame {frame.sequence}: {error}") from error
            seconds.append(time.perf_counter() - began)
            record = frame_record(frame.sequence, result, category, seconds[-1])
            print(json_line({**record, "skipped": frame.skipped}), flush=True)
            skipped += frame.skipped
            lost += record["lost"]
            implausible += not record["plausible"]
            if record["reason"] and result.reason != doubt:
                print(f"warning: frame {frame.sequence}: {record['reason']}", file=sys.stderr)
            doubt = int(result.reason)
    finally:
        speed = f", {1000 * np.median(seconds):.1f} ms per frame (median)" if seconds else ""
        print(
            f"{len(seconds)} frames tracked, lost in {lost}, implausible in {implausible}; "
            f"{skipped} skipped{speed}",
            file=sys.stderr,
        )
