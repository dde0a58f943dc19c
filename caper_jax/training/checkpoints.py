"""Checkpoints of a training run: Orbax, with the checks that Orbax leaves to the caller.

Orbax commits a step atomically, but it never falls back from a damaged step, casts a changed
dtype in silence and does not notice a flipped bit. `Checkpoints.restore` walks back to the newest
step that reads back exactly as it was written, and says what it passed over.
"""

from __future__ import annotations

import asyncio
import copy
import itertools
import logging
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from caper_jax.errors import CaperError

PyTree = Any

_UNREADABLE = ".unreadable"


class CheckpointWarning(UserWarning):
    """A checkpoint could not be read and an older one was used."""


class Checkpoints:
    """The numbered checkpoints in one directory; use as a context manager.

    Args:
      directory: created if absent.
      keep: newest checkpoints to keep.
    """

    def __init__(self, directory: str | Path, keep: int = 3) -> None:
        self.directory = Path(directory).absolute()
        self._unreadable: list[int] = []
        # Orbax logs every save and every odd directory.
        self._logger = logging.getLogger("absl")
        self._level = self._logger.level
        self._logger.setLevel(logging.ERROR)
        self._manager = ocp.CheckpointManager(
            self.directory,
            options=ocp.CheckpointManagerOptions(
                max_to_keep=keep, create=True, cleanup_tmp_directories=True
            ),
            item_handlers={  # named, so that metadata can be read before any save
                "state": ocp.StandardCheckpointHandler(),
                "note": ocp.JsonCheckpointHandler(),
            },
        )

    def __enter__(self) -> Checkpoints:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def steps(self) -> list[int]:
        """Steps on disk, oldest first, whether they can be read or not."""
        self._manager.reload()
        return sorted(self._manager.all_steps())

    def save(self, step: int, state: PyTree, extra: dict[str, Any] | None = None) -> None:
        """Write a checkpoint in the background; the arrays may be donated once this returns.

        Args:
          step: its number; must not exist yet.
          state: pytree of arrays, the same on every process.
          extra: what JSON can hold.

        Raises:
          CaperError: it was not written (a failure of an earlier background write included).
        """
        self._set_unreadable_aside()
        # A snapshot, since Orbax writes it later and the caller's dict lives on.
        note = copy.deepcopy({"extra": extra or {}, "checksums": _checksums(state)})
        arguments = ocp.args.Composite(
            state=ocp.args.StandardSave(state), note=ocp.args.JsonSave(note)
        )
        try:
            saved = self._manager.save(step, args=arguments, force=True)
        except Exception as error:
            raise CaperError(f"{self.directory}: cannot save step {step}: {error}") from error
        if not saved:
            raise CaperError(f"{self.directory}: step {step} was not saved")

    def restore(self, template: PyTree) -> tuple[PyTree, dict[str, Any]] | None:
        """Read the newest intact checkpoint.

        Steps that cannot be read are named in a `CheckpointWarning`; they are left in place, and
        renamed to ``<step>.unreadable`` when the run writes its next checkpoint.

        Args:
          template: pytree of arrays or ``jax.ShapeDtypeStruct``; the result takes its structure,
            and its shardings where it has them, whatever devices the checkpoint was saved from.

        Returns:
          (state, extra), or None if there is no checkpoint.

        Raises:
          CaperError: a leaf is missing, unexpected or of another shape or dtype than the
            template's, or checkpoints exist and none can be read.
        """
        abstract = jax.tree.map(_abstract, template)
        self._unreadable, failures = [], []
        for step in reversed(self.steps()):
            where = self.directory / str(step)
            try:
                with _orderly_failures():
                    restored = self._read(step, abstract)
            except CaperError:
                raise
            except Exception as error:  # Orbax and TensorStore raise whatever they please
                failures.append(f"{where} ({_brief(error)})")
                self._unreadable.append(step)
                continue
            for failure in failures:
                warnings.warn(
                    f"cannot read the checkpoint {failure}; falling back to step {step}",
                    CheckpointWarning,
                    stacklevel=2,
                )
            return restored
        if failures:
            raise CaperError(
                f"no checkpoint can be read: {'; '.join(failures)}; "
                f"move {self.directory} away to start over"
            )
        return None

    def _read(self, step: int, abstract: PyTree) -> tuple[PyTree, dict[str, Any]]:
        metadata = self._manager.item_metadata(step).get("state")
        if metadata is None:
            raise ValueError("it was never completed")
        _compare(_leaves(metadata.tree), _leaves(abstract), str(self.directory / str(step)))
        arguments = ocp.args.Composite(
            state=ocp.args.StandardRestore(abstract), note=ocp.args.JsonRestore()
        )
        restored = self._manager.restore(step, args=arguments)
        state, note = restored["state"], restored["note"]
        actual = _checksums(state)
        damaged = [name for name, value in note["checksums"].items() if actual.get(name) != value]
        if damaged:
            raise ValueError(f"checksum of {damaged[0]} differs")
        return state, note["extra"]

    def _set_unreadable_aside(self) -> None:
        """Free the numbers of damaged steps, and keep retention from counting them."""
        if not self._unreadable:
            return
        if jax.process_index() == 0:
            for step in self._unreadable:
                names = (f"{step}{_UNREADABLE}{n or ''}" for n in itertools.count())
                free = (path for name in names if not (path := self.directory / name).exists())
                (self.directory / str(step)).rename(next(free))
        if jax.process_count() > 1:
            from jax.experimental import multihost_utils

            multihost_utils.sync_global_devices("caper_jax.checkpoints.set_aside")
        self._unreadable = []
        self._manager.reload()

    def wait(self) -> None:
        """Block until the background write is on disk; CaperError if it failed."""
        try:
            self._manager.wait_until_finished()
            self._manager.check_for_errors()
        except Exception as error:
            raise CaperError(f"{self.directory}: the last save failed: {error}") from error

    def close(self) -> None:
        """Wait for the background write, then release the directory."""
        try:
            self.wait()
        finally:
            self._manager.close()
            self._logger.setLevel(self._level)


