"""Configurations: nested frozen dataclasses, read from TOML and overridden from the command line.

The dataclasses live with their users (data, networks, training); here is only the machinery. A
field may be a bool, int, float, str, ``Literal``, tuple, another dataclass, or one of these or
None. TOML has no null: a key that is absent takes the field's default. Of the fields that a
dataclass lists in ``ALTERNATIVES`` at most one is set: naming one unsets the others.
"""

from __future__ import annotations

import dataclasses
import json
import math
import tomllib
import types
import typing
from pathlib import Path
from typing import Any, Literal, TypeVar

from caper_jax.errors import CaperError, unknown_name

T = TypeVar("T")


def load(path: str | Path, cls: type[T], *overrides: str) -> T:
    """Read a configuration.

    Args:
      path: TOML file.
      cls: a dataclass.
      *overrides: "section.key=value", applied before the values are validated together.

    Raises:
      CaperError: the file cannot be read, or holds an unknown key or a wrong value.
    """
    values = _read_toml(path)
    for assignment in overrides:
        _assign(values, cls, assignment)
    return from_dict(cls, values, str(path))


def override(config: T, *assignments: str) -> T:
    """A copy of a configuration with some values replaced.

    Args:
      config: a dataclass.
      *assignments: "section.key=value"; the value in TOML, where strings need no quotes and
        ``none`` stands for None.

    Example:
      override(config, "training.learning_rate=1e-3", "training.optimizer=adamw")

    Raises:
      CaperError: no such key, or a value of the wrong type or out of range.
    """
    values = to_dict(config)
    for assignment in assignments:
        _assign(values, type(config), assignment)
    return from_dict(type(config), values, "override")


def update(config: T, path: str | Path) -> T:
    """A copy of a configuration with the values of a TOML file in the place of its own.

    Args:
      config: a dataclass.
      path: TOML file; what it does not name stays as it is.

    Raises:
      CaperError: the file cannot be read, or holds an unknown key or a wrong value.
    """
    values = to_dict(config)
    _merge(values, _read_toml(path), type(config))
    return from_dict(type(config), values, str(path))


def _merge(values: dict[str, Any], changes: dict[str, Any], cls: type) -> None:
    kinds = typing.get_type_hints(cls)
    for key in changes:
        _unset_alternatives(values, cls, key)
    for key, change in changes.items():
        if isinstance(change, dict) and isinstance(values.get(key), dict):
            _merge(values[key], change, _without_none(kinds[key]))
        else:
            values[key] = change


def _unset_alternatives(values: dict[str, Any], cls: type, key: str) -> None:
    alternatives = getattr(cls, "ALTERNATIVES", ())
    if key in alternatives:
        values.update((other, None) for other in alternatives if other != key)


def _without_none(kind: Any) -> Any:
    """``T`` of ``T | None``, other types as they are."""
    inner = [a for a in typing.get_args(kind) if a is not type(None)]
    optional = typing.get_origin(kind) in (typing.Union, types.UnionType)
    return inner[0] if optional and len(inner) == 1 else kind


def _read_toml(path: str | Path) -> dict[str, Any]:
    try:
        with open(path, "rb") as file:
            return tomllib.load(file)
    except OSError as error:
        raise CaperError(f"cannot read configuration {path}: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise CaperError(f"{path} is not valid TOML: {error}") from error


def from_dict(cls: type[T], values: dict[str, Any], where: str) -> T:
    """Build a dataclass from nested dicts.

    Args:
      cls: a dataclass.
      values: by field name; a field that is absent takes its default.
      where: the file or argument the values come from, for error messages.

    Raises:
      CaperError: unknown or missing key, wrong type, or a value the dataclass refuses.
    """
    return _build(cls, values, where, "")


def to_dict(config: Any) -> dict[str, Any]:
    """Nested dicts of plain values (tuples become lists), as JSON and `from_dict` take them."""
    return {f.name: _plain(getattr(config, f.name)) for f in dataclasses.fields(config)}


def to_toml(config: Any) -> str:
    """The configuration as TOML that `load` reads back to an equal one.

    Raises:
      CaperError: a field is None where its default is not, which TOML cannot express.
    """
    return "\n".join(_toml_lines(config, "")).strip() + "\n"


def _build(cls: type[T], values: Any, where: str, prefix: str) -> T:
    if not isinstance(values, dict):
        raise CaperError(f"{where}: {prefix[:-1]} must be a table, got {values!r}")
    types_of = typing.get_type_hints(cls)
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init}  # type: ignore[arg-type]
    arguments = {}
    for name, value in values.items():
        if name not in fields:
            raise _unknown(prefix + name, prefix, fields, where)
        arguments[name] = _convert(types_of[name], value, where, prefix + name)
    for name, field in fields.items():
        required = (
            field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        )
        if required and name not in arguments:
            raise CaperError(f"{where}: {prefix}{name} is missing")
    try:
        return cls(**arguments)
    except CaperError as error:
        raise CaperError(f"{where}: {error}") from error


