"""Which trainings fit into one program, and what it takes to train them there.

Members whose settings differ only in numbers (rates, weights, seeds, shares) share a program, in
which those numbers are traced. What changes shapes or the course of the computation asks for a
program of its own.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, TypeVar

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict
from jaxtyping import Array, Shaped, UInt

from caper_jax.articulation.category import Category
from caper_jax.config import (
    STATIC_LOSS,
    GeneratorConfig,
    LossConfig,
    LossWeights,
    RefinerConfig,
    RunConfig,
    TrainingConfig,
    to_dict,
)
from caper_jax.errors import CaperError
from caper_jax.synthetic.instances import InstanceBank
from caper_jax.synthetic.sensor import Sensor, sensor_mix
from caper_jax.training.objective import Objective
from caper_jax.training.optimizer import Optimizer
from caper_jax.training.step import TrainState

T = TypeVar("T")
PyTree = Any

# Numbers that may differ within a program.
RATES = tuple(
    f"data.{field.name}"
    for field in dataclasses.fields(GeneratorConfig)
    if isinstance(field.default, float)
)
NUMBERS = (
    *(f"training.{name}" for name in ("learning_rate", "clip_norm", "weight_decay")),
    *(f"loss.weights.{field.name}" for field in dataclasses.fields(LossWeights)),
    *(
        f"loss.{field.name}"
        for field in dataclasses.fields(LossConfig)
        if field.name not in (*STATIC_LOSS, "weights")
    ),
    *RATES,
)
_SEEDS = ("training.seed", "training.data_seed")
# What happens after training, or beside it.
_BESIDE = ("calibration_frames", "network.refiner.")


@dataclass(frozen=True)
class Member:
    """One training of a grid.

    Attributes:
      name: of its folder.
      config: its run, bounded by steps.
    """

    name: str
    config: RunConfig

    @property
    def settings(self) -> dict[str, Any]:
        """Its settings, {"section.key": value}."""
        return flatten_dict(to_dict(self.config), keep_empty_nodes=True, sep=".")

    @property
    def bank(self) -> tuple[int, int]:
        """Which instances it sees: (seed of their draws, how many)."""
        return self.config.training.stream, self.config.data.instances

    @property
    def program(self) -> dict[str, Any]:
        """The settings that another member must share to be trained by the same program.

        Of a disturbance's rate, whether there is such a disturbance; of sensors, how many.
        """
        kept = {}
        for key, value in self.settings.items():
            if key in RATES:
                kept[key] = value > 0
            elif key == "data.noise":
                kept[key] = len(value)
            elif key not in NUMBERS + _SEEDS and not key.startswith(_BESIDE):
                kept[key] = value
        return kept


@flax.struct.dataclass
class Streams:
    """What batches are drawn from: D different streams of generated frames.

    Attributes:
      seed: [D] of each.
      rates: {"data.NAME": [D]} disturbances that differ between them.
      mix: the sensors of each, or of all.
      bank: instances [D, n, ...] of each, or of all.
    """

    seed: UInt[Array, " D"]
    rates: dict[str, Array]
    mix: Sensor
    bank: InstanceBank


Banks = Mapping[tuple[int, int], InstanceBank]  # by ``Member.bank``


@dataclass(frozen=True)
class Group:
    """Members that one program trains.

    Attributes:
      members: M of them.
      category: what all of them estimate.
      streams: of frames, without their leading axis where all members see the same frames.
      stream_of: [M] which of them each member sees.
      numbers: {"section.key": [M]} settings that differ.
    """

    members: tuple[Member, ...]
    category: Category
    streams: Streams
    stream_of: tuple[int, ...]
    numbers: dict[str, np.ndarray]

    @property
    def sharing(self) -> Literal["all", "own", "some"]:
        """Whether all members see the same frames, each its own, or some the same."""
        if not any(self.stream_of):
            return "all"
        return "own" if self.stream_of == tuple(range(len(self.members))) else "some"

    @property
    def config(self) -> RunConfig:
        """Of the first member; the others differ from it in ``numbers`` and in their streams."""
        first = self.members[0].config
        return replace(first, network=replace(first.network, refiner=RefinerConfig()))

    def initial_variables(self) -> PyTree:
        """Random variables [M, ...] of both stages, each of its member's seed."""
        config = self.config
        objective = Objective(self.category, config.network, config.loss)
        return jax.jit(jax.vmap(lambda seed: objective.init(jax.random.key(seed))))(self.seeds)

    def initial_state(self, variables: PyTree) -> TrainState:
        """Stacked states [M, ...] before the first step, from variables [M, ...]."""
        create = partial(TrainState.create, optimizer=Optimizer.of(self.config.training))
        return jax.jit(jax.vmap(lambda v, seed: create(v, seed=seed)))(variables, self.seeds)

    @property
    def seeds(self) -> UInt[Array, " M"]:
        return jnp.asarray([m.config.training.seed for m in self.members], jnp.uint32)


