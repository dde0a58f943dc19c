"""``caper benchmark profile``: what takes the time in one estimate and in one step of tracking."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks import timing
from caper_jax import machine
from caper_jax.cli import common
from caper_jax.config import RefinerConfig

_POINTS = 3000  # of a cloud as it comes from a camera
# Stage -> what is timed for it, and what of that belongs to another stage.
ESTIMATOR = {
    "sampling": ("sampling",),
    "viewing frame": ("view",),
    "stage I: encoder": ("root encoder",),
    "stage I: heads": ("root", "root encoder"),
    "stage II, twice: encoder": ("parts encoder",),
    "stage II, twice: heads": ("parts", "parts encoder"),
    "sides of boxes": ("networks", "networks without sides"),
}
TRACKER = {
    "sampling": ("sampling",),
    "stage II on the predicted pose": ("stage II",),
    "registration": ("step", "step without registration"),
    "energy of the keyframe": ("energy",),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--category", default="laptop", help="(default: %(default)s)")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the rows there (PNG)")
    parser.add_argument(
        "--repeats", type=common.positive_int, default=50, help="runs (default: %(default)s)"
    )


def run(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Parts of the chain compiled apart and timed in turn; the rest is what remains."""
    if arguments.plot is not None:
        common.check_folder(arguments.plot.parent, "--plot")
    estimator, estimator_calls, tracker_calls = _calls(arguments.category)
    rows = []
    for chain, parts, calls in (
        ("estimator", ESTIMATOR, estimator_calls),
        ("tracker", TRACKER, tracker_calls),
    ):
        for row in stages(chain, parts, timing.interleaved(calls, arguments.repeats)):
            rows.append(row)
            yield {**row, "stage": f"{row['stage']:<40}", "load_average": machine.load_average()}
    if arguments.plot is not None:
        _draw(arguments.plot, rows, estimator.category.name)


def stages(
    chain: str, parts: Mapping[str, Sequence[str]], medians: Mapping[str, float]
) -> list[dict[str, Any]]:
    """Time and share of each stage, and the rest of "whole".

    Args:
      chain: name of the whole.
      parts: by stage, what was timed for it, and what of that is not its own.
      medians: seconds by what was timed.
    """
    whole = medians["whole"]
    own = {
        stage: max(medians[timed] - sum(medians[name] for name in others), 0.0)
        for stage, (timed, *others) in parts.items()
    }
    own["rest"] = max(whole - sum(own.values()), 0.0)
    return [
        {
            "chain": chain,
            "stage": stage,
            "ms": round(1000 * seconds, 2),
            "share_%": round(100 * seconds / whole, 1),
        }
        for stage, seconds in own.items()
    ]


