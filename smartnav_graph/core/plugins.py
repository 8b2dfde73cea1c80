"""Parts of other installed packages, by the entry points of Python packaging."""

from __future__ import annotations

from collections.abc import Collection
from importlib.metadata import entry_points
from typing import TypeVar

from smartnav_graph.core.errors import warn

Kind = TypeVar("Kind")


def installed_parts(group: str, kind: type[Kind], taken: Collection[str]) -> dict[str, Kind]:
    """What other packages offer in a group of entry points, by name; faulty ones are left out with a warning.

    Parameters
    ----------
    group : such as ``smartnav_graph.readers``
    kind : class of the objects
    taken : names that are not free
    """
    found: dict[str, Kind] = {}
    for entry in sorted(entry_points(group=group), key=lambda one: one.name):
        where = f"entry point {entry.name} = {entry.value} [{group}]"
        if entry.name in taken or entry.name in found:
            warn(f"{where}: the name is taken; left out; choose another name")
            continue
        try:
            part = entry.load()
        except Exception as error:  # of a package that we do not know
            found_text = f"cannot be loaded ({type(error).__name__}: {error})"
            warn(f"{where}: {found_text}; left out; repair or uninstall its package")
            continue
        if isinstance(part, kind):
            found[entry.name] = part
        else:
            warn(f"{where}: is {type(part).__name__}; expected a {kind.__module__}.{kind.__name__}; left out")
    return found
