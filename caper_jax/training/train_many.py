"""Many trainings side by side: members of a grid, one compiled program per shape of network."""

from __future__ import annotations

import hashlib
import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from caper_jax import categories
from caper_jax.articulation.category import Category
from caper_jax.config import RunConfig, to_dict
from caper_jax.data.types import Batch
from caper_jax.errors import CaperError
from caper_jax.files import write_atomically
from caper_jax.machine import free_bytes
from caper_jax.models.files import read_card
from caper_jax.synthetic.frames import draw_frames
from caper_jax.synthetic.instances import build_bank, draw_instances
from caper_jax.synthetic.sensor import sensor_mix
from caper_jax.training import grid, grid_step
from caper_jax.training.grid import Banks, Group, Member
from caper_jax.training.loop import run_steps
from caper_jax.training.member_logs import MemberLogs
from caper_jax.training.run_directory import check_configuration
from caper_jax.training.statistics import with_own_statistics
from caper_jax.training.step import TrainState
from caper_jax.training.train import (
    SAMPLE,
    Start,
    describe,
    is_complete,
    start_from,
    write_run,
)

PyTree = Any
DIVERGED_FILE = "diverged.json"
_PROGRAMS = "programs"  # folder of the checkpoints of what is trained together
_SPLIT_FILE = "split.json"
_GIB = 2**30


@dataclass(frozen=True)
class MemberResult:
    """What became of one member.

    Attributes:
      name: of the member.
      config: its run.
      directory: a model directory, as ``train`` leaves it, where the member is ``finished``.
      finished: whether its model is there; False after a stop, and for one that diverged.
      diverged: step up to which its loss or gradient was not finite for
        ``training.max_bad_steps`` steps in a row; None for one that did not diverge.
    """

    name: str
    config: RunConfig
    directory: Path
    finished: bool
    diverged: int | None = None

    @property
    def ended(self) -> bool:
        """Whether there is nothing left to train."""
        return self.finished or self.diverged is not None


def train_many(
    configs: Mapping[str, RunConfig],
    directory: str | Path,
    initial: str | Path | None = None,
    category: Category | None = None,
    *,
    one_program: bool = False,
    memory_gib: float | None = None,
    devices: Sequence[jax.Device] | None = None,
) -> list[MemberResult]:
    """Trains many runs side by side; each ends as ``train`` with its config would, to rounding.

    Members that differ in numbers only (seeds, learning rates, weights of losses, noise, rates of
    disturbances) share one compiled program, in which a vmap runs over them; several devices share
    them evenly. What changes shapes gets a program of its own, one after the other. Members with
    equal ``training.data_seed`` and data section see the same frames in the same order, which are
    then generated once. A member whose loss stays non-finite is reported and does not touch the
    others. The same call resumes a grid that was stopped or killed; members may be added to one
    that has finished.

    Args:
      configs: {name: run}; names are those of the folders, and may hold slashes. Bounded by steps,
        on generated frames.
      directory: gets one run directory per member, and programs/ with the checkpoints.
      initial: as for ``train``, for every member.
      category: as for ``train``; then all members are of it.
      one_program: refuse members that no single program can train, rather than split them.
      memory_gib: memory that a program may need; by default four fifths of what is free. Members
        beyond it are trained one part after the other.
      devices: that share the members of a program evenly; by default all of this process.

    Returns:
      One result per member, in order.

    Raises:
      CaperError: no members, two with the same settings, one on a dataset or bounded by minutes,
        one whose folder holds another run, or, with ``one_program``, settings that change shapes;
        every member diverged.

    Example:
      config = preset("ablation", "box")
      runs = {f"seed{s}": override(config, f"training.seed={s}") for s in range(8)}
      train_many(runs, "runs/seeds")
    """
    if jax.process_count() > 1:
        raise CaperError("train_many runs in one process; give it several devices instead")
    if not configs:
        raise CaperError("nothing to train: no members")
    known = {
        name: categories.get(config.category) if category is None else category
        for name, config in configs.items()
    }
    members = [
        Member(name, replace(config, category=known[name].name)) for name, config in configs.items()
    ]
    grid.check_members(members)
    if one_program:
        grid.check_one_program(members)
    directory = Path(directory)
    card = None if initial is None else read_card(initial)
    for member in members:
        training = to_dict(member.config)["training"]
        description = {"training": training, **describe(member.config, card)}
        check_configuration(directory / member.name, description)
    waiting = [m for m in members if not _result(directory, m).ended]
    for kind in {known[m.name].name: known[m.name] for m in waiting}.values():
        own = [m for m in waiting if m.config.category == kind.name]
        banks = draw_banks(own, kind)
        programs = grid.split_into_programs(own)
        for number, program in enumerate(programs, start=1):
            title = f"training {len(program)} x {kind.name}"
            if len(programs) > 1:
                title += f", program {number} of {len(programs)}"
            runner = _Runner(directory, kind, banks, initial, title, memory_gib, devices)
            if not runner.train(program):
                return [_result(directory, m) for m in members]
    return [_result(directory, m) for m in members]


