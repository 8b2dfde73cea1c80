"""Common options of the commands, and the configuration file below the flags."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self, TypeVar, cast

import tyro

if TYPE_CHECKING:  # what computes is imported when a command runs: its help is there at once
    from _typeshed import DataclassInstance

    from smartnav_graph.estimate.config import Config

Made = TypeVar("Made", bound="DataclassInstance")
Switch = tyro.conf.FlagCreatePairsOff[bool]
Text = str | None
SourceName = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SESSION")]
RunPath = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(name="run", metavar="RUN")]
OutPath = Annotated[Path, tyro.conf.arg(metavar="PATH")]
Repairs = Annotated[Text, tyro.conf.arg(name="repair", metavar="A,B")]


@dataclass(frozen=True, kw_only=True)
class Command:
    """A sub-command: its fields are the options, its docstring is the help text."""

    quiet: Switch = False
    """Do not show progress."""
    debug: Switch = False
    """Show the traceback of an error."""

    # What the line of usage has as arguments where the class has none.
    PLACE: ClassVar[str] = ""

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> Self | None:
        """Defaults that depend on the arguments; None for those of the class."""
        return None

    @classmethod
    def kinds(cls) -> dict[str, str]:
        """Sub-commands with a line about each, where there are any."""
        return {}

    @classmethod
    def narrowed(cls, name: str, arguments: list[str]) -> tuple[type[Command], str, list[str]]:
        """The class, name and arguments of the command that is meant, where the first argument is a sub-command."""
        return cls, name, arguments

    def run(self) -> int | None:
        """Execute the command; the exit code, where it is not 0."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class Reporting(Command):
    """A command that prints figures."""

    json: Switch = False
    """Print JSON, and nothing else, on stdout."""

    def report(self, figures: object, text: str) -> None:
        """Print the figures as JSON, or the text."""
        from smartnav_graph.cli.text import print_findings
        from smartnav_graph.output.summary_json import plain

        if self.json:
            print(dumps(plain(figures), allow_nan=False))
        else:
            print_findings(text)


@dataclass(frozen=True, kw_only=True)
class Writing(Command):
    """A command that writes files."""

    out: OutPath
    """Output path."""
    force: Switch = False
    """Replace an older output of the command."""


