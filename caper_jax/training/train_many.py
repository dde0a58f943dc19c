"""Many trainings side by side: members of a grid, one compiled program per shape of network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import jax

from caper_jax import categories
from caper_jax.articulation.category import Category
from caper_jax.config import RunConfig, to_dict
from caper_jax.errors import CaperError
from caper_jax.models.files import read_card
from caper_jax.training import grid, grid_run
from caper_jax.training.grid import Member
from caper_jax.training.grid_run import ProgramRunner, draw_banks
from caper_jax.training.run_directory import check_configuration
from caper_jax.training.train import describe, is_complete


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
    for kind in {category.name: category for category in known.values()}.values():
        own = [m for m in members if m.config.category == kind.name]
        programs = _programs(directory, own)
        if not programs:
            continue
        banks = draw_banks([m for program in programs for m in program], kind)
        for number, program in enumerate(programs, start=1):
            title = f"training {len(program)} x {kind.name}"
            if len(programs) > 1:
                title += f", program {number} of {len(programs)}"
            runner = ProgramRunner(directory, kind, banks, initial, title, memory_gib, devices)
            if not runner.train(program):
                return [_result(directory, m) for m in members]
    return [_result(directory, m) for m in members]


def _programs(directory: Path, members: Sequence[Member]) -> list[list[Member]]:
    """What is to train: programs that were interrupted as they were, then the other members."""
    waiting = [m for m in members if not _result(directory, m).ended]
    interrupted = [
        program
        for program in grid_run.interrupted_programs(directory, members)
        if any(m in waiting for m in program)
    ]
    taken = [m for program in interrupted for m in program]
    return interrupted + grid.split_into_programs([m for m in waiting if m not in taken])


def _result(directory: Path, member: Member) -> MemberResult:
    """What a member's folder says of it."""
    folder = directory / member.name
    steps = member.config.training.steps
    assert steps is not None
    diverged = grid_run.read_diverged(folder)
    finished = diverged is None and is_complete(folder, steps)
    return MemberResult(member.name, member.config, folder, finished, diverged)
