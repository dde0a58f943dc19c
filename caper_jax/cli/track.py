"""``caper track``: follows one object through recorded videos or a live stream of clouds."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from caper_jax.cli import common
from caper_jax.data.readers import formats
from caper_jax.errors import CaperError

# Options of recorded videos, by the attribute that argparse gives them.
_RECORDED = (
    "format", "split", "official_split", "depth_scale", "video", "limit", "given_masks", "out",
)  # fmt: skip
_LAYOUTS = """\

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


def build_parser() -> argparse.ArgumentParser:
    parser = common.create_parser(
        "track",
        "Tracks one object through each video and writes to a folder, per video: the poses of\n"
        "all frames (.jsonl), a contact sheet (.png) and curves of joint states and energy\n"
        "(_states.png); and metrics.json where the data have ground truth.",
        [
            ("--category laptop --data kitchen --out outputs/kitchen", "a folder of images"),
            ("--category box --data boxes.h5 --start truth --out outputs/b", "as the paper"),
            ("--category box --live 192.168.0.7:5000", "a stream, see below"),
        ],
    )
    assert parser.epilog is not None
    parser.epilog += "\n" + _LAYOUTS
    parser.add_argument(
        "--category", required=True, help="e.g. box, or FILE.py:NAME for one of your own"
    )
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--data", type=Path, help="folder or .h5 with one video or several")
    source.add_argument(
        "--live", nargs="?", const="-", metavar="HOST:PORT", help="a stream; - is standard input"
    )
    parser.add_argument(
        "--format",
        help=f"layout of the data: {', '.join(formats(videos=True))} (default: caper for "
        ".h5, folder for a folder with depth/)",
    )
    common.add_splits(parser)
    parser.add_argument(
        "--depth-scale",
        type=common.positive_float,
        help="meters per unit of the depth images of a folder",
    )
    parser.add_argument(
        "--video", action="append", metavar="NAME", help="only this video; may be repeated"
    )
    parser.add_argument("--limit", type=common.positive_int, help="at most so many videos")
    parser.add_argument(
        "--start",
        choices=("estimator", "truth"),
        default="estimator",
        help="where the first frame's pose comes from (default: %(default)s; the paper's tracker "
        "begins with the truth)",
    )
    parser.add_argument(
        "--given-masks",
        action="store_true",
        help="hand over the data's masks of the parts instead of predicting them",
    )
    parser.add_argument(
        "--weights", type=Path, help="model directory (default: the shipped one of the category)"
    )
    parser.add_argument("--policy", help="of keyframes: dynamic, promote, fixed, none")
    parser.add_argument(
        "--interval", type=common.positive_int, help="frames between keyframes, of policy fixed"
    )
    parser.add_argument(
        "--threshold", type=common.positive_float, help="of the energy, in object diagonals"
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="another setting of the tracker, e.g. filtered=false or registration.steps=0; may be "
        "repeated",
    )
    common.add_model_options(parser)
    parser.add_argument("--out", type=Path, help="folder for the results of --data")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    arguments = build_parser().parse_args(sys.argv[1:] if argv is None else argv)
    from caper_jax.cli import track_live, track_videos
    from caper_jax.tracker import load_tracker

    model = _model(arguments)
    if arguments.live is not None:
        _refuse_recorded(arguments)
        with track_live.open_stream(arguments.live) as frames:
            track_live.track_stream(load_tracker(**model), frames)
        return 0
    if arguments.out is None:
        raise CaperError("--data needs --out, the folder for the results")
    common.check_folder(arguments.out, "--out")
    dataset, videos = track_videos.open_videos(arguments, model["category"])
    recorder = track_videos.load_recorder(**model)
    track_videos.track_all(arguments, recorder, dataset, videos)
    return 0


def _model(arguments: argparse.Namespace) -> dict[str, Any]:
    """Which tracker: the arguments of ``load_tracker``."""
    from caper_jax import categories

    settings = [
        f"{key}={getattr(arguments, key)}"
        for key in ("policy", "interval", "threshold")
        if getattr(arguments, key) is not None
    ]
    weights, object_scale, camera_roll = common.model_options(arguments)
    return {
        "category": categories.get(arguments.category).name,
        "weights": weights,
        "config": settings + arguments.set,
        "object_scale": object_scale,
        "camera_roll": camera_roll,
    }


def _refuse_recorded(arguments: argparse.Namespace) -> None:
    for option in _RECORDED:
        if getattr(arguments, option) not in (None, False):
            raise CaperError(f"--{option.replace('_', '-')} goes with --data, not --live")
    if arguments.start == "truth":
        raise CaperError("--start truth goes with --data: a stream has no ground truth")
