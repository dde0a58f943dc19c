"""``bin/benchmark se3``: exponentials and logarithms of many twists, beside jaxlie's."""

from __future__ import annotations

import argparse
import importlib.util
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from benchmarks import timing
from benchmarks.arguments import positive_int
from caper_jax import machine

# How many times as fast as jaxlie.
TARGETS = {"exp": 1.5, "log": 3.0, "exp+log, gradient": 1.5}
_CHECKED = 20_000  # twists that errors are taken over


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--twists", type=positive_int, default=1_000_000, help="(default: %(default)s)"
    )
    parser.add_argument(
        "--repeats", type=positive_int, default=10, help="runs (default: %(default)s)"
    )


def twists(count: int) -> Any:
    """[count, 6] float32 twists, rotation first: angles to 3.1, half of them down to 1e-6."""
    import numpy as np

    rng = np.random.default_rng(0)
    axis = rng.normal(size=(count, 3))
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    angle = np.where(
        np.arange(count) % 2, rng.uniform(0, 3.1, count), 10 ** rng.uniform(-6, 0.49, count)
    )
    return np.concatenate([axis * angle[:, None], rng.normal(size=(count, 3))], -1).astype(
        np.float32
    )


def functions() -> dict[str, Callable[[Any], Any]]:
    """Ours, of twists and of transforms [N, 4, 4]."""
    import jax

    from caper_jax.lie import se3

    def gradient(xi: Any) -> Any:
        return jax.grad(lambda x: (se3.log(se3.exp(x)) * _slope(x)).sum())(xi)

    return {"exp": se3.exp, "log": se3.log, "exp+log, gradient": gradient}


def run(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Times of all twists at once; the largest errors against float64, twists far from pi."""
    import jax
    import numpy as np

    xi = twists(arguments.twists)
    ours = functions()
    # The gradient of <slope, log(exp(xi))> is the slope, whatever computes it.
    with jax.enable_x64(True):
        few = xi[:_CHECKED].astype(np.float64)
        transforms = np.asarray(jax.jit(ours["exp"])(few))
    truth = {"exp": transforms, "log": few, "exp+log, gradient": _slope(few)}
    given = {
        "exp": xi,
        "log": np.asarray(jax.jit(ours["exp"])(xi)),
        "exp+log, gradient": xi,
    }
    theirs = _jaxlie() if importlib.util.find_spec("jaxlie") else {}
    for name, function in ours.items():
        argument = jax.device_put(given[name])
        checked = transforms.astype(np.float32) if name == "log" else given[name][:_CHECKED]
        jitted = {"ours": jax.jit(function)}
        if name in theirs:
            jitted["jaxlie"] = jax.jit(theirs[name])
        calls: dict[str, Callable[[], Any]] = {
            key: partial(f, argument) for key, f in jitted.items()
        }
        calls["reference"] = timing.elementwise()
        medians = timing.interleaved(calls, arguments.repeats)
        errors = {
            key: float(np.abs(np.asarray(f(checked)) - truth[name]).max())
            for key, f in jitted.items()
        }
        yield {
            "function": name,
            "million_per_s": _over(arguments.twists / 1e6, medians["ours"]),
            "in_sines": round(medians["ours"] / medians["reference"], 2),
            "jaxlie_per_s": _over(arguments.twists / 1e6, medians.get("jaxlie")),
            "ours/jaxlie": _over(medians.get("jaxlie"), medians["ours"]),
            "target": TARGETS[name],
            "error": errors["ours"],
            "jaxlie_error": errors.get("jaxlie", "-"),
            "load_average": machine.load_average(),
        }


def _slope(xi: Any) -> Any:
    """Weights [6] that make a scalar of twists, broadcast to their shape."""
    import numpy as np

    return np.broadcast_to(np.array([1.0, -2.0, 0.5, 0.7, -0.3, 1.5], xi.dtype), xi.shape)


def _over(amount: float | None, seconds: float | None) -> Any:
    return "-" if amount is None or seconds is None else round(amount / seconds, 2)


def _jaxlie() -> dict[str, Callable[[Any], Any]]:
    """The same of jaxlie, whose twists begin with the translation."""
    import jax
    import jax.numpy as jnp
    import jaxlie

    def reordered(xi: Any) -> Any:
        return jnp.concatenate([xi[..., 3:], xi[..., :3]], -1)

    def exp(xi: Any) -> Any:
        return jaxlie.SE3.exp(reordered(xi)).as_matrix()

    def log(transform: Any) -> Any:
        return reordered(jaxlie.SE3.from_matrix(transform).log())

    def gradient(xi: Any) -> Any:
        def total(x: Any) -> Any:
            return (reordered(jaxlie.SE3.exp(reordered(x)).log()) * _slope(x)).sum()

        return jax.grad(total)(xi)

    return {"exp": exp, "log": log, "exp+log, gradient": gradient}
