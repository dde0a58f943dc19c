"""The compiled step of a grid: all members of a program under one vmap, shared among devices."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec
from jaxtyping import Array, Float

from caper_jax.data.types import Batch
from caper_jax.synthetic.frames import draw_frames
from caper_jax.training import memory
from caper_jax.training.grid import Group, Streams, with_numbers
from caper_jax.training.objective import Objective
from caper_jax.training.optimizer import Optimizer
from caper_jax.training.statistics import updated_statistics
from caper_jax.training.step import TrainState, compiler_options, data_key, in_turn, train_step

PyTree = Any
Metrics = dict[str, Array]
_AXIS = "members"
EVERYWHERE, SPLIT = PartitionSpec(), PartitionSpec(_AXIS)


class MembersStep:
    """One or several steps of all M members of a group.

    Called as ``step(state, progress, factor, data)``, as what ``step.compile_step`` gives: the
    states [M, ...] are donated, ``progress`` and ``factor`` are [n], ``data`` is of ``group_data``;
    metrics are [n, M]. Compiled once per n.

    Args:
      group: what to train.
      mesh: shares the members among its devices; their number divides M.
      chunk: members under one vmap on a device, the others follow; by default all, and on a CPU one
        where members have several devices, else two: all at once would leave its caches.
    """

    def __init__(
        self, group: Group, mesh: jax.sharding.Mesh | None = None, chunk: int | None = None
    ) -> None:
        self.group = group
        self._mesh = mesh
        self._device = jax.local_devices()[0] if mesh is None else mesh.devices.flat[0]
        if chunk is None and self._device.platform == "cpu":
            chunk = 2 if mesh is None else 1
        self._chunk = chunk
        self._jitted = self._jit()
        self._statistics = self._jit_statistics()
        self._compiled: dict[int, Any] = {}

    def __call__(
        self,
        state: TrainState,
        progress: Float[Any, " n"],
        factor: Float[Any, " n"],
        data: PyTree,
    ) -> tuple[TrainState, Metrics]:
        return self._program(state, progress, factor, data)(state, progress, factor, data)

    def bytes(self, state: TrainState) -> float:
        """Memory that a call needs on all devices together, its arguments included."""
        count = self.group.config.training.steps_per_dispatch
        zeros = np.zeros(count, np.float32)
        use = self._program(state, zeros, zeros, group_data(self.group)).memory_analysis()
        if use is None:  # of a backend that does not say
            return 0.0
        own = use.argument_size_in_bytes + use.output_size_in_bytes - use.alias_size_in_bytes
        return (own + use.temp_size_in_bytes) * (1 if self._mesh is None else self._mesh.size)

    def statistics(
        self, model_state: PyTree, weights: PyTree, seed: Array, step: Array, data: PyTree
    ) -> PyTree:
        """Collections [M, ...] of the exported weights, see ``statistics.with_own_statistics``."""
        return self._statistics(model_state, weights, seed, step, data)

    def _program(self, state: TrainState, progress: Any, factor: Any, data: PyTree) -> Any:
        count = progress.shape[0]
        if count not in self._compiled:
            lowered = self._jitted.lower(state, progress, factor, data)
            self._compiled[count] = lowered.compile()
        return self._compiled[count]

    def _jit(self) -> Any:
        group, sharing = self.group, self.group.sharing
        config, category = group.config, group.category
        transform = memory.value_and_grad if config.training.save_memory else jax.value_and_grad

        def member(state: TrainState, numbers: Metrics, batch: PyTree, progress, factor):
            own = with_numbers(config, numbers)
            return train_step(
                state,
                batch,
                progress,
                factor,
                loss_fn=Objective(category, own.network, own.loss),
                optimizer=Optimizer.of(own.training),
                value_and_grad=transform,
            )

        def one(state: TrainState, progress, factor, data: PyTree):
            streams, numbers, stream_of = data
            step = state.step[0]  # that of all members
            batch = draw_batches(group, streams, step, stream_of)
            axis = None if sharing == "all" else 0

            def own(state: TrainState, numbers: Metrics, batch: PyTree):
                return member(state, numbers, batch, progress, factor)

            return over_members(own, (state, numbers), batch, axis, self._chunk)

        return jax.jit(
            on_devices(
                in_turn(one),
                group,
                self._mesh,
                (SPLIT, EVERYWHERE, EVERYWHERE),
                (SPLIT, PartitionSpec(None, _AXIS)),
            ),
            donate_argnums=0,
            compiler_options=compiler_options(self._device.platform),
        )

    def _jit_statistics(self) -> Any:
        group = self.group
        config = group.config
        axis = None if group.sharing == "all" else 0

        def member(model_state, weights, seed, numbers: Metrics, step, batch):
            own = with_numbers(config, numbers)
            objective = Objective(group.category, own.network, own.loss)
            return updated_statistics(model_state, weights, seed, step, batch, objective)

        def run(model_state: PyTree, weights: PyTree, seed: Array, step: Array, data: PyTree):
            streams, numbers, stream_of = data
            batch = draw_batches(group, streams, step, stream_of)

            def own(state: tuple[PyTree, PyTree, Array], numbers: Metrics, batch: PyTree):
                return member(*state, numbers, step, batch)

            states = (model_state, weights, seed)
            return over_members(own, (states, numbers), batch, axis, self._chunk)

        return jax.jit(on_devices(run, group, self._mesh, (SPLIT, SPLIT, SPLIT, EVERYWHERE), SPLIT))


def on_devices(
    function: Any,
    group: Group,
    mesh: jax.sharding.Mesh | None,
    in_specs: tuple[PartitionSpec, ...],
    out_specs: Any,
) -> Any:
    """A function of members with each device's own on it; unchanged without a mesh.

    Args:
      function: its last argument is ``group_data``.
      group: of the members.
      mesh: from ``members_mesh``.
      in_specs: of the other arguments.
      out_specs: of the result.
    """
    if mesh is None:
        return function
    streams = SPLIT if group.sharing == "own" else EVERYWHERE
    # Custom gradients hide from the check what is the same on all devices.
    return jax.shard_map(
        function,
        mesh=mesh,
        in_specs=(*in_specs, (streams, SPLIT, SPLIT)),
        out_specs=out_specs,
        check_vma=False,
    )


def over_members(
    function: Callable[..., PyTree],
    members: tuple[PyTree, ...],
    batch: PyTree,
    axis: int | None,
    chunk: int | None,
) -> PyTree:
    """``function(*member, batch)`` for all members: under vmap, or so many at a time.

    Args:
      function: of one member.
      members: arguments with a leading axis of members.
      batch: one for all (``axis`` None), or one for each (0).
      axis: see ``batch``.
      chunk: members at a time; None for all.
    """
    count = len(jax.tree.leaves(members)[0])
    if chunk is None or chunk >= count:
        axes = (*(0 for _ in members), axis)
        return jax.vmap(function, in_axes=axes)(*members, batch)
    size = None if chunk == 1 else chunk
    if axis is None:
        return jax.lax.map(lambda own: function(*own, batch), members, batch_size=size)
    return jax.lax.map(lambda own: function(*own), (*members, batch), batch_size=size)


def draw_batches(
    group: Group, streams: Streams, step: Array, stream_of: Array | None = None
) -> Batch:
    """What the members see in a step: one batch for all, or one for each, on a leading axis.

    Args:
      group: of the members.
      streams: its own, of which a device may hold a part.
      step: [] its number.
      stream_of: which stream each member sees, where some share one; by default the group's.
    """
    config = group.config

    def draw(streams: Streams) -> Batch:
        return draw_frames(
            data_key(streams.seed, step),
            config.training.batch_size,
            group.category,
            with_numbers(config, streams.rates).data,
            streams.mix,
            streams.bank,
        )

    if group.sharing == "all":
        return draw(streams)
    batches = jax.vmap(draw)(streams)
    if group.sharing == "own":
        return batches
    stream_of = jnp.asarray(group.stream_of) if stream_of is None else stream_of
    return jax.tree.map(lambda leaf: leaf[stream_of], batches)


def group_data(group: Group) -> tuple[Streams, Metrics, Array]:
    """What the step of a group takes besides its state."""
    numbers = jax.tree.map(jnp.asarray, group.numbers)
    return group.streams, numbers, jnp.asarray(group.stream_of)


def members_mesh(
    count: int, devices: Sequence[jax.Device] | None = None
) -> jax.sharding.Mesh | None:
    """As many devices as can have equally many of ``count`` members; None for one.

    Args:
      count: of members.
      devices: to choose from, in order; by default all of this process.
    """
    devices = jax.local_devices() if devices is None else list(devices)
    usable = max(n for n in range(1, len(devices) + 1) if count % n == 0)
    return jax.sharding.Mesh(np.array(devices[:usable]), (_AXIS,)) if usable > 1 else None


def placement(mesh: jax.sharding.Mesh | None) -> jax.sharding.Sharding:
    """Where the states of a group lie."""
    if mesh is None:
        return jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    return NamedSharding(mesh, SPLIT)
