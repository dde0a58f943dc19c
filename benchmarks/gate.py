"""``bin/benchmark gate``: has a change made anything slower?

Each ratio is the time of a plain computation over the time of ours, measured in turn in one
process, so that what else the machine does cancels. Between kinds of processors it does not: one
that multiplies matrices twice as fast halves the ratio of what is no matrix product. The committed
ratios are therefore kept by processor.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks import timing
from benchmarks.arguments import positive_int
from caper_jax import machine
from caper_jax.errors import CaperError
from caper_jax.files import write_atomically

LOSS = 0.25  # of a ratio, that fails
BASELINE = Path(__file__).with_name("baseline.json")
_BATCH = 8
_PAIRS = 512
_TWISTS = 200_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--repeats", type=positive_int, default=15, help="runs (default: %(default)s)"
    )
    parser.add_argument(
        "--baseline", type=Path, default=BASELINE, metavar="FILE", help="(default: the committed)"
    )
    parser.add_argument(
        "--update", action="store_true", help="write what is measured there, for this processor"
    )


def run(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """The ratios beside the baseline's; one that fell is measured once more before it counts."""
    calls = measured()
    ratios = {name: ratio(*pair, arguments.repeats) for name, pair in calls.items()}
    baselines, processor = read_baselines(arguments.baseline), machine.processor()
    if arguments.update:
        baselines[processor] = {name: round(value, 4) for name, value in ratios.items()}
        text = json.dumps(baselines, indent=1, sort_keys=True)
        write_atomically(arguments.baseline, (text + "\n").encode())
    baseline = baselines.get(processor, {})
    for name in fallen(ratios, baseline):
        ratios[name] = max(ratios[name], ratio(*calls[name], 2 * arguments.repeats))
    yield from compare(ratios, baseline)


def verdict(rows: Sequence[Mapping[str, Any]]) -> int:
    """Exit code 1, and the names on standard error, where a ratio fell by ``LOSS``.

    Where this kind of processor has no baseline that is said, and nothing can fail.
    """
    if all(row["baseline"] == "-" for row in rows):
        print(
            f"nothing to compare with: no baseline of a {machine.processor()}; --update writes one",
            file=sys.stderr,
        )
    slower = [f"{row['what']} ({row['change_%']:+.0f} %)" for row in rows if row["verdict"] != "ok"]
    if slower:
        print(f"slower than the baseline: {', '.join(slower)}", file=sys.stderr)
    return int(bool(slower))


def read_baselines(path: Path) -> dict[str, dict[str, float]]:
    """The committed ratios by kind of processor.

    Raises:
      CaperError: not a JSON object of objects of numbers above 0.
    """
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise CaperError(f"{path} is not valid JSON: {error}") from error
    good = isinstance(found, dict) and all(
        isinstance(ratios, dict)
        and all(isinstance(value, int | float) and value > 0 for value in ratios.values())
        for ratios in found.values()
    )
    if not good:
        raise CaperError(f"{path} must hold ratios above 0 by processor and name")
    return found


def fallen(ratios: Mapping[str, float], baseline: Mapping[str, float]) -> list[str]:
    """Names whose ratio is less than 1 - ``LOSS`` of the baseline's; a missing one has fallen."""
    return [name for name, value in baseline.items() if ratios.get(name, 0.0) < (1 - LOSS) * value]


def compare(ratios: Mapping[str, float], baseline: Mapping[str, float]) -> Iterator[dict[str, Any]]:
    """One row per name in either; one that the baseline does not know passes."""
    slower = fallen(ratios, baseline)
    for name in dict.fromkeys((*baseline, *ratios)):
        now, before = ratios.get(name, 0.0), baseline.get(name)
        yield {
            "what": f"{name:<24}",
            "ratio": round(now, 4),
            "baseline": "-" if before is None else before,
            "change_%": 0.0 if before is None else round(100 * (now / before - 1), 1),
            "verdict": "slower" if name in slower else "ok",
            "load_average": machine.load_average(),
        }


def ratio(ours: Callable[[], Any], reference: Callable[[], Any], repeats: int) -> float:
    """How many times as fast as the reference, from medians of interleaved runs."""
    medians = timing.interleaved({"ours": ours, "reference": reference}, repeats)
    return medians["reference"] / medians["ours"]


def measured() -> dict[str, tuple[Callable[[], Any], Callable[[], Any]]]:
    """What is guarded: (ours, reference) by name."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from benchmarks import iou, se3, training
    from benchmarks.models import clouds, encoders
    from caper_jax.config import HSEncoderConfig
    from caper_jax.estimator import load
    from caper_jax.tracker import Tracker

    estimator = load("laptop")
    points = clouds(estimator.category, _BATCH)
    tracker = Tracker(estimator)
    matmul, sines = timing.matmul(), timing.elementwise()

    # A quarter of the published width, so that the naive form compiles and runs in seconds.
    config = HSEncoderConfig(channels=(32, 32, 64, 64, 128))
    weights, fast, naive = encoders(config, points[:1])
    fast_encoder, naive_encoder = (
        jax.jit(jax.grad(lambda weights, encode=encode: jnp.sum(encode(weights) ** 2)))
        for encode in (fast, naive)
    )

    twists = jax.device_put(se3.twists(_TWISTS))
    functions = {name: jax.jit(function) for name, function in se3.functions().items()}
    transforms = jax.jit(functions["exp"])(twists)
    return {
        "estimator, batch 1": (lambda: estimator(points[0]), matmul),
        f"estimator, batch {_BATCH}": (lambda: estimator(points), matmul),
        "tracker, one step": (lambda: tracker(np.asarray(points[0])), matmul),
        "fast, training step": (training.make("laptop", "fast").call, matmul),
        "HS-Encoder with gradient": (
            lambda: fast_encoder(weights),
            lambda: naive_encoder(weights),
        ),
        "se(3) exp": (lambda: functions["exp"](twists), sines),
        "se(3) log": (lambda: functions["log"](transforms), sines),
        "se(3) gradient": (lambda: functions["exp+log, gradient"](twists), sines),
        "oriented IoU": (iou.call(_PAIRS), matmul),
    }
