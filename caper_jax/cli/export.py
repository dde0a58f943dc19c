"""``caper export``: a model as one file that runs without this package."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from caper_jax.cli import common


def build_parser() -> argparse.ArgumentParser:
    parser = common.create_parser(
        "export",
        "Writes a model as StableHLO with its weights inside, a manifest of its inputs and\n"
        "outputs, and a short program that runs it with jax, numpy and flatbuffers alone.",
        [
            ("--category box --out serving/box", "for CPU and NVIDIA GPUs, one cloud at a time"),
            ("--category box --out serving/box --platform tpu --batch any", "batches of any size"),
        ],
    )
    parser.add_argument(
        "--category", required=True, help="e.g. box, or FILE.py:NAME for one of your own"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to write to")
    parser.add_argument(
        "--weights", type=Path, help="model directory (default: the shipped one of the category)"
    )
    parser.add_argument(
        "--platform",
        action="append",
        metavar="P",
        help="cpu, cuda, rocm or tpu; may be given several times (default: cpu and cuda)",
    )
    parser.add_argument(
        "--batch",
        type=_batch,
        default=1,
        metavar="N",
        help="clouds per call, or 'any', which rounds otherwise than the package "
        "(default: %(default)s)",
    )
    common.add_model_options(parser)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    arguments = build_parser().parse_args(sys.argv[1:] if argv is None else argv)
    common.check_folder(arguments.out, "--out")
    from caper_jax.estimator import load
    from caper_jax.export import MODEL_FILE, RUNNER_FILE, export_estimator

    estimator = load(arguments.category, *common.model_options(arguments))
    batch = None if arguments.batch == "any" else arguments.batch
    platforms = arguments.platform or ("cpu", "cuda")
    manifest = export_estimator(estimator, arguments.out, platforms, batch)
    size = (arguments.out / MODEL_FILE).stat().st_size
    print(
        f"written: {arguments.out} ({size / 1e6:.1f} MB for {', '.join(manifest['platforms'])}); "
        f"run it with: python {arguments.out / RUNNER_FILE} cloud.npy poses.npz"
    )
    return 0


def _batch(text: str) -> int | str:
    return text if text == "any" else common.positive_int(text)