def draw_banks(members: Sequence[Member], category: Category) -> Banks:
    """The instances that members see, in arrays of equal shapes."""
    different = list(dict.fromkeys(member.bank for member in members))
    drawn = [draw_instances(category, count, "train", seed) for seed, count in different]
    # Packed together: how many solids of a kind an instance may have differs between seeds.
    together = jax.tree.map(
        jnp.asarray, build_bank([model for models in drawn for model in models])
    )
    ends = np.cumsum([len(models) for models in drawn]).tolist()
    starts = [0, *ends[:-1]]
    return {
        bank: jax.tree.map(lambda leaf, i=start, j=end: leaf[i:j], together)
        for bank, start, end in zip(different, starts, ends, strict=True)
    }


def _result(directory: Path, member: Member) -> MemberResult:
    """What a member's folder says of it."""
    folder = directory / member.name
    steps = member.config.training.steps
    assert steps is not None
    diverged = None
    if (folder / DIVERGED_FILE).is_file():
        diverged = int(json.loads((folder / DIVERGED_FILE).read_text())["step"])
    finished = diverged is None and is_complete(folder, steps)
    return MemberResult(member.name, member.config, folder, finished, diverged)


@dataclass(frozen=True)
class _Runner:
    """Trains the members of one program, in parts where memory does not hold them all."""

    directory: Path
    category: Category
    banks: Banks
    initial: str | Path | None
    title: str
    memory_gib: float | None
    devices: Sequence[jax.Device] | None

    def train(self, members: Sequence[Member]) -> bool:
        """Trains members to their end; returns False where a stop was requested."""
        text = "".join(f"{m.name} {sorted(m.settings.items())}" for m in members)
        folder = self.directory / _PROGRAMS / hashlib.sha256(text.encode()).hexdigest()[:16]
        group = grid.make_group(members, self.category, self.banks)
        mesh = grid_step.members_mesh(len(members), self.devices)
        place = grid_step.placement(mesh)
        starts = self._starts(group)
        variables = _stack([start.variables for start in starts])
        state = jax.device_put(group.initial_state(variables), place)
        step = grid_step.MembersStep(group, mesh)
        parts = self._parts(folder, step, state)
        if parts > 1:
            size = -(-len(members) // parts)
            chunks = [members[i : i + size] for i in range(0, len(members), size)]
            return all(self.train(chunk) for chunk in chunks)

        logs: list[MemberLogs] = []

        def make_logs(started: int, saved: dict[str, Any] | None) -> MemberLogs:
            logs.append(MemberLogs(members, self.directory, started, saved))
            return logs[0]

        data = grid_step.group_data(group)
        training = group.config.training
        result = run_steps(folder, training, step, state, lambda _: data, make_logs, self.title)
        if not result.finished:
            return False
        trained = with_own_statistics(result.state, step.statistics, lambda _: data)
        diverged = logs[0].diverged
        samples: dict[Any, Batch] = {}
        for number, (member, start) in enumerate(zip(members, starts, strict=True)):
            own = self.directory / member.name
            if member.name in diverged:
                text = json.dumps({"step": diverged[member.name]})
                write_atomically(own / DIVERGED_FILE, text.encode() + b"\n")
                continue
            seen = member.config.data, member.bank
            if seen not in samples:
                samples[seen] = self._sample(member)
            last = jax.tree.map(lambda leaf, n=number: leaf[n], trained)
            write_run(member.config, self.category, own, last, samples[seen], start)
        return True

    def _starts(self, group: Group) -> list[Start]:
        """What each member starts from."""
        drawn = jax.device_get(group.initial_variables())
        return [
            start_from(
                jax.tree.map(lambda leaf, n=number: leaf[n], drawn), member.config, self.initial
            )
            for number, member in enumerate(group.members)
        ]

    def _parts(self, folder: Path, step: grid_step.MembersStep, state: TrainState) -> int:
        """Into how many parts memory splits the members; an interrupted run keeps its answer."""
        path = folder / _SPLIT_FILE
        if path.is_file():
            return int(json.loads(path.read_text())["parts"])
        need, free = step.bytes(state), free_bytes()
        limit = None if free is None else 0.8 * free
        if self.memory_gib is not None:
            limit = self.memory_gib * _GIB
        count = len(step.group.members)
        parts = 1 if limit is None else min(math.ceil(need / limit), count)
        said = f"{self.title}: a step needs about {need / _GIB:.2f} GiB"
        if limit is not None:
            said += f" of {limit / _GIB:.1f}"
        print(said + (f"; in {parts} parts" if parts > 1 else ""), file=sys.stderr)
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(path, json.dumps({"parts": parts}).encode() + b"\n")
        return parts

    def _sample(self, member: Member) -> Batch:
        """Frames like those that a member was trained on."""
        data = member.config.data
        draw = jax.jit(
            partial(
                draw_frames,
                batch_size=SAMPLE,
                category=self.category,
                config=data,
                mix=sensor_mix(data.noise),
            )
        )
        return draw(jax.random.key(member.config.training.stream), bank=self.banks[member.bank])


def _stack(trees: Sequence[PyTree]) -> PyTree:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)
