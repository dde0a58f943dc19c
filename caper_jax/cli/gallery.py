"""``caper gallery``: a picture of a category's generated shapes."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from caper_jax.cli import common


def build_parser() -> argparse.ArgumentParser:
    parser = common.create_parser(
        "gallery",
        "Draws generated instances, parts colored, in random states before random cameras: one\n"
        "row per category. Look at it before you train on shapes of your own.",
        [
            ("--out gallery.png", "all categories"),
            ("--category box laptop --count 12 --seed 3 --out some.png", "some of them"),
            ("--category microwave.py:MICROWAVE --out mine.png", "your own"),
        ],
    )
    parser.add_argument("--category", nargs="+", help="names, or FILE.py:NAME (default: all)")
    parser.add_argument(
        "--count", type=common.positive_int, default=8, help="per row (default: %(default)s)"
    )
    parser.add_argument("--split", default="train", choices=("train", "val", "test"))
    parser.add_argument(
        "--seed", type=common.non_negative_int, default=0, help="(default: %(default)s)"
    )
    parser.add_argument("--out", required=True, type=Path, help="the PNG to write")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    arguments = build_parser().parse_args(sys.argv[1:] if argv is None else argv)
    common.check_folder(arguments.out.parent, "--out")
    from caper_jax import categories
    from caper_jax.visualization.gallery import write_gallery

    chosen = [categories.get(name) for name in arguments.category or categories.names()]
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    write_gallery(arguments.out, chosen, arguments.count, arguments.split, arguments.seed)
    print(f"written: {arguments.out}")
    return 0