def _convert(kind: Any, value: Any, where: str, key: str) -> Any:
    """``value`` as the type ``kind``; CaperError if it is not one."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if dataclasses.is_dataclass(kind):
        return _build(typing.cast(type, kind), value, where, key + ".")
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        (inner,) = (a for a in arguments if a is not type(None))
        return _convert(inner, value, where, key)
    if origin is Literal:
        if value in arguments:
            return value
        if isinstance(value, str):
            raise CaperError(f"{where}: {unknown_name(key, value, map(str, arguments))}")
    elif origin is tuple:
        if isinstance(value, list | tuple):
            if arguments[-1] is Ellipsis:
                inner_kinds = [arguments[0]] * len(value)
            else:
                inner_kinds = list(arguments)
            if len(inner_kinds) == len(value):
                return tuple(
                    _convert(inner, item, where, f"{key}[{index}]")
                    for index, (inner, item) in enumerate(zip(inner_kinds, value, strict=True))
                )
    elif kind is float:
        if isinstance(value, int | float) and not isinstance(value, bool):
            return float(value)
    elif kind in (int, str, bool):
        if type(value) is kind:
            return value
    else:
        raise TypeError(f"{key}: a configuration cannot hold the type {kind}")
    raise CaperError(f"{where}: {key} must be {_describe(kind)}, got {value!r}")


def _assign(values: dict[str, Any], cls: type, assignment: str) -> None:
    """Put the value of "a.b=value" into nested dicts, typed by the dataclass."""
    key, equals, text = assignment.partition("=")
    key, text = key.strip(), text.strip()
    if not equals or not key:
        raise CaperError(f"override {assignment!r}: write section.key=value")
    *sections, name = key.split(".")
    prefix = ""
    for section in sections:
        cls = _without_none(_field_type(cls, section, prefix, assignment))
        prefix += section + "."
        if not dataclasses.is_dataclass(cls):
            raise CaperError(f"override {assignment!r}: {prefix[:-1]} is not a section")
        if values.get(section, {}) is None:
            raise CaperError(f"override {assignment!r}: there is no {prefix[:-1]} in this run")
        values = values.setdefault(section, {})
    kind = _field_type(cls, name, prefix, assignment)
    optional = type(None) in typing.get_args(kind)
    if dataclasses.is_dataclass(_without_none(kind)) and not (optional and text.lower() == "none"):
        raise CaperError(f"override {assignment!r}: {key} is a section; name a key in it")
    try:
        values[name] = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        values[name] = text  # a string without quotes, or a mistake that the type check names
    if optional and text.lower() == "none":
        values[name] = None
    elif not isinstance(values[name], str) and _holds_only_strings(kind):
        values[name] = text  # a name that happens to read as a number, date or boolean
    if values[name] is not None:
        _unset_alternatives(values, cls, name)


def _field_type(cls: type, name: str, prefix: str, assignment: str) -> Any:
    fields = {f.name for f in dataclasses.fields(cls) if f.init}
    if name not in fields:
        raise _unknown(prefix + name, prefix, fields, f"override {assignment!r}")
    return typing.get_type_hints(cls)[name]


def _unknown(key: str, prefix: str, fields: typing.Iterable[str], where: str) -> CaperError:
    return CaperError(f"{where}: {unknown_name('key', key, (prefix + f for f in fields))}")


def _holds_only_strings(kind: Any) -> bool:
    return all(a in (str, type(None)) for a in typing.get_args(kind) or (kind,))


def _describe(kind: Any) -> str:
    """A type in words."""
    names = {bool: "true or false", int: "an integer", float: "a number", str: "a string"}
    if kind in names:
        return names[kind]
    arguments = typing.get_args(kind)
    if typing.get_origin(kind) is tuple:
        if arguments[-1] is Ellipsis:
            return f"a list, each item {_describe(arguments[0])}"
        return f"a list of {len(arguments)}"
    return f"one of {', '.join(map(repr, arguments))}"


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return to_dict(value)
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    return value


def _toml_lines(config: Any, prefix: str) -> list[str]:
    """Keys first, then one table per nested dataclass."""
    lines, sections = [], []
    for field in dataclasses.fields(config):
        value, key = getattr(config, field.name), prefix + field.name
        if dataclasses.is_dataclass(value):
            sections += ["", f"[{key}]", *_toml_lines(value, key + ".")]
        elif value is not None:
            lines.append(f"{field.name} = {_toml_value(value)}")
        elif field.default is not None:
            raise CaperError(f"{key} is None, which TOML cannot express; its default is not None")
    return lines + sections


def _toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):  # JSON's escapes are TOML's, but for DEL
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(_toml_value, value))}]"
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)  # "inf", "-inf", "nan"
    return repr(value)