@dataclass(frozen=True, kw_only=True)
class Configured(Command):
    """A command with the options of the configuration."""

    # Fields of the configuration that have an option of their own.
    OWN_OPTIONS: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "run": ("vehicle", "sensors", "withhold", "start_s", "end_s", "initial", "rate"),
        "vehicle": ("enabled",),
    }

    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A config.toml; options override it."""
    options: object = None

    @classmethod
    def configuration(cls) -> type:
        """The configuration, without what has an option of its own."""
        from smartnav_graph.estimate.config import Config

        sections = []
        for section in dataclasses.fields(Config):
            kind = cast("type[DataclassInstance]", section.default_factory)
            kept = [f for f in dataclasses.fields(kind) if f.name not in cls.OWN_OPTIONS.get(section.name, ())]
            if section.name in cls.OWN_OPTIONS:
                rows = [(f.name, f.type, field(default=f.default)) for f in kept]
                kind = dataclasses.make_dataclass(kind.__name__, rows, frozen=True, namespace={"__doc__": kind.__doc__})
            sections.append((section.name, kind, field(default_factory=kind)))
        return dataclasses.make_dataclass("Options", sections, frozen=True)

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> Self | None:
        """The configuration file, if given."""
        file = _value_of("--config", arguments)
        if file is None:
            return None
        required = (f.name for f in dataclasses.fields(cls) if f.default is f.default_factory is dataclasses.MISSING)
        missing = dict.fromkeys(required, tyro.MISSING)
        options = cast(type, next(f.default_factory for f in dataclasses.fields(cls) if f.name == "options"))
        return cls(**missing, options=_like(options(), _loaded(file)))

    def resolved(self) -> Config:
        """The configuration: its file, and the options of the command line."""
        from smartnav_graph.estimate.config import Config

        config: Config = _like(
            Config() if self.config is None else _loaded(self.config), cast("DataclassInstance", self.options)
        )
        return config


@dataclass(frozen=True, kw_only=True)
class SessionCommand(Configured):
    """A session and the options of the estimation."""

    session: SourceName
    """Session folder, or a log of a known format."""
    vehicle: Annotated[Literal["none", "car", "trolley", "foot"] | None, tyro.conf.arg(metavar="KIND")] = None
    """None, car, trolley or foot, if not as in the session."""
    sensors: Annotated[Text, tyro.conf.arg(metavar="A,-B")] = None
    """Sensors to use, or with a minus to leave out."""
    withhold: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="SPEC")] = ()
    """Leave fixes out and compare: gnss:every=10, gnss:outage=100-130."""
    start: Annotated[float | None, tyro.conf.arg(name="from", metavar="S")] = None
    """Start, seconds from the first inertial sample."""
    end: Annotated[float | None, tyro.conf.arg(name="to", metavar="S")] = None
    """End, seconds from the first inertial sample."""
    initial: Annotated[Text, tyro.conf.arg(metavar="E,N,U,H")] = None
    """First position, m, heading, deg, and maybe sigmas of both."""
    rate: Annotated[Text, tyro.conf.arg(metavar="HZ")] = None
    """Rate of the trajectory: keyframes, imu, or Hz."""
    repair: Repairs = None
    """Repair faulty rows: nan, order, stamps, units, clock."""

    def resolved(self) -> Config:
        """The configuration: its file, and the options of the command line."""
        config = super().resolved()
        asked = given(
            vehicle=self.vehicle,
            sensors=None if self.sensors is None else names(self.sensors),
            withhold=self.withhold or None,
            start_s=self.start,
            end_s=self.end,
            initial=self.initial,
            rate=self.rate,
        )
        return dataclasses.replace(config, run=dataclasses.replace(config.run, **asked))


@dataclass(frozen=True, kw_only=True)
class Estimating(SessionCommand, Writing):
    """Common options of `smooth` and `replay`."""


def _loaded(file: str | Path) -> Config:
    from smartnav_graph.estimate.config import load

    return load(file)


def _like(made: Made, other: DataclassInstance) -> Made:
    """`made` with the values of `other`, in the sections and fields that both have."""
    sections = {}
    for section in dataclasses.fields(made):
        mine, theirs = getattr(made, section.name), getattr(other, section.name)
        both = {f.name for f in dataclasses.fields(mine)} & {f.name for f in dataclasses.fields(theirs)}
        sections[section.name] = dataclasses.replace(mine, **{name: getattr(theirs, name) for name in both})
    return dataclasses.replace(made, **sections)


def given(**options: Any) -> dict[str, Any]:
    """The options that are not None."""
    return {name: value for name, value in options.items() if value is not None}


def names(text: str | None) -> tuple[str, ...]:
    """The names of a comma separated list."""
    return tuple(part.strip() for part in (text or "").split(",") if part.strip())


def repairs(text: str | None) -> tuple[str, ...]:
    """The repairs of a comma separated list, checked."""
    from smartnav_graph.session.repair import check_names

    return check_names(names(text))


def parse(kind: type[Command], name: str, arguments: Sequence[str]) -> Command:
    """The command with its options; raises SystemExit for help (0) and wrong usage (2)."""
    joined = join_values(arguments)
    if issubclass(kind, Configured):
        kind = with_options(kind, kind.configuration())
    default: Any = kind.defaults(joined)
    text = inspect.getdoc(kind)
    found: Command = tyro.cli(kind, prog=f"smartnav {name}", description=text, args=joined, default=default)
    return found


def with_options(kind: type[Command], options: type, about: str | None = None, **constants: object) -> type[Command]:
    """The class of a command with the fields of a dataclass as options; its text, and constants of the class."""
    annotation = Annotated[tyro.conf.FlagConversionOff[options], tyro.conf.arg(name="")]  # type: ignore[valid-type]
    row = ("options", annotation, field(default_factory=options))
    made = dataclasses.make_dataclass(
        kind.__name__, [row], bases=(kind,), namespace=constants, frozen=True, kw_only=True
    )
    made.__doc__ = about or kind.__doc__
    return made


def join_values(arguments: Sequence[str]) -> list[str]:
    """``--option -value`` as ``--option=-value``, and true, false of the configuration as True, False.

    Only -h is a short option, so that a single leading minus after an option belongs to its value.
    """
    joined: list[str] = []
    for argument in arguments:
        before = joined[-1] if joined else ""
        opened = before.startswith("--") and "=" not in before
        if opened and argument.startswith("-") and not argument.startswith("--") and argument != "-h":
            joined[-1] = f"{before}={argument}"
        elif opened and "." in before and argument.lower() in ("true", "false"):
            joined.append(argument.capitalize())
        else:
            joined.append(argument)
    return joined


def _value_of(option: str, arguments: Sequence[str]) -> str | None:
    """The last value of an option that takes one."""
    found = None
    for i, argument in enumerate(arguments):
        if argument == option and i + 1 < len(arguments):
            found = arguments[i + 1]
        elif argument.startswith(f"{option}="):
            found = argument.partition("=")[2]
    return found
