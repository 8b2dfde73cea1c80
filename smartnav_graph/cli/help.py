"""Help texts: ``--help`` on one screen, ``--help-all`` with every option of the configuration."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
import textwrap
import types
import typing
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

from smartnav_graph.cli.options import Command, Configured

# Units of numbers, by the end of a name and as a text has them (before a comma, a bracket or its end).
UNIT_OF_END = {"_s": "s", "_m": "m", "_deg": "deg", "_hz": "Hz", "_hpa": "hPa", "_px": "px"}
UNIT_OF_END |= {"_share": "share", "_probability": "share", "_sigmas": "sigmas"}
UNIT_IN_TEXT = {unit: unit for unit in ("m/sqrt(s)", "rad/s", "m/s^2", "m/s", "rad", "deg", "m", "s", "Hz", "px")}
UNIT_IN_TEXT |= {"a ratio": "ratio", "in sigmas": "sigmas"}
# Columns of the screen, and that at which descriptions begin.
COLUMNS, TEXT_AT = 80, 20


@dataclass(frozen=True)
class Argument:
    """One argument of a command.

    name : as it is typed, ``--rate`` or ``SESSION``; value : what follows it, ``HZ``; text : its description
    choices : the values that are possible, where they are words; default : of the configuration, as text
    section : of the configuration, empty for the command's own
    """

    name: str
    value: str
    text: str
    choices: tuple[str, ...] = ()
    positional: bool = False
    required: bool = False
    section: str = ""
    default: str = ""


def help_text(kind: type[Command], name: str, *, everything: bool = False) -> str:
    """What ``smartnav NAME --help`` prints; everything : with the options of the configuration."""
    about, _, example = (inspect.getdoc(kind) or "").partition("Example: ")
    example, _, notes = example.partition("\n")
    options = arguments_of(kind)
    positional = [o.name for o in options if o.positional] or [kind.PLACE] * bool(kind.PLACE)
    required = [f"{o.name} {o.value}" for o in options if o.required and not o.positional]
    usage = " ".join(["usage: smartnav", name, *positional, *required, "[options]"])
    lines = [*textwrap.wrap(usage, COLUMNS, subsequent_indent="       ", break_on_hyphens=False), ""]
    lines += [*textwrap.wrap(" ".join(about.split()), COLUMNS), ""]
    for option in options:
        lines += _entry(f"{option.name} {option.value}".rstrip(), option.text)
    if issubclass(kind, Configured) and everything:
        lines += _sections(configuration_options(kind))
    elif issubclass(kind, Configured):
        lines += _entry("--help-all", "Every option of the configuration.")
    lines += _notes(notes)
    return "\n".join([*lines, *(["", f"Example: {example}"] if example else [])])


def arguments_of(kind: type[Command]) -> list[Argument]:
    """The arguments of a command: positional and required ones first, those of all commands last."""
    fields = [field for field in dataclasses.fields(kind) if field.name != "options"]
    hints, texts = typing.get_type_hints(kind, include_extras=True), field_texts(kind)
    found = [_option(field, hints[field.name], texts.get(field.name, "")) for field in fields]
    common = [f"--{field.name}" for field in dataclasses.fields(Command)]
    own = next((f.default_factory for f in dataclasses.fields(kind) if f.name == "options"), None)
    if isinstance(own, type) and dataclasses.is_dataclass(own):  # a kind of a command has options of its own
        hints, texts = typing.get_type_hints(own, include_extras=True), field_texts(own)
        found += [_option(field, hints[field.name], texts.get(field.name, "")) for field in dataclasses.fields(own)]
    return sorted(found, key=lambda o: (o.name in common, not o.positional, not o.required))


def configuration_options(kind: type[Configured]) -> list[Argument]:
    """The options of the configuration that a command has, section by section."""
    found = []
    for section in dataclasses.fields(kind.configuration()):
        options = typing.cast(type, section.default_factory)  # a section is a dataclass whose fields all have defaults
        texts, hints, default = _described(options), typing.get_type_hints(options), options()
        for field in dataclasses.fields(default):
            text, value = texts.get(field.name, ""), getattr(default, field.name)
            choices = tuple(re.findall(r"``([\w-]+)``", text)) if hints[field.name] is str else ()
            shown = "|".join(choices) or _metavar(field.name, hints[field.name], text)
            text = text.replace("``", "")
            name = f"--{section.name}.{field.name}".replace("_", "-")
            sentence = text[:1].upper() + text[1:]
            found.append(Argument(name, shown, sentence, choices, section=section.name, default=shown_value(value)))
    return found


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


def _sections(options: Sequence[Argument]) -> Iterator[str]:
    """The options of every section."""
    section = ""
    for option in options:
        if option.section != section:
            section = option.section
            yield f"\n[{section}]"
        yield from _entry(f"{option.name} {option.value}", f"{option.text} ({option.default})")


def shown_value(value: object) -> str:
    """A default value, numbers to eight digits."""
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "not set"}[value]
    if isinstance(value, float):
        return f"{value:.8g}"
    return " ".join(shown_value(one) for one in value) or "none" if isinstance(value, tuple) else str(value) or "none"


def described(kind: type) -> dict[str, str]:
    """The description of each field in the docstring of a dataclass, ``one, two : text; three : text``."""
    return {name: text.replace("``", "") for name, text in _described(kind).items()}


def _described(kind: type) -> dict[str, str]:
    """The same with marks around words."""
    text = " ".join((inspect.getdoc(kind) or "").split())
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


def _option(field: dataclasses.Field[object], hint: object, text: str) -> Argument:
    """The argument of a field of a command."""
    marks = typing.get_args(hint)[1:] if typing.get_origin(hint) is typing.Annotated else ()
    plain = typing.get_args(hint)[0] if marks else hint
    metavar = next((found for mark in marks if (found := getattr(mark, "metavar", None))), "")
    name = next((found for mark in marks if (found := getattr(mark, "name", None))), field.name.replace("_", "-"))
    positional = any(repr(mark) == "Positional" for mark in marks)
    required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
    if positional:
        return Argument(metavar or name.upper(), "", text, positional=True, required=required)
    choices = tuple(w for part in _parts(plain) if typing.get_origin(part) is Literal for w in typing.get_args(part))
    switch = plain is bool
    value = "" if switch else metavar or "|".join(choices) or _metavar(field.name, plain, text)
    return Argument(f"--{name}", value, text, choices, required=required)


def _metavar(name: str, hint: object, text: str) -> str:
    """What follows an option: its unit, else its kind; empty for a number without a unit in its name or text."""
    (kind,) = {part for part in _parts(hint) if part is not types.NoneType} or {str}
    if kind is bool:
        return "true|false"
    if kind is int or typing.get_args(kind)[:1] == (int,):
        return "N" if kind is int else "N ..."
    if kind is not float:
        return "TEXT"
    ends = [end for end in UNIT_OF_END if name.endswith(end)]
    named = re.search(rf", ({'|'.join(map(re.escape, UNIT_IN_TEXT))})(?=$|[ ,;:.(])", text)
    unit = UNIT_OF_END[max(ends, key=len)] if ends else named.group(1) if named else ""
    return UNIT_IN_TEXT.get(unit, unit).upper()


def _parts(hint: object) -> tuple[object, ...]:
    return typing.get_args(hint) if typing.get_origin(hint) in (typing.Union, types.UnionType) else (hint,)
