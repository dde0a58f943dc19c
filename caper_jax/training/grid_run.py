"""One program of a grid: trained to its end, in parts where memory is short, and written down."""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.data.types import Batch
from caper_jax.files import write_atomically
from caper_jax.machine import free_bytes
from caper_jax.synthetic.frames import draw_frames
from caper_jax.synthetic.instances import build_bank, draw_instances
from caper_jax.synthetic.sensor import sensor_mix
from caper_jax.training.grid import Banks, Group, Member, make_group, stack
from caper_jax.training.grid_step import MembersStep, group_data, members_mesh, placement
from caper_jax.training.loop import run_steps
from caper_jax.training.member_logs import MemberLogs
from caper_jax.training.statistics import with_own_statistics
from caper_jax.training.step import TrainState
from caper_jax.training.train import SAMPLE, Start, is_complete, start_from, write_run

_DIVERGED_FILE = "diverged.json"
_PROGRAMS = "programs"  # folder of what is being trained: its members and checkpoints
_PROGRAM_FILE = "program.json"
_GIB = 2**30


def interrupted_programs(directory: Path, members: Sequence[Member]) -> list[list[Member]]:
    """The members of programs that were not trained to their end.

    Args:
      directory: of the grid.
      members: of one category; a program that had others, or others' settings, is left out.
    """
    known = {member.name: member for member in members}
    found = []
    for path in sorted((directory / _PROGRAMS).glob(f"*/{_PROGRAM_FILE}")):
        content = json.loads(path.read_text(encoding="utf-8"))
        program = [known[name] for name in content["members"] if name in known]
        if content["parts"] == 1 and path.parent == _folder(directory, program):
            found.append(program)
    return found


def read_diverged(folder: Path) -> int | None:
    """Step by which the member of a folder diverged; None if it did not."""
    path = folder / _DIVERGED_FILE
    return int(json.loads(path.read_text())["step"]) if path.is_file() else None


def _folder(directory: Path, members: Sequence[Member]) -> Path:
    """Of a program; another one for other members or settings."""
    text = "".join(f"{m.name} {sorted(m.settings.items())}" for m in members)
    return directory / _PROGRAMS / hashlib.sha256(text.encode()).hexdigest()[:16]


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


@dataclass(frozen=True)
class ProgramRunner:
    """Trains the members of one program, in parts where memory does not hold them all.

    Attributes:
      directory: of the grid.
      category: of the members.
      banks: the instances that they see.
      initial, memory_gib, devices: see ``train_many``.
      title: of the progress display.
    """

    directory: Path
    category: Category
    banks: Banks
    initial: str | Path | None
    title: str
    memory_gib: float | None
    devices: Sequence[jax.Device] | None

    def train(self, members: Sequence[Member]) -> bool:
        """Trains members to their end; returns False where a stop was requested."""
        folder = _folder(self.directory, members)
        group = make_group(members, self.category, self.banks)
        mesh = members_mesh(len(members), self.devices)
        place = placement(mesh)
        starts = self._starts(group)
        variables = stack([start.variables for start in starts])
        state = jax.device_put(group.initial_state(variables), place)
        step = MembersStep(group, mesh)
        parts = self._parts(folder, step, state)
        if parts > 1:
            size = -(-len(members) // parts)
            chunks = [members[i : i + size] for i in range(0, len(members), size)]
            return all(self.train(chunk) for chunk in chunks)

        logs: list[MemberLogs] = []

        def make_logs(started: int, saved: dict[str, Any] | None) -> MemberLogs:
            logs.append(MemberLogs(members, self.directory, started, saved))
            return logs[0]

        data = group_data(group)
        training = group.config.training
        result = run_steps(folder, training, step, state, lambda _: data, make_logs, self.title)
        if not result.finished:
            return False
        trained = with_own_statistics(result.state, step.statistics, lambda _: data)
        # To the host first: a row of an array on several devices is a program on all of them.
        trained = jax.device_get(trained)
        self._write(members, starts, trained, logs[0].diverged)
        shutil.rmtree(folder)  # what it was needed for is written
        return True

    def _write(
        self,
        members: Sequence[Member],
        starts: Sequence[Start],
        trained: TrainState,
        diverged: Mapping[str, int],
    ) -> None:
        """Writes the models of members that have none yet; of those that diverged, the step."""
        samples: dict[Any, Batch] = {}
        for number, (member, start) in enumerate(zip(members, starts, strict=True)):
            own = self.directory / member.name
            steps = member.config.training.steps
            assert steps is not None
            if is_complete(own, steps):
                continue
            if member.name in diverged:
                text = json.dumps({"step": diverged[member.name]})
                write_atomically(own / _DIVERGED_FILE, text.encode() + b"\n")
                continue
            seen = member.config.data, member.bank
            if seen not in samples:
                samples[seen] = self._sample(member)
            last = jax.tree.map(lambda leaf, n=number: leaf[n], trained)
            write_run(member.config, self.category, own, last, samples[seen], start)

    def _starts(self, group: Group) -> list[Start]:
        """What each member starts from."""
        drawn = jax.device_get(group.initial_variables())
        return [
            start_from(
                jax.tree.map(lambda leaf, n=number: leaf[n], drawn), member.config, self.initial
            )
            for number, member in enumerate(group.members)
        ]

    def _parts(self, folder: Path, step: MembersStep, state: TrainState) -> int:
        """Into how many parts memory splits the members; an interrupted run keeps its answer."""
        path = folder / _PROGRAM_FILE
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
        names = [member.name for member in step.group.members]
        text = json.dumps({"members": names, "parts": parts}, indent=1)
        write_atomically(path, text.encode() + b"\n")
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
