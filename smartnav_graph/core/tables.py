"""Tables of a TOML file -> frozen dataclasses, every value checked; a message names key, value and rule."""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Mapping
from pathlib import Path
from types import NoneType, UnionType
from typing import TypeVar, get_args, get_origin, get_type_hints

from smartnav_graph.core.errors import SmartnavError

Kind = TypeVar("Kind")
LARGEST_COUNT = 1_000_000_000
LARGEST_NUMBER = 1e15
LONGEST = 10_000  # characters of a text, entries of a list


class _BrokenRule(Exception):
    """A value that breaks a rule: its key, what it is, the rule."""

    def __init__(self, key: str, value: object, rule: str, found: str = "") -> None:
        super().__init__(key)
        shown = repr(value)
        shown = shown if len(shown) <= 80 else f"{shown[:80]}..."
        self.found, self.rule = found or (f"{key} = {shown}" if key else f"is {shown}"), rule


def structured(kind: type[Kind], table: object, fault: type[SmartnavError], where: str | Path) -> Kind:
    """The dataclass `kind` of a parsed table.

    Numbers are finite (unless the default or the metadata ``nan`` of a field say otherwise), counts are whole, true,
    false and texts are no numbers; where the default is positive, nothing is negative. Keys that are missing take
    their defaults, others than those of `kind` are refused.

    Raises
    ------
    SmartnavError
        Of the type `fault`, or of the dataclass' own checks; it names `where`, the key, the value and the rule.
    """
    try:
        return _table(kind, table, "", where)
    except _BrokenRule as broken:
        raise fault(where, broken.found, broken.rule) from broken
    except RecursionError as error:
        raise fault(where, "is nested too deeply", "tables of keys and values") from error


def check(value: Kind, fault: type[SmartnavError], where: str | Path) -> Kind:
    """The same dataclass, its values checked as those of a file are."""
    return structured(type(value), dataclasses.asdict(value), fault, where)  # type: ignore[call-overload]


def _table(kind: type[Kind], table: object, key: str, where: str | Path) -> Kind:
    if not isinstance(table, Mapping):
        raise _BrokenRule(key, table, f"a table with some of {', '.join(get_type_hints(kind))}")
    specs = {spec.name: spec for spec in dataclasses.fields(kind)}  # type: ignore[arg-type]
    for name in table:
        if name not in specs:
            close = difflib.get_close_matches(str(name), specs, 1)
            hint = f"{close[0]}, or another of {', '.join(specs)}" if close else f"one of {', '.join(specs)}"
            raise _BrokenRule(key, table, hint, f"unknown key {_path(key, str(name)[:200])}")
    for name, spec in specs.items():
        if name not in table and spec.default is spec.default_factory is dataclasses.MISSING:
            raise _BrokenRule(key, table, "a value: it has no default", f"key {_path(key, name)} is missing")
    values, hints = dict[str, object](), get_type_hints(kind)
    for name, spec in specs.items():
        if name not in table:
            continue
        value, default = table[name], spec.default
        if isinstance(value, float) and math.isnan(value) and (spec.metadata.get("nan") or default != default):
            values[name] = value
            continue
        values[name] = _value(hints[name], value, _path(key, name), where)
        positive = isinstance(default, int | float) and not isinstance(default, bool) and default > 0
        if positive and isinstance(value, int | float) and value < 0:
            raise _BrokenRule(_path(key, name), value, "a number >= 0")
    try:
        return kind(**values)
    except SmartnavError as error:
        at = f"{where} [{key}]" if key else where
        raise error.located(f"{at}, {error.where}" if error.where.startswith("--") else at) from error


def _path(key: str, name: str) -> str:
    return f"{key}.{name}" if key else name


def _value(kind: object, value: object, key: str, where: str | Path) -> object:
    arguments = get_args(kind)
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        return _table(kind, value, key, where)
    if isinstance(kind, UnionType) or NoneType in arguments:
        return None if value is None else _value(next(a for a in arguments if a is not NoneType), value, key, where)
    if get_origin(kind) is tuple:
        return _list(arguments, value, key, where)
    if get_origin(kind) in (Mapping, dict):
        if not isinstance(value, Mapping):
            raise _BrokenRule(key, value, "a table")
        return {str(name): _value(arguments[1], item, _path(key, str(name)), where) for name, item in value.items()}
    if kind is bool:
        if isinstance(value, bool):
            return value
        raise _BrokenRule(key, value, "true or false")
    if kind is str:
        if isinstance(value, str) and len(value) <= LONGEST:
            return value
        raise _BrokenRule(key, value, "a text in quotes")
    if isinstance(value, bool) or not isinstance(value, int | float if kind is float else int):
        raise _BrokenRule(key, value, "a number" if kind is float else "a whole number")
    largest = LARGEST_NUMBER if kind is float else LARGEST_COUNT
    if not abs(value) <= largest or not math.isfinite(value):
        raise _BrokenRule(key, value, f"a finite number of at most {largest:.0e}")
    return float(value) if kind is float else value


def _list(kinds: tuple[object, ...], value: object, key: str, where: str | Path) -> tuple[object, ...]:
    if not isinstance(value, list | tuple) or len(value) > LONGEST:
        raise _BrokenRule(key, value, "a list")
    if kinds[-1] is Ellipsis:
        kinds = kinds[:1] * len(value)
    if len(value) != len(kinds):
        raise _BrokenRule(key, value, f"a list of {len(kinds)}")
    pairs = enumerate(zip(kinds, value, strict=True))
    return tuple(_value(kind, item, f"{key}[{i}]", where) for i, (kind, item) in pairs)
