"""The templates of the report (Jinja), filled: text is escaped, what is HTML already comes as `Markup`."""

from __future__ import annotations

import base64
import hashlib
from functools import cache
from importlib.resources import files

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

PACKAGE = "smartnav_graph.output.report"


@cache
def _environment() -> Environment:
    loader = PackageLoader(PACKAGE)
    return Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True)


def filled(template: str, /, **values: object) -> Markup:
    """A template of the folder ``templates`` with its values."""
    return Markup(_environment().get_template(f"{template}.html").render(**values))


def whole_page(title: str, head: str, body: str, *, footer: str = "", utc_ms: int | None = None) -> str:
    """The page around head and body, which are HTML; `footer` is on every printed page, `utc_ms` is the Unix time
    of second zero, where known."""
    style, script = (files(PACKAGE).joinpath(name).read_text(encoding="utf-8") for name in ("style.css", "cursor.js"))
    script = script if " data-x=" in body else ""  # only a page with plots over time has a cursor
    quoted = footer.replace("\\", "").replace('"', "'").replace("\n", " ").replace("<", "‹")
    return filled(
        "page",
        title=title,
        style=Markup(style),
        script=Markup(script),
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        footer=Markup(f'"{quoted}"'),
        utc_ms=utc_ms,
        head=Markup(head),
        body=Markup(body),
    )
