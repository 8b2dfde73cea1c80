"""Help texts: ``--help`` on one screen, ``--help-all`` with every option of the configuration."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
import textwrap
import types
import typing
from collections.abc import Iterator
from itertools import pairwise
from typing import Literal

from smartnav_graph.cli.options import Command, Configured

# Columns of the screen, and that at which descriptions begin.
COLUMNS, TEXT_AT = 80, 20


def help_text(kind: type[Command], name: str, *, everything: bool = False) -> str:
    """What ``smartnav NAME --help`` prints; everything : with the options of the configuration."""
    about, _, example = (inspect.getdoc(kind) or "").partition("Example: ")
    example, _, notes = example.partition("\n")
    fields = [field for field in dataclasses.fields(kind) if field.name != "options"]
    hints = typing.get_type_hints(kind, include_extras=True)
    shown = {field.name: _written(field, hints[field.name]) for field in fields}
    positional = [shown[f.name] for f in fields if _positional(hints[f.name])]
    required = [shown[f.name] for f in fields if _is_required(f) and not _positional(hints[f.name])]
    lines = [" ".join(["usage: smartnav", name, *positional, *required, "[options]"]), ""]
    lines += [*textwrap.wrap(" ".join(about.split()), COLUMNS), ""]
    texts = field_texts(kind)
    last = [field.name for field in dataclasses.fields(Command)]
    order = sorted(fields, key=lambda f: (f.name in last, not _positional(hints[f.name]), not _is_required(f)))
    for field in order:
        lines += _entry(shown[field.name], texts.get(field.name, ""))
    lines += _own_options(kind)
    if issubclass(kind, Configured) and everything:
        lines += _sections(kind.configuration())
    elif issubclass(kind, Configured):
        lines += _entry("--help-all", "Every option of the configuration.")
    lines += _notes(notes)
    return "\n".join([*lines, *(["", f"Example: {example}"] if example else [])])


def _own_options(kind: type[Command]) -> Iterator[str]:
    """The options of a kind of a command, which are a dataclass of their own."""
    options = next((f.default_factory for f in dataclasses.fields(kind) if f.name == "options"), dataclasses.MISSING)
    if not (isinstance(options, type) and dataclasses.is_dataclass(options)):
        return
    hints, texts = typing.get_type_hints(options, include_extras=True), field_texts(options)
    for field in dataclasses.fields(options):
        yield from _entry(_written(field, hints[field.name]), texts.get(field.name, ""))


def _notes(text: str) -> Iterator[str]:
    """Paragraphs; one that begins with a word and spaces is an entry of a list."""
    for paragraph in filter(None, (part.strip() for part in text.split("\n\n"))):
        word, *rest = re.split(r" {2,}", paragraph, maxsplit=1)
        yield from _entry(word, rest[0]) if rest else ["", *textwrap.wrap(" ".join(paragraph.split()), COLUMNS)]


def _entry(name: str, text: str) -> list[str]:
    """One option: its name, and its description beside it, or below a long name."""
    body = textwrap.wrap(text, COLUMNS - TEXT_AT - 2) or [""]
    first = f"  {name}"
    beside = len(first) < TEXT_AT + 1
    lines = [f"{first:<{TEXT_AT + 1}} {body[0]}".rstrip()] if beside else [first]
    return lines + [f"{'':<{TEXT_AT + 2}}{line}" for line in body[int(beside) :]]


def _sections(options: type) -> Iterator[str]:
    """The options of every section, one line each where it fits."""
    for section in dataclasses.fields(options):
        kind = section.default_factory  # a section is a dataclass whose fields all have defaults
        yield f"\n[{section.name}]"
        texts, default = described(typing.cast(type, kind)), typing.cast(type, kind)()
        for field in dataclasses.fields(default):
            value = getattr(default, field.name)
            text = f"{texts.get(field.name, '')} ({shown_value(value)})"
            yield from _entry(f"--{section.name}.{field.name}".replace("_", "-"), text)


def shown_value(value: object) -> str:
    """A default value, numbers to eight digits."""
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "not set"}[value]
    if isinstance(value, float):
        return f"{value:.8g}"
    return " ".join(shown_value(one) for one in value) or "none" if isinstance(value, tuple) else str(value) or "none"


def described(kind: type) -> dict[str, str]:
    """The description of each field in the docstring of a dataclass, ``one, two : text; three : text``."""
    text = " ".join((inspect.getdoc(kind) or "").split()).replace("``", "")
    found = list(re.finditer(r"((?:\b\w+, )*\b\w+) : ", text))
    ends = [match.start() for match in found[1:]] + [len(text)]
    texts = dict[str, str]()
    for match, end in zip(found, ends, strict=True):
        texts |= dict.fromkeys(match.group(1).split(", "), text[match.end() : end].strip(" ;."))
    return texts


def field_texts(kind: type) -> dict[str, str]:
    """The text below each field of a command, in its source and in that of its bases."""
    found = dict[str, str]()
    for base in reversed(kind.__mro__):
        if not (dataclasses.is_dataclass(base) and base.__module__ != "types"):
            continue
        try:
            (body,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        except (OSError, TypeError):  # made by a program
            continue
        statements = body.body if isinstance(body, ast.ClassDef) else []
        for one, after in pairwise(statements):
            if isinstance(one, ast.AnnAssign) and isinstance(one.target, ast.Name) and isinstance(after, ast.Expr):
                text = after.value
                if isinstance(text, ast.Constant) and isinstance(text.value, str):
                    found[one.target.id] = " ".join(text.value.split())
    return found


def _arguments(hint: object) -> tuple[object, ...]:
    return typing.get_args(hint)[1:] if typing.get_origin(hint) is typing.Annotated else ()


def _positional(hint: object) -> bool:
    return any(repr(mark) == "Positional" for mark in _arguments(hint))


def _is_required(field: dataclasses.Field[object]) -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def _written(field: dataclasses.Field[object], hint: object) -> str:
    """An option as it is typed: ``--rate HZ``."""
    marks = _arguments(hint)
    metavar = next((found for mark in marks if (found := getattr(mark, "metavar", None))), "")
    name = next((found for mark in marks if (found := getattr(mark, "name", None))), field.name.replace("_", "-"))
    if _positional(hint):
        return metavar or name.upper()
    plain = typing.get_args(hint)[0] if typing.get_origin(hint) is typing.Annotated else hint
    choices = [one for part in _parts(plain) if typing.get_origin(part) is Literal for one in typing.get_args(part)]
    value = metavar or "|".join(choices) or ("" if plain is bool else "VALUE")
    return f"--{name} {value}".rstrip()


def _parts(hint: object) -> tuple[object, ...]:
    return typing.get_args(hint) if typing.get_origin(hint) in (typing.Union, types.UnionType) else (hint,)
