"""The command that shows the configuration."""

from __future__ import annotations

from dataclasses import dataclass

from smartnav_graph.cli.options import Configured, Switch


@dataclass(frozen=True, kw_only=True)
class ConfigCommand(Configured):
    """Show the configuration that smooth and replay would use, as the text of a config.toml.

    Example: smartnav config --dump
    """

    dump: Switch = False
    """Print every option with its value; without, those that are not the default."""

    def run(self) -> None:
        from smartnav_graph.estimate.config import Config, dumps

        config = self.resolved()
        text = dumps(config) if self.dump else dumps(config, beside=Config())
        print(text or "# every option has its default; --dump prints all of them\n", end="")
