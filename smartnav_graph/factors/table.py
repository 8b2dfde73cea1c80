"""What the rest of the package needs to know of a kind of factor."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from smartnav_graph.factors.context import FactorContext
from smartnav_graph.graph.update import Builder
from smartnav_graph.session.stream import Label


@dataclass(frozen=True)
class Factor:
    """One row of `FACTORS`.

    build : makes the builder, None where a session has no use for it; the prior has none, the initialisation makes it
    config, section : class of its options and name of their section in config.toml; a section may serve several factors
    stream : the stream that it reads, if any
    label : title and colour
    parts : labels of its factors that carry a name of their own, such as the bias random walk of the inertial data
    """

    label: Label
    build: Callable[[FactorContext], Builder | None] | None = None
    config: type[object] | None = None
    section: str = ""
    stream: str | None = None
    parts: Mapping[str, Label] = field(default_factory=dict)
