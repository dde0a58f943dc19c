"""What a run directory remembers of its run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax

from caper_jax.errors import CaperError
from caper_jax.files import write_atomically

FILE = "config.json"
STARTED_FROM = "initial"  # key of the card of the model that the run started from
# Keys of the configuration that a resumed run may change: they do not touch the result.
_FREE_KEYS = frozenset(
    {
        "training.checkpoint_minutes",
        "training.checkpoint_steps",
        "training.keep_checkpoints",
        "loader.workers",
        "loader.prefetch",
        "loader.cache_gib",
    }
)


def check_configuration(directory: Path, configuration: dict[str, Any]) -> None:
    """Keep the configuration of a run in its directory, and hold a resumed run to it.

    Args:
      directory: the run directory; created.
      configuration: nested dict that JSON can hold.

    Raises:
      CaperError: the directory is of a run with another configuration; names what differs.
    """
    path = directory / FILE
    text = json.dumps(configuration, indent=2, sort_keys=True)
    if path.exists():
        try:
            saved = _flatten(json.loads(path.read_text(encoding="utf-8")))
        except ValueError as error:
            raise CaperError(f"{path} is not valid JSON: {error}") from error
        given = _flatten(json.loads(text))
        different = [
            key
            for key in sorted(saved.keys() | given.keys())
            if key not in _FREE_KEYS and saved.get(key, _ABSENT) != given.get(key, _ABSENT)
        ]
        if different:
            raise CaperError(
                f"{directory} holds a run of another configuration: "
                f"{_told(different, saved, given)}; use its configuration to resume it, or "
                "another directory (a new run can start from the model of this one)"
            )
        return
    if jax.process_index() == 0:
        directory.mkdir(parents=True, exist_ok=True)
        write_atomically(path, text.encode() + b"\n")


_ABSENT = object()
_TOLD = 8  # settings that a message names


def _told(different: list[str], saved: dict[str, Any], given: dict[str, Any]) -> str:
    """What differs, for a message; the card of the model that a run started from in a word."""
    parts = []
    start = f"{STARTED_FROM}."
    settings = [key for key in different if not key.startswith(start)]
    if len(settings) < len(different):
        begun = [any(key.startswith(start) for key in keys) for keys in (saved, given)]
        parts.append(
            {
                (True, True): "it started from another model",
                (True, False): "it started from a model and this one from random weights",
                (False, True): "it started from random weights and this one from a model",
            }[begun[0], begun[1]]
        )
    for key in settings[:_TOLD]:
        there, now = (repr(keys.get(key, "absent")) for keys in (saved, given))
        parts.append(f"{key} ({there} there, {now} now)")
    if len(settings) > _TOLD:
        parts.append(f"{len(settings) - _TOLD} settings more")
    return ", ".join(parts)


def _flatten(tree: Any, prefix: str = "") -> dict[str, Any]:
    """Nested dicts as {"a.b.c": value}."""
    if not isinstance(tree, dict) or not tree:
        return {prefix: tree}
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        flat.update(_flatten(value, f"{prefix}.{key}" if prefix else key))
    return flat