class _PatientLoop(asyncio.SelectorEventLoop):
    """An event loop that lets its tasks end before it closes."""

    def close(self) -> None:
        tasks = [] if self.is_closed() else asyncio.all_tasks(self)
        if tasks:
            self.run_until_complete(asyncio.gather(*tasks, return_exceptions=True))
        super().close()


@contextmanager
def _orderly_failures() -> Iterator[None]:
    """Keep the remains of a failed restore off standard error.

    Orbax gives up at the first leaf that fails and closes the loop under the reads of the others,
    which then report to no one: from TensorStore's threads and, later, from the garbage collector.
    """
    new_event_loop = asyncio.new_event_loop
    asyncio.new_event_loop = _PatientLoop
    try:
        yield
    finally:
        asyncio.new_event_loop = new_event_loop


def _abstract(leaf: Any) -> jax.ShapeDtypeStruct:
    sharding = getattr(leaf, "sharding", None)
    if sharding is None:
        sharding = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding)


def _leaves(tree: PyTree) -> dict[str, Any]:
    """Leaves by "a/b/c" path; the same for a state and for Orbax's nested dicts of it."""
    return {
        jax.tree_util.keystr(path, simple=True, separator="/"): leaf
        for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]
    }


def _compare(saved: dict[str, Any], wanted: dict[str, Any], where: str) -> None:
    """Raise a CaperError naming the first leaf on which checkpoint and template disagree."""
    for name in sorted(saved.keys() | wanted.keys()):
        if name not in saved:
            raise CaperError(f"checkpoint {where} has no {name!r}; it is of another model")
        if name not in wanted:
            raise CaperError(f"checkpoint {where} has {name!r}, which this model has not")
        have, want = (
            f"shape {tuple(leaf.shape)} and dtype {np.dtype(leaf.dtype).name}"
            for leaf in (saved[name], wanted[name])
        )
        if have != want:
            raise CaperError(f"checkpoint {where}: {name!r} has {have}, this model needs {want}")


def _checksums(tree: PyTree) -> dict[str, int]:
    """CRC-32 of every leaf, by path."""
    return {
        name: zlib.crc32(np.ascontiguousarray(jax.device_get(leaf)).tobytes())
        for name, leaf in _leaves(tree).items()
    }


def _brief(error: Exception) -> str:
    """The first sentence of an error; TensorStore appends pages of its configuration."""
    lines = str(error).strip().splitlines()
    return lines[0].partition(". See full")[0][:200] if lines else type(error).__name__
