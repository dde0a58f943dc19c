"""``bin/benchmark grid``: many trainings in one program against the same one after another."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from benchmarks import timing
from benchmarks.arguments import positive_int
from benchmarks.training import make
from caper_jax import machine

_GIB = 2**30


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--category", default="box", help="(default: %(default)s)")
    parser.add_argument("--preset", choices=("fast", "ablation"), default="fast")
    parser.add_argument(
        "--members",
        action="append",
        type=positive_int,
        help="trainings side by side, may be repeated (default: 8)",
    )
    parser.add_argument("--own-data", action="store_true", help="every member draws its own frames")
    parser.add_argument(
        "--steps",
        type=positive_int,
        default=3000,
        help="length of each, by which compilation is shared (default: %(default)s)",
    )
    parser.add_argument(
        "--repeats", type=positive_int, default=10, help="calls (default: %(default)s)"
    )


def run(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """A step of all members against as many steps of a single run, in turn.

    ``times`` is how much faster the grid trains, ``with_compiling`` the same over all steps with
    one compilation each: the single runs are taken to keep their program. All devices of the
    process share the members (``JAX_NUM_CPU_DEVICES``); the single run has one.
    """
    single = make(arguments.category, arguments.preset)
    for count in arguments.members or (8,):
        call, gib, devices, compiling = _grid(arguments, count)
        medians = timing.interleaved({"single": single.call, "grid": call}, arguments.repeats)
        one, all_ = medians["single"], medians["grid"]
        whole = single.compile_seconds + arguments.steps * count * one
        yield {
            "preset": arguments.preset,
            "members": count,
            "data": "own" if arguments.own_data else "shared",
            "devices": devices,
            "single_ms": round(1000 * one, 1),
            "grid_ms": round(1000 * all_, 1),
            "samples_per_s": round(count * single.batch / all_, 1),
            "times": round(count * one / all_, 2),
            "with_compiling": round(whole / (compiling + arguments.steps * all_), 2),
            "compile_s": round(compiling, 1),
            "memory_GiB": round(gib, 2),
            "load_average": machine.load_average(),
        }


def _grid(arguments: argparse.Namespace, count: int) -> tuple[Any, float, int, float]:
    """(call that takes the next step of all members, GiB, devices, seconds of compilation)."""
    import jax
    import numpy as np

    from caper_jax import categories
    from caper_jax.config import preset
    from caper_jax.training import grid, grid_run, grid_step

    category = categories.get(arguments.category)
    config = preset(arguments.preset, category.name)
    config = replace(config, data=replace(config.data, instances=200))
    members = []
    for seed in range(count):
        data_seed = seed if arguments.own_data else 0
        own = replace(config.training, seed=seed, data_seed=data_seed)
        members.append(grid.Member(f"seed{seed}", replace(config, training=own)))
    group = grid.make_group(members, category, grid_run.draw_banks(members, category))
    mesh = grid_step.members_mesh(count)
    state = jax.device_put(
        group.initial_state(group.initial_variables()), grid_step.placement(mesh)
    )
    step, data = grid_step.MembersStep(group, mesh), grid_step.group_data(group)
    began = time.perf_counter()
    needed = step.bytes(state)
    seconds = time.perf_counter() - began
    numbers = np.zeros(1, np.float32), np.ones(1, np.float32)

    def call() -> Any:
        nonlocal state
        state, metrics = step(state, *numbers, data)
        return metrics

    return call, needed / _GIB, 1 if mesh is None else mesh.size, seconds