def _calls(name: str) -> tuple[Any, dict[str, Callable[[], Any]], dict[str, Callable[[], Any]]]:
    """The estimator, and what to time of it and of its tracker."""
    import dataclasses
    from functools import partial

    import jax
    import jax.numpy as jnp
    import numpy as np

    from benchmarks.models import clouds
    from caper_jax.data.clouds import sample_points
    from caper_jax.estimator import estimate, load
    from caper_jax.geometry.frames import rotate, view_rotation
    from caper_jax.models.encoders import make_encoder
    from caper_jax.models.parts import PartsNetwork
    from caper_jax.models.root import RootNetwork
    from caper_jax.tracker import Tracker, config_for
    from caper_jax.tracking.keyframes import chamfer_energy
    from caper_jax.tracking.measurement import measure

    estimator = load(name)
    category, network = estimator.category, estimator.network
    raw = clouds(category, 1, _POINTS)[0]
    points = jax.device_put(sample_points(raw, network.num_points).points[None])
    unit = category.unit
    bare = dataclasses.replace(network, refiner=RefinerConfig())
    networks, without_sides = (
        jax.jit(partial(estimate, category=category, network=config)) for config in (network, bare)
    )

    @jax.jit
    def view(x: Any) -> Any:
        return rotate(view_rotation(x), x) * unit

    def stage(module: Any, *path: str) -> Callable[[], Any]:
        def own(tree: Any) -> Any:
            for key in path:
                tree = tree.get(key, {})
            return tree

        variables = {name: own(tree) for name, tree in estimator.variables.items()}
        function = jax.jit(partial(module.apply, train=False))
        cloud = view(points)
        return lambda: function(variables, cloud)

    # Built outside of a network, the encoder needs no name: its weights lie at the top.
    encoder = make_encoder(network).clone(name=None)
    single = {
        "sampling": lambda: estimator.sampled(raw),
        "view": lambda: view(points),
        "root encoder": stage(encoder, "root", "encoder"),
        "root": stage(RootNetwork(network), "root"),
        "parts encoder": _twice(stage(encoder, "parts", "encoder")),
        "parts": _twice(stage(PartsNetwork(network, category.num_parts), "parts")),
        "networks": lambda: networks(estimator.variables, points),
        "networks without sides": lambda: without_sides(estimator.variables, points),
        "whole": lambda: estimator(raw),
    }

    # Without keyframes: what every frame costs.
    config = dataclasses.replace(config_for(estimator), policy="fixed", interval=10**6)
    alone = dataclasses.replace(
        config, registration=dataclasses.replace(config.registration, steps=0)
    )
    trackers = {key: Tracker(estimator, c) for key, c in (("whole", config), ("alone", alone))}
    pose = estimator(raw).pose
    states = {}
    for key, tracker in trackers.items():
        tracker.reset(raw, pose.rotation, pose.translation)
        states[key] = tracker.state
    frame = jax.device_put(trackers["whole"].observe(raw))
    half = points[0, ::2] * unit
    labels = jnp.zeros(len(half), jnp.int32)
    stage_two = jax.jit(partial(measure, category=category, network=network))
    energy = jax.jit(partial(chamfer_energy, num_parts=category.num_parts))
    root = states["whole"].root
    one = jnp.ones(())

    def step(key: str) -> Callable[[], Any]:
        return lambda: trackers[key].step(estimator.variables, states[key], frame)

    track = {
        "sampling": lambda: trackers["whole"].observe(raw),
        "stage II": lambda: stage_two(
            estimator.variables, frame.points * np.float32(unit), frame.labels, root
        ),
        "energy": lambda: energy(half, labels, half, labels, size=one),
        "whole": lambda: trackers["whole"].step(
            estimator.variables, states["whole"], trackers["whole"].observe(raw)
        ),
        "step without registration": step("alone"),
        "step": step("whole"),
    }
    return estimator, single, track


def _twice(call: Callable[[], Any]) -> Callable[[], Any]:
    return lambda: (call(), call())


def _draw(path: Path, rows: Sequence[Mapping[str, Any]], category: str) -> None:
    """One bar per chain, a segment per stage."""
    from matplotlib import colormaps
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from caper_jax.visualization.figures import save_figure

    chains = list(dict.fromkeys(row["chain"] for row in rows))
    figure = Figure(figsize=(9, 1.2 + 1.9 * len(chains)), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(chains), 1, squeeze=False)[:, 0]
    for axes, chain in zip(grid, chains, strict=True):
        own = [row for row in rows if row["chain"] == chain]
        for number, row in enumerate(own):
            axes.barh(row["stage"], row["ms"], color=colormaps["tab10"](number % 10))
            axes.text(row["ms"], row["stage"], f" {row['ms']:.2f} ms", va="center", fontsize=8)
        total = sum(row["ms"] for row in own)
        axes.set_title(f"{chain}, {category}: {total:.1f} ms", fontsize=10, loc="left")
        axes.invert_yaxis()
        axes.margins(x=0.15)
        axes.tick_params(labelsize=8)
        axes.spines[["top", "right"]].set_visible(False)
    save_figure(figure, path, dpi=100)
