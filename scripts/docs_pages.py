"""Pages of the documentation that are made when it is built, as a hook of mkdocs.

Notebooks (`docs/tutorials/*.py`, `docs/gallery.py`) are executed and shown with their outputs; commands, configuration
and formats are described by the package itself; formulas become MathML, so that no script is needed to show them. After
the build every link inside the site is followed.
"""

from __future__ import annotations

import base64
import dataclasses
import html
import os
import re
import sys
import tempfile
import textwrap
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import jupytext
import latex2mathml.converter
import nbformat
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from nbclient import NotebookClient

import smartnav_graph as sn
from smartnav_graph.calibrate import KINDS
from smartnav_graph.cli import COMMANDS, command_class
from smartnav_graph.cli.help import described, help_text, shown_value
from smartnav_graph.estimate.config import Config
from smartnav_graph.readers import READERS
from smartnav_graph.session.stream import Stream

FORMULA = re.compile(r'<(span|div) class="arithmatex">(.*?)</\1>', re.DOTALL)
CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
WARNING = re.compile(r"(?m)^\S+\.py:\d+: (?=\w*Warning: )")
CELL_SECONDS = 240
FIRST = ("load", "smooth", "run", "Session", "Solution", "Run")
_made = dict[tuple[str, str], dict[str, str | bytes]]()


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made here."""
    pages: dict[str, str | bytes] = {
        "reference/commands.md": commands_page(),
        "reference/configuration.md": configuration_page(),
        "reference/formats.md": formats_page(),
        "reference/python.md": python_page(),
    }
    root = Path(config.docs_dir)
    for source in sorted([*root.glob("tutorials/*.py"), root / "gallery.py"]):
        text, name = source.read_text(encoding="utf-8"), source.relative_to(root).with_suffix("").as_posix()
        if (name, text) not in _made:  # while mkdocs serves, only what was changed is executed again
            _made[name, text] = notebook_pages(source, name)
        pages |= _made[name, text]
        files.remove(files.src_uris[source.relative_to(root).as_posix()])
    for name, content in pages.items():
        files.append(File.generated(config, name, content=content))
    return files


def on_page_content(text: str, **_: object) -> str:
    """Formulas as MathML."""
    return FORMULA.sub(_mathml, text)


def on_post_build(config: MkDocsConfig) -> None:
    """Refuse links that lead nowhere, and anything that a page would load from the network."""
    faults = list(broken_links(Path(config.site_dir)))
    if faults:
        raise PluginError("\n".join(faults))


def _mathml(match: re.Match[str]) -> str:
    block = match.group(1) == "div"
    tex = html.unescape(match.group(2)).strip().removeprefix(r"\[").removesuffix(r"\]")
    tex = tex.removeprefix(r"\(").removesuffix(r"\)").strip()
    shown = latex2mathml.converter.convert(tex, display="block" if block else "inline")
    return f'<div class="formula" tabindex="0" role="region" aria-label="formula">{shown}</div>' if block else shown


# ---------------------------------------------------------------------------------------------------- notebooks


def notebook_pages(source: Path, name: str) -> dict[str, str | bytes]:
    """A notebook as a page with its outputs, its figures, the files that it links to, and itself to download."""
    notebook = jupytext.read(source)
    pages: dict[str, str | bytes] = {f"{name}.ipynb": nbformat.writes(notebook)}
    with tempfile.TemporaryDirectory() as folder:
        run(notebook, Path(folder), source)
        stem = Path(name).name
        text = [f"[Download this page as a notebook]({stem}.ipynb){{ .notebook }}\n"]
        for number, cell in enumerate(notebook.cells):
            if cell.cell_type == "markdown":
                text.append(cell.source)
                continue
            text.append(shown_code(cell))
            for part, figure in enumerate(outputs(cell, alternative=cell.metadata.get("alt", ""))):
                if isinstance(figure, str):
                    text.append(figure)
                    continue
                picture, alternative = figure
                file = f"{stem}-{number}-{part}.png"
                pages[str(Path(name).parent / file)] = picture
                text.append(f"![{alternative}]({file})")
        page = "\n\n".join(text) + "\n"
        for link in re.findall(r"\]\(([^)#:]+)\)", page):
            if (made := Path(folder) / link).is_file():
                pages[str(Path(name).parent / link)] = made.read_bytes()
    title, _, rest = page.partition("\n# ")
    heading, _, body = rest.partition("\n")
    return {f"{name}.md": f"# {heading}\n\n{title}\n{body}", **pages}


def shown_code(cell: nbformat.NotebookNode) -> str:
    """The code of a cell: lines of the shell as such; folded where the cell is tagged so."""
    shell = all(line.startswith(("!", "#")) for line in cell.source.splitlines())
    code = re.sub("(?m)^!", "", cell.source) if shell else cell.source
    fence = f"```{'bash' if shell else 'python'}\n{code}\n```"
    if "fold" not in cell.metadata.get("tags", ()):
        return fence
    return f'??? example "{cell.metadata.get("title", "Code")}"\n\n' + textwrap.indent(fence, "    ")


def run(notebook: nbformat.NotebookNode, folder: Path, source: Path) -> None:
    """Execute a notebook in an empty folder; its outputs are put into it."""
    path = os.pathsep.join(filter(None, [str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH")]))
    programs = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    environment = {**os.environ, "PYTHONPATH": path, "PATH": programs, "COLUMNS": "88", "NO_COLOR": "1"}
    environment |= {"TERM": "dumb", "MPLBACKEND": "module://matplotlib_inline.backend_inline"}
    client = NotebookClient(
        notebook,
        timeout=CELL_SECONDS,
        kernel_name="python3",
        resources={"metadata": {"path": str(folder)}},
        coalesce_streams=True,
        extra_arguments=["--log-level=ERROR"],
    )
    try:
        client.execute(env=environment)
    except Exception as error:
        raise PluginError(f"{source}: {error}") from error


def outputs(cell: nbformat.NotebookNode, alternative: str) -> Iterator[str | tuple[bytes, str]]:
    """What a cell gave: text, tables, and figures with the words for those who do not see them."""
    for output in cell.outputs:
        data = output.get("data", {"text/plain": output.get("text", "")})
        if "image/png" in data:
            if not alternative:
                raise PluginError(f"a figure without description: add alt=... to the cell {cell.source[:60]!r}")
            yield base64.b64decode(data["image/png"]), alternative
        elif "text/html" in data:
            table = re.sub(r"<style.*?</style>", "", data["text/html"], flags=re.DOTALL)
            table = table.replace("<table>", '<table class="facts">')  # the theme would wrap it a second time
            yield f'<div class="output" tabindex="0" role="region" aria-label="output">{table}</div>'
        elif text := plain_text(data["text/plain"], cell.source):
            yield f'```text title="Output"\n{text}\n```'


def plain_text(text: str, source: str) -> str:
    """Text without codes of the terminal, and warnings without the place of the cell, which is that of a kernel."""
    echoed = {f"  {line.strip()}" for line in source.splitlines()}
    lines = WARNING.sub("", CONTROL.sub("", text)).rstrip().splitlines()
    return "\n".join(line for line in lines if line not in echoed or "Warning: " not in text)


# --------------------------------------------------------------------------------------------------- references


def commands_page() -> str:
    """Every command with its help."""
    lines = ["# Commands", "", "What `smartnav COMMAND --help` prints. The options of the configuration, which "]
    lines[-1] += "`--help-all` adds, are on the page [Configuration](configuration.md)."
    lines += ["", "| command | |", "|---|---|"]
    lines += [f"| [`smartnav {name}`](#{name}) | {summary} |" for name, (_, _, summary) in COMMANDS.items()]
    lines += ["", "Exit codes: 0 done; 1 a named error; 2 wrong usage; 3 done and written, but the measurements "]
    lines[-1] += "contradict each other; 130 interrupted; 143 terminated."
    for name, (_, _, summary) in COMMANDS.items():
        lines += ["", f"## {name}", "", f"{summary[:1].upper()}{summary[1:]}.", "", *_fenced(_help(name))]
        for kind in KINDS if name == "calibrate" else ():
            lines += ["", f"### calibrate {kind}", "", *_fenced(_help(name, kind))]
    return "\n".join(lines) + "\n"


def _help(name: str, *arguments: str) -> str:
    kind, full, _ = command_class(name).narrowed(name, [*arguments, "--help"])
    return help_text(kind, full)


def _fenced(text: str) -> list[str]:
    return ["```text", text, "```"]


def configuration_page() -> str:
    """Every option of the configuration, with its default."""
    lines = ["# Configuration", "", "Sections and keys of config.toml (`smartnav config --dump` prints all of them), "]
    lines[-1] += "options `--section.key VALUE` of `smooth` and `replay`, and fields of `smartnav_graph.Config`."
    for section in dataclasses.fields(Config):
        options = section.default_factory()  # type: ignore[misc]
        texts = described(type(options))
        lines += ["", f"## {section.name}", "", "| key | default | meaning |", "|---|---|---|"]
        for field in dataclasses.fields(options):
            text = texts.get(field.name, "").replace("|", "\\|")
            lines.append(f"| `{field.name}` | {shown_value(getattr(options, field.name))} | {text} |")
    return "\n".join(lines) + "\n"


def formats_page() -> str:
    """The formats that are read."""
    lines = ["# Formats that are read", "", "`smartnav import SOURCE --out SESSION` recognises a file, folder or "]
    lines[-1] += "archive by its content; `--format NAME` chooses one. Other text files: "
    lines[-1] += "[Bring in a log](../how-to/logs.md#any-other-text-file). This list is that of `smartnav formats`."
    lines += ["", "| name | what it is | recognised by |", "|---|---|---|"]
    lines += [f"| `{r.name}` | {_cell(r.summary)} | {_cell(r.recognised_by)} |" for r in READERS.values()]
    return "\n".join(lines) + "\n"


def python_page() -> str:
    """Every public name, from its docstring."""
    names = {name: getattr(sn, name) for name in sn.__all__}
    groups = {"Functions": [], "Recordings and results": [], "Streams": [], "Errors": []}  # type: dict[str, list[str]]
    for name, found in names.items():
        if not isinstance(found, type):
            groups["Functions"].append(name)
        elif issubclass(found, Stream):
            groups["Streams"].append(name)
        else:
            groups["Errors" if issubclass(found, Exception) else "Recordings and results"].append(name)
    lines = ["# Python", "", "```python", "import smartnav_graph as sn", "```", "", "Everything on this page is "]
    lines[-1] += "`sn.NAME`. Frames, units and signs: [Conventions](../understand/conventions.md). Columns of "
    lines[-1] += "the streams: [The session folder](../session-format.md)."
    for title, members in groups.items():
        lines += ["", f"## {title}"]
        for name in sorted(members, key=lambda one: (one not in FIRST, one.lower())):
            lines += ["", f"::: {names[name].__module__}.{names[name].__qualname__}"]
            if title == "Streams":
                lines += ["    options:", "      inherited_members: false"]
    return "\n".join(lines) + "\n"


def _cell(text: str) -> str:
    return html.escape(text, quote=False).replace("|", "\\|")


# -------------------------------------------------------------------------------------------------------- links


class _Page(HTMLParser):
    """Anchors, links, and what a page loads."""

    def __init__(self) -> None:
        super().__init__()
        self.anchors, self.links, self.loaded = set[str](), list[str](), list[str]()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self.anchors |= {values[name] for name in ("id", "name") if name in values}
        if tag == "a" and "href" in values:
            self.links.append(values["href"])
        elif tag in ("img", "script", "iframe", "source") and "src" in values:
            self.loaded.append(values["src"])
        elif tag == "link" and values.get("rel") not in ("canonical", "prev", "next"):
            self.loaded.append(values.get("href", ""))


def broken_links(site: Path) -> Iterator[str]:
    """Links inside a site that lead nowhere, and addresses of the network that its pages load something from."""
    pages = dict[Path, _Page]()
    for path in site.rglob("*.html"):
        pages[path.resolve()] = _Page()
        pages[path.resolve()].feed(path.read_text(encoding="utf-8"))
    for path, page in pages.items():
        where = path.relative_to(site.resolve())
        for link in [*page.links, *page.loaded]:
            parts = urlsplit(link)
            if parts.scheme in ("data", "mailto", "javascript"):
                continue
            if parts.scheme or parts.netloc:
                if link in page.loaded:
                    yield f"{where}: loads {link}"
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if where.name == "404.html" and parts.path.startswith("/"):
                target = (site / unquote(parts.path).lstrip("/")).resolve()
            target = target / "index.html" if target.is_dir() else target
            if not target.is_file():
                yield f"{where}: {link} does not exist"
            elif target in pages and unquote(parts.fragment) not in {"", *pages[target].anchors}:
                yield f"{where}: {link} has no such anchor"
