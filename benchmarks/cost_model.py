"""Data parallelism on paper: a measured step, and sums over links of a stated speed.

Weak scaling: every device keeps its batch. Gradients are summed around a ring of all devices as
one message, at the speed of the slowest link in it; the statistics of each batch norm, forward and
backward, in messages so small that only the latency of a tree counts, and not at all where batch
norms are local. Nothing overlaps with computation and no device waits for a slower one.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from benchmarks.arguments import positive_float, positive_int
from benchmarks.training import TARGETS
from caper_jax.errors import CaperError

DEVICES = (1, 8, 64)


@dataclass(frozen=True)
class Link:
    """Between two devices.

    Attributes:
      bandwidth: bytes per second in one direction.
      latency: seconds for a message of no bytes.
    """

    bandwidth: float
    latency: float


@dataclass(frozen=True)
class Network:
    """What the devices of a preset tell each other in a step.

    Attributes:
      gradient_bytes: of all gradients, which have the shapes of the weights.
      norms: batch norms.
    """

    gradient_bytes: int
    norms: int


def add_arguments(parser: Any) -> None:
    parser.add_argument(
        "--model",
        action="store_true",
        help=f"efficiency on {', '.join(map(str, DEVICES))} devices, without running on them",
    )
    parser.add_argument(
        "--step-ms",
        type=positive_float,
        help="of one device, with --preset (default: measured on this one)",
    )
    for name, default, text in (
        ("devices-per-node", 8, "that the faster link joins"),
        ("node-bandwidth", 450.0, "GB/s per device and direction within a node, as NVLink"),
        ("node-latency", 3.0, "microseconds of a message within a node, assumed"),
        ("network-bandwidth", 50.0, "GB/s per device between nodes, as InfiniBand NDR"),
        ("network-latency", 10.0, "microseconds of a message between nodes, assumed"),
    ):
        parser.add_argument(
            f"--{name}",
            type=positive_int if isinstance(default, int) else positive_float,
            default=default,
            help=f"{text} (default: %(default)g)",
        )


def run(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """One row per preset and number of devices.

    Raises:
      CaperError: a step's time without the preset it belongs to.
    """
    if arguments.step_ms is not None and arguments.preset is None:
        raise CaperError("--step-ms is the time of one preset: say which with --preset")
    inside = Link(arguments.node_bandwidth * 1e9, arguments.node_latency * 1e-6)
    between = Link(arguments.network_bandwidth * 1e9, arguments.network_latency * 1e-6)
    for preset in (arguments.preset,) if arguments.preset else TARGETS:
        size = arguments.batch or batch_size(preset, arguments.category)
        sums = network(preset, arguments.category)
        if arguments.step_ms is None:
            step = measured_step(arguments.category, preset, size, arguments.repeats)
        else:
            step = arguments.step_ms / 1000
        for devices in DEVICES:
            link = inside if devices <= arguments.devices_per_node else between
            gradients = ring_seconds(sums.gradient_bytes, devices, link)
            norms = 2 * sums.norms * tree_seconds(devices, link)
            whole = step + gradients + norms
            yield {
                "preset": preset,
                "devices": devices,
                "batch_each": size,
                "step_ms": round(1000 * step, 2),
                "gradients_MB": round(sums.gradient_bytes / 1e6, 3),
                "all_reduce_ms": round(1000 * gradients, 3),
                "batch_norms": sums.norms,
                "norms_ms": round(1000 * norms, 3),
                "samples_per_s": round(devices * size / whole, 1),
                "efficiency_%": round(100 * step / whole, 1),
                "batch_norms_local_%": round(100 * step / (step + gradients), 1),
            }


def ring_seconds(size: int, devices: int, link: Link) -> float:
    """Of an all-reduce around a ring: 2 (n - 1) turns, each with an n-th of the bytes."""
    turns = 2 * (devices - 1)
    return turns * (size / devices / link.bandwidth + link.latency)


def tree_seconds(devices: int, link: Link) -> float:
    """Of an all-reduce of a few bytes: up a binary tree and down again."""
    return 2 * math.ceil(math.log2(devices)) * link.latency


def batch_size(preset: str, category: str) -> int:
    """Samples per step of a preset."""
    from caper_jax.training import train as training

    return training.preset(preset, category).training.batch_size


def network(preset: str, category: str) -> Network:
    """What a preset's devices sum, from the shapes of its weights."""
    import jax

    from caper_jax import categories
    from caper_jax import config as presets
    from caper_jax.config import LossConfig
    from caper_jax.training.objective import Objective

    task = Objective(categories.get(category), presets.preset(preset).network, LossConfig())
    shapes = jax.eval_shape(task.init, jax.random.key(0))
    gradients = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(shapes["params"]))
    # A mean and a variance each.
    return Network(gradients, len(jax.tree.leaves(shapes["batch_stats"])) // 2)


def measured_step(category: str, preset: str, batch: int, repeats: int) -> float:
    """Median seconds of the training step on this device."""
    from benchmarks import timing, training

    call = training.make(category, preset, batch).call
    return timing.interleaved({"step": call}, repeats)["step"]
