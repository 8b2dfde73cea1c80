"""Completion of the command line in bash, zsh and fish, by argcomplete: the shell calls `smartnav` with the line."""

from __future__ import annotations

import argparse
import os
from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from smartnav_graph.cli.options import Command, Configured


@dataclass(frozen=True, kw_only=True)
class Completion(Command):
    """Print the script that makes a shell complete commands, options and values: in ~/.bashrc, eval "$(smartnav
    completion bash)"; in ~/.zshrc the same with zsh; in ~/.config/fish/config.fish, smartnav completion fish | source.

    Example: smartnav completion bash
    """

    shell: Annotated[Literal["bash", "zsh", "fish"], tyro.conf.Positional, tyro.conf.arg(metavar="SHELL")]
    """One of bash, zsh, fish."""

    def run(self) -> None:
        from argcomplete.shell_integration import shellcode

        print(shellcode(["smartnav"], shell=self.shell))


def answer() -> None:
    """Write what completes the line in the environment for the shell that asks, and end the process."""
    import argcomplete

    argcomplete.autocomplete(parser_for(os.environ["COMP_LINE"]), always_complete_options="long")


def parser_for(line: str) -> argparse.ArgumentParser:
    """A parser of all commands, with the options of that in the line only: it is made anew at every key."""
    from smartnav_graph.cli import COMMANDS, command_class

    words = line.split()[1:]
    parser = argparse.ArgumentParser("smartnav", add_help=False)
    commands = parser.add_subparsers()
    for name, (_, _, summary) in COMMANDS.items():
        command = commands.add_parser(name, help=summary, add_help=False)
        if words[:1] == [name]:
            _fill(command, command_class(name), name, words)
    return parser


def _fill(parser: argparse.ArgumentParser, kind: type[Command], name: str, words: list[str]) -> None:
    """The arguments of a command; of one with sub-commands, those of the one in the line."""
    from smartnav_graph.cli.help import arguments_of, configuration_options

    if kind.kinds():
        kinds = parser.add_subparsers()
        for word, summary in kind.kinds().items():
            part = kinds.add_parser(word, help=summary, add_help=False)
            if words[1:2] == [word]:
                _fill(part, kind.narrowed(name, words[1:])[0], word, words[1:])
        return
    options = arguments_of(kind)
    sectioned = any(word.startswith("--") and "." in word for word in words)
    if issubclass(kind, Configured) and sectioned:  # which takes longer
        options += configuration_options(kind)
    for option in options:
        choices = option.choices or None
        if option.positional:
            parser.add_argument(option.name, nargs="*", choices=choices)
        elif option.value == "":
            parser.add_argument(option.name, action="store_true", help=option.text)
        else:
            values = choices or (("true", "false") if option.value == "true|false" else None)
            parser.add_argument(option.name, choices=values, help=option.text)
    parser.add_argument("--help", action="store_true", help="Show the options.")
