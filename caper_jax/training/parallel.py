"""Data parallelism over devices and processes: one mesh axis, replicated weights.

A step compiled over a mesh computes what one device computes with the same global batch (batch
norm included: its means run over the global batch), or, with ``each_device``, the mean of what each
device computes on its own rows. Random batches are drawn inside the step from the step's key; JAX's
generator is partitionable, so they do not depend on the number of devices.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.sharding import AxisType, NamedSharding, PartitionSpec

from caper_jax.errors import CaperError

PyTree = Any
DATA_AXIS = "data"


def initialize(coordinator: str, num_processes: int, process_id: int) -> None:
    """Join this process to the others of a run; call before any other use of JAX.

    Args:
      coordinator: "host:port" of process 0, the same for all.
      num_processes: processes in all.
      process_id: index of this one, 0 to num_processes - 1.

    Raises:
      CaperError: the index is out of range, or the others cannot be reached.
    """
    if not 0 <= process_id < num_processes:
        raise CaperError(f"process id {process_id} is not in 0..{num_processes - 1}")
    # Collectives between processes on CPU; without effect on accelerators.
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    try:
        jax.distributed.initialize(coordinator, num_processes, process_id)
    except (RuntimeError, ValueError) as error:
        raise CaperError(
            f"process {process_id} of {num_processes} cannot join {coordinator}: {error}"
        ) from error


def data_mesh(devices: Sequence[jax.Device] | None = None) -> jax.sharding.Mesh:
    """Mesh of all devices of all processes (or of those given) along one axis, "data"."""
    devices = jax.devices() if devices is None else devices
    return jax.make_mesh(
        (len(devices),), (DATA_AXIS,), axis_types=(AxisType.Auto,), devices=devices
    )


def replicated(mesh: jax.sharding.Mesh) -> NamedSharding:
    """The sharding of weights: a full copy on each device."""
    return NamedSharding(mesh, PartitionSpec())


def batch_sharding(mesh: jax.sharding.Mesh) -> NamedSharding:
    """The sharding of batches: the leading axis split over the mesh."""
    return NamedSharding(mesh, PartitionSpec(DATA_AXIS))


def one_device() -> jax.sharding.Sharding:
    """The sharding of everything in a run without a mesh: the first device of this process."""
    return jax.sharding.SingleDeviceSharding(jax.local_devices()[0])


def check_batch_size(batch_size: int, mesh: jax.sharding.Mesh | None) -> None:
    """Raise a CaperError if the global batch cannot be split evenly over the mesh."""
    if mesh is not None and batch_size % mesh.size:
        raise CaperError(
            f"batch_size {batch_size} cannot be split over {mesh.size} devices; "
            f"use a multiple of {mesh.size}"
        )


def constrain_batch(batch: PyTree, mesh: jax.sharding.Mesh) -> PyTree:
    """Inside jit: split every leaf of a batch along its leading axis (scalars are replicated)."""

    def constrain(leaf: jax.Array) -> jax.Array:
        sharding = batch_sharding(mesh) if leaf.ndim else replicated(mesh)
        return jax.lax.with_sharding_constraint(leaf, sharding)

    return jax.tree.map(constrain, batch)


def each_device(function: Callable[..., PyTree], mesh: jax.sharding.Mesh) -> Callable[..., PyTree]:
    """Inside jit: the mean over the mesh of what a function gives for each device's own rows.

    Batch norm then sees one device's rows, and all that crosses between devices is one sum of the
    results at the end, whatever the number of layers.

    Args:
      function: ``(params, model_state, batch, key, progress) -> floating-point arrays``. On each
        device the batch is its rows (scalars are replicated) and the key one of its own.
    """

    def own(params: PyTree, model_state: PyTree, batch: PyTree, key: jax.Array, progress: PyTree):
        key = jax.random.fold_in(key, jax.lax.axis_index(DATA_AXIS))
        flat, unravel = ravel_pytree(function(params, model_state, batch, key, progress))
        return unravel(jax.lax.pmean(flat, DATA_AXIS))

    def mean(params: PyTree, model_state: PyTree, batch: PyTree, key: jax.Array, progress: PyTree):
        everywhere = PartitionSpec()
        rows = jax.tree.map(lambda x: PartitionSpec(DATA_AXIS) if x.ndim else everywhere, batch)
        # Results are the same everywhere after the sum; custom gradients hide that from the check.
        return jax.shard_map(
            own,
            mesh=mesh,
            in_specs=(everywhere, everywhere, rows, everywhere, everywhere),
            out_specs=everywhere,
            check_vma=False,
        )(params, model_state, batch, key, progress)

    return mean


def place(tree: PyTree, sharding: jax.sharding.Sharding) -> PyTree:
    """Put host values, the same on every process, on the devices; each takes its own part.

    Args:
      tree: numpy arrays or fully addressable jax arrays, global shapes.
      sharding: `replicated`, `batch_sharding` or `one_device`.
    """

    def put(leaf: Any) -> jax.Array:
        value = np.asarray(leaf)
        return jax.make_array_from_callback(value.shape, sharding, lambda index: value[index])

    return jax.tree.map(put, tree)


def place_rows(tree: PyTree, mesh: jax.sharding.Mesh) -> PyTree:
    """The global batch from each process's own rows of it, numpy arrays [B / processes, ...]."""
    sharding = batch_sharding(mesh)
    return jax.tree.map(
        lambda leaf: jax.make_array_from_process_local_data(sharding, np.asarray(leaf)), tree
    )


def agree(values: Sequence[float]) -> list[float]:
    """What process 0 holds, on every process: decisions that hang on a clock or a signal."""
    if jax.process_count() == 1:
        return [float(v) for v in values]
    from jax.experimental import multihost_utils

    # float32 on the wire unless x64 is on: enough for seconds and flags.
    shared = multihost_utils.broadcast_one_to_all(np.asarray(values, np.float32))
    return [float(v) for v in np.asarray(shared)]