def split_into_programs(members: Sequence[Member]) -> list[list[Member]]:
    """Members by the program that can train them, in the order of the first of each."""
    programs: dict[str, list[Member]] = {}
    for member in members:
        programs.setdefault(str(sorted(member.program.items())), []).append(member)
    return list(programs.values())


def check_one_program(members: Sequence[Member]) -> None:
    """Raises a CaperError for members that no single program can train; names the settings."""
    programs = [member.program for member in members]
    keys = sorted(set().union(*programs))
    keys = [key for key in keys if any(p.get(key) != programs[0].get(key) for p in programs)]
    if not keys:
        return
    names: dict[str, str] = {}
    for member in members:
        names.setdefault(str(member.settings.get(keys[0])), member.name)
    shown = ", ".join(f"{value} in {name}" for value, name in names.items())
    raise CaperError(
        f"{', '.join(keys)} cannot differ within one compiled program ({keys[0]}: {shown}); "
        "train these members in separate programs"
    )


def make_group(members: Sequence[Member], category: Category, banks: Banks) -> Group:
    """The group of members that share a program.

    Args:
      members: of one category.
      category: the category.
      banks: of all of them, of equal shapes.

    Raises:
      CaperError: they do not; names the settings that change shapes.
    """
    check_one_program(members)
    settings = [member.settings for member in members]

    def varying(keys: Sequence[str], rows: Sequence[dict[str, Any]]) -> dict[str, np.ndarray]:
        columns = {key: [row[key] for row in rows] for key in keys}
        return {k: np.array(v, np.float32) for k, v in columns.items() if len(set(v)) > 1}

    # Streams: members of one seed and one data section see the same frames.
    sources = [(m.config.training.stream, m.config.data) for m in members]
    different = list(dict.fromkeys(sources))
    chosen = [members[sources.index(source)] for source in different]
    mixes = [sensor_mix(member.config.data.noise) for member in chosen]
    seen = [banks[member.bank] for member in chosen]
    rates = varying(RATES, [member.settings for member in chosen])
    stacked = len(different) > 1
    streams = Streams(
        seed=jnp.asarray([seed for seed, _ in different], jnp.uint32),
        rates=jax.tree.map(jnp.asarray, rates),
        mix=stack(mixes) if stacked else mixes[0],
        bank=stack(seen) if stacked else seen[0],
    )
    if not stacked:
        streams = streams.replace(seed=streams.seed[0])  # type: ignore[attr-defined]
    return Group(
        members=tuple(members),
        category=category,
        streams=streams,
        stream_of=tuple(map(different.index, sources)),
        numbers=varying([key for key in NUMBERS if key not in RATES], settings),
    )


def with_numbers(config: T, numbers: Mapping[str, Shaped[Any, "..."]]) -> T:
    """A configuration with some numbers replaced, which may be traced and are not checked.

    Args:
      config: a section.
      numbers: {"section.key": value}.
    """
    for path, value in numbers.items():
        config = _replaced(config, path.split("."), value)
    return config


def _replaced(config: Any, path: list[str], value: Any) -> Any:
    name, *rest = path
    if rest:
        value = _replaced(getattr(config, name), rest, value)
    return replace(config, **{name: value})


def stack(trees: Sequence[PyTree]) -> PyTree:
    """Trees of equal shapes as one, with a leading axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def check_members(members: Sequence[Member]) -> None:
    """Raises a CaperError for members that no grid can train together.

    Two of one name or with the same settings, a run on a dataset, or one bounded by minutes.
    """
    seen: dict[str, str] = {}
    names: set[str] = set()
    for member in members:
        config: RunConfig = member.config
        training: TrainingConfig = config.training
        if training.steps is None:
            raise CaperError(
                f"{member.name}: members of a grid are bounded by steps, not by minutes; "
                "set training.steps"
            )
        if config.loader is not None:
            raise CaperError(
                f"{member.name}: members of a grid train on generated frames; for a dataset "
                "train one run after the other"
            )
        if member.name in names:
            raise CaperError(f"two members are named {member.name!r}; rename one")
        names.add(member.name)
        key = str(member.settings)
        if key in seen:
            raise CaperError(
                f"{member.name} and {seen[key]} have the same settings and the same seed: "
                "remove one, or change its seed"
            )
        seen[key] = member.name
