"""Common options of the commands, and the configuration file below the flags."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Sequence
from dataclasses import dataclass, field
from json import dumps
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import tyro

from smartnav_graph.estimate import config as config_model
from smartnav_graph.estimate.config import Config
from smartnav_graph.output.summary_json import plain
from smartnav_graph.session import repair as repair_model

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

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> Self | None:
        """Defaults that depend on the arguments; None for those of the class."""
        return None

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
        print(dumps(plain(figures), allow_nan=False) if self.json else text)


@dataclass(frozen=True, kw_only=True)
class Writing(Command):
    """A command that writes files."""

    out: OutPath
    """Output path."""
    force: Switch = False
    """Replace an older output of the command."""


@dataclass(frozen=True, kw_only=True)
class SessionCommand(Command):
    """A session and the options of the estimation."""

    session: SourceName
    """Session folder, or a log of a known format (see `smartnav formats`)."""
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """config.toml; the options below override it."""
    vehicle: Literal["none", "car", "trolley", "foot"] | None = None
    """What carries the device; by default as in the session."""
    sensors: Annotated[Text, tyro.conf.arg(metavar="A,B,-C")] = None
    """Sensors to use, or with a minus to exclude."""
    withhold: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="SPEC")] = ()
    """Measurements to withhold and to compare with the result: gnss:every=10 uses each tenth fix only,
    gnss:outage=100-130 withholds 30 s; repeatable."""
    start: Annotated[float | None, tyro.conf.arg(name="from", metavar="S")] = None
    """Start time, seconds from the session's start."""
    end: Annotated[float | None, tyro.conf.arg(name="to", metavar="S")] = None
    """End time, seconds from the session's start."""
    initial: Annotated[Text, tyro.conf.arg(metavar="E,N,U,HEADING_DEG[,SIGMA_M,SIGMA_DEG]")] = None
    """Initial position and heading, instead of the automatic initialisation."""
    rate: Annotated[Text, tyro.conf.arg(metavar="keyframes|imu|HZ")] = None
    """Output rate of the trajectory."""
    repair: Repairs = None
    """Repairs of faulty rows: nan, order, stamps; units converts readings in another unit."""
    options: Annotated[tyro.conf.FlagConversionOff[Config], tyro.conf.arg(name="")] = field(default_factory=Config)

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> Self | None:
        """The configuration file, if given."""
        file = _value_of("--config", arguments)
        if file is None:
            return None
        required = (f.name for f in dataclasses.fields(cls) if f.default is f.default_factory is dataclasses.MISSING)
        missing = dict.fromkeys(required, tyro.MISSING)
        return cls(**missing, options=config_model.load(file))

    def resolved(self) -> Config:
        """The configuration with the options of the command line."""
        asked = given(
            vehicle=self.vehicle,
            sensors=None if self.sensors is None else names(self.sensors),
            withhold=self.withhold or None,
            start_s=self.start,
            end_s=self.end,
            initial=self.initial,
            rate=self.rate,
        )
        return dataclasses.replace(self.options, run=dataclasses.replace(self.options.run, **asked))


@dataclass(frozen=True, kw_only=True)
class Estimating(SessionCommand, Writing):
    """Common options of `smooth` and `replay`."""


def given(**options: Any) -> dict[str, Any]:
    """The options that are not None."""
    return {name: value for name, value in options.items() if value is not None}


def names(text: str | None) -> tuple[str, ...]:
    """The names of a comma separated list."""
    return tuple(part.strip() for part in (text or "").split(",") if part.strip())


def repairs(text: str | None) -> tuple[str, ...]:
    """The repairs of a comma separated list, checked."""
    return repair_model.check_names(names(text))


def parse(kind: type[Command], name: str, arguments: Sequence[str]) -> Command:
    """The command with its options; raises SystemExit for help (0) and wrong usage (2)."""
    joined = join_values(arguments)
    default: Any = kind.defaults(joined)
    text = inspect.getdoc(kind)
    found: Command = tyro.cli(kind, prog=f"smartnav {name}", description=text, args=joined, default=default)
    return found


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
