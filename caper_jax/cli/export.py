"""``caper export``: a model as one file that runs without this package."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from caper_jax.cli import common
from caper_jax.cli.common import Positive
from caper_jax.errors import CaperError

EXAMPLES = (
    ("--category box --out serving/box", "for CPU and NVIDIA GPUs, one cloud at a time"),
    ("--category box --out serving/box --platform tpu --batch any", "batches of any size"),
)
_ANY = "any"


@dataclass(frozen=True)
class Export:
    """Writes a model as StableHLO with its weights inside.

    Beside it come a manifest of its inputs and outputs, and a short program that runs it with jax,
    numpy and flatbuffers alone.

    Attributes:
      category: e.g. box, or FILE.py:NAME for one of your own
      out: folder to write to
      weights: model directory (default: the shipped one of the category)
      platform: cpu, cuda, rocm or tpu (default: cpu and cuda)
      batch: clouds per call, or any, which rounds otherwise than the package
      object_scale: the objects are so many times as large as those the model was trained on
      camera_roll: degrees by which the image shows things turned clockwise, 180 for upside down
    """

    category: str
    out: Path
    weights: Path | None = None
    platform: tuple[str, ...] = ()
    batch: str = "1"
    object_scale: Positive = 1.0
    camera_roll: float = 0.0

    @property
    def batch_size(self) -> int | None:
        """None for any."""
        return None if self.batch == _ANY else int(self.batch)


def parse(argv: Sequence[str]) -> Export:
    options = common.parse(Export, argv, EXAMPLES)
    if options.batch != _ANY and not (options.batch.isdecimal() and int(options.batch)):
        raise CaperError(f"--batch: {options.batch!r} is neither {_ANY} nor a number of clouds")
    common.check_folder(options.out, "--out")
    return options


def run(options: Export) -> int:
    """Runs the command; returns its exit code."""
    from caper_jax.estimator import load
    from caper_jax.export import MODEL_FILE, RUNNER_FILE, export_estimator

    estimator = load(options.category, options.weights, options.object_scale, options.camera_roll)
    platforms = options.platform or ("cpu", "cuda")
    manifest = export_estimator(estimator, options.out, platforms, options.batch_size)
    size = (options.out / MODEL_FILE).stat().st_size
    print(
        f"written: {options.out} ({size / 1e6:.1f} MB for {', '.join(manifest['platforms'])}); "
        f"run it with: python {options.out / RUNNER_FILE} cloud.npy poses.npz"
    )
    return 0
