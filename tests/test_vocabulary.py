"""The field's words: private words of earlier versions are in no name and in nothing that people read."""

from __future__ import annotations

import ast
import io
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

import smartnav_graph as sn
from smartnav_graph.cli import COMMANDS
from smartnav_graph.output.run_folder import write_run

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "smartnav_graph"

# Whole words and phrases, small or capital; `\w*` stands for any ending.
PHRASES = (
    *(r"holes?", r"straight lines", r"stamps leap", r"leaps?(?! seconds)", r"receiver hung", r"stray\w*"),
    *(r"wander\w*", r"rests? without turn", r"tak(?:es?|en) for granted", r"rests? on", r"as given", r"pull(?:s|ed)?"),
    *(r"what is uncertain about", r"nothing of weight", r"at this very instant", r"to speak of", r"sensors tell"),
    *(r"how sure", r"what happened when", r"run in figures", r"how the start was found", r"starts that were tried"),
    *(r"clocks, mounts and noise", r"while replaying", r"correction of the past", r"standing still", r"never found"),
    *(r"a session -> a run", r"foret(?:ell|old)\w*", r"time they speak of", r"hangs on", r"without being told"),
    *(r"rooms?", r"seams?", r"doors?", r"fates?", r"houses?", r"told", r"tell(?:s|ing)?", r"judg\w*", r"learnt"),
    *(r"sp(?:eaks?|oken|eaking) of", r"stands?", r"stood", r"teach\w*", r"taught", r"honest\w*", r"warm"),
    *(r"unsure", r"astray", r"beside each other", r"kept back", r"gradua(?:l|ted)ly narrow\w*"),
)
# Names of recordings and scenarios, and words for real things: simulated rooms, a photographed door.
PROPER = re.compile(r"lund_door|(?:rendered-)?room-\d+s|rendered-room")
REAL = {"smartnav_graph/simulation": {"room", "rooms"}, "datasets": {"room", "rooms", "door"}}
REAL["docs"] = {"room"}
# Whole names of functions, classes, modules, arguments and fields; they may name a local variable.
NAMES = {
    *("Step", "Tag", "Block", "Stack", "Memory", "settled", "revise", "_revised", "_grown", "widened", "_narrower"),
    *("row_noise", "pair_gate", "track_gate", "graduated", "reach", "trust", "moved", "late", "LateRow", "arrange"),
    *("forget", "_forget", "known_ns", "at_their_time", "consensus", "Agreement", "Agreed", "first_seconds", "eye"),
    *("first_field", "first_attitude", "walk_start", "first_state", "Initial", "Given", "There", "here", "Partial"),
    *("_shoot", "shot", "settle", "outcome", "trace", "Wiring", "wiring", "SeenPairs", "story", "holding", "Held"),
    *("bridging", "Look", "Learnt", "Eye", "eye_of", "pool", "consensus_pair", "meet", "cut", "recut", "made_of"),
    *("densify", "sensed", "placed", "turned", "chosen", "looks", "turn_share"),
}
# Parts of names, between underscores or capitals.
PARTS = {
    *("told", "tell", "judge", "judged", "foretell", "foretold", "room", "rooms", "house", "door", "seam", "fate"),
    *("teach", "learnt", "hole", "holes", "straying", "wander", "wanders", "honest", "unsure", "astray", "warm"),
}


def real_words(place: Path) -> set[str]:
    """Words that name real things in the files of a folder."""
    return next((words for folder, words in REAL.items() if str(place).startswith(folder)), set())


def found_in(text: str, allowed: Iterable[str] = ()) -> list[str]:
    """The phrases in a text, each with what is near it."""
    text = PROPER.sub("", text)
    if allowed:
        text = re.sub(rf"\b(?:{'|'.join(allowed)})\b", "", text, flags=re.IGNORECASE)
    pattern = rf"(?<![\w.])(?:{'|'.join(PHRASES)})(?!\w|\.\w|\(|=)"
    return [text[max(m.start() - 30, 0) : m.end() + 30] for m in re.finditer(pattern, text, re.IGNORECASE)]


def texts_of(source: str) -> Iterator[tuple[int, str]]:
    """Comments and strings of Python source, with their lines."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type in (tokenize.COMMENT, tokenize.STRING) or token.type == getattr(tokenize, "FSTRING_MIDDLE", -1):
            yield token.start[0], token.string


def names_of(tree: ast.AST) -> Iterator[tuple[int, str, bool]]:
    """The names that a module defines: line, name, whether it is more than a local variable."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef):
            yield node.lineno, node.name, True
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg, True
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            yield node.lineno, node.target.id, True
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id, False
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.attr, True


def private(name: str, own: bool, allowed: Iterable[str] = ()) -> bool:
    """Whether a name contains a private word, or (`own`, not of a local variable) is one."""
    parts = re.split(r"_+|(?<=[a-z0-9])(?=[A-Z])", name)
    return (own and name in NAMES) or any(part.lower() in PARTS.difference(allowed) for part in parts)


def sources() -> list[Path]:
    """Python files of the package and of the scripts."""
    scripts = [path for path in (ROOT / "scripts").iterdir() if path.is_file()]
    python = [path for path in scripts if path.suffix == ".py" or "python" in path.read_text().split("\n")[0]]
    return [*sorted(PACKAGE.rglob("*.py")), *sorted(python)]


def failures(found: Iterable[str]) -> str:
    return "\n".join(found)


def test_names_are_the_fields() -> None:
    found = []
    for path in sources():
        place = path.relative_to(ROOT)
        found += [f"{place}: module"] if path.parent != ROOT / "scripts" and private(path.stem, True) else []
        tree = ast.parse(path.read_text(encoding="utf-8"))
        named = [(line, name) for line, name, own in names_of(tree) if private(name, own, real_words(place))]
        found += [f"{place}:{line}: {name}" for line, name in named]
    assert not found, failures(found)


def test_docstrings_comments_and_messages_are_the_fields() -> None:
    found = []
    for path in sources():
        for line, text in texts_of(path.read_text(encoding="utf-8")):
            place = path.relative_to(ROOT)
            found += [f"{place}:{line}: {part!r}" for part in found_in(text, real_words(place))]
    assert not found, failures(found)


def test_pages_are_the_fields() -> None:
    found = []
    site = [path for path in sorted((ROOT / "docs").rglob("*")) if path.suffix in (".md", ".py")]
    for path in [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "datasets").glob("*.md")), *site]:
        if path.name != "CHANGELOG.md":  # it names what was renamed
            place, text = path.relative_to(ROOT), path.read_text(encoding="utf-8")
            found += [f"{place}: {part!r}" for part in found_in(text, real_words(place))]
    assert not found, failures(found)


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help_is_the_fields(command: str) -> None:
    line = [sys.executable, "-m", "smartnav_graph", *([command] if command else []), "--help"]
    text = subprocess.run(line, capture_output=True, text=True, check=True).stdout
    assert len(text) > 100
    assert not found_in(" ".join(text.replace("│", " ").split()))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A replay with a data gap, a standstill, withheld fixes and image tracks."""
    path = tmp_path_factory.mktemp("words") / "run"
    write_run(sn.run(sn.simulate("room-30s", 1), end_s=8.0, causal=True), path)
    return path


def test_report_is_the_fields(folder: Path) -> None:
    from lxml import html

    page = html.fromstring((folder / "report.html").read_text(encoding="utf-8"))
    text = " ".join(" ".join(page.xpath("//text()[not(parent::style)]")).split())
    attributes = " ".join([*page.xpath("//@id"), *page.xpath("//@class"), *page.xpath("//@aria-label")])
    assert "Timeline" in text and not found_in(text) and not found_in(attributes.replace("-", " "))


def test_recording_is_the_fields(folder: Path) -> None:
    from recordings import Recording

    recording = Recording(folder / "run.rrd")
    texts = [path.replace("/", " ").replace("_", " ") for path in recording.paths] + recording.view_names()
    for chunk in recording.chunks:
        batch = chunk.to_record_batch()
        for field, column in zip(batch.schema, batch.columns, strict=True):
            if "utf8" in str(field.type) or "string" in str(field.type):
                texts += [str(item) for row in column.to_pylist() if row for item in row]
    assert len(texts) > 100
    assert not [part for text in set(texts) for part in found_in(text)]


def test_explanation_is_the_fields(folder: Path) -> None:
    from smartnav_graph.output.explain import explain
    from smartnav_graph.output.run_folder import read_run

    assert not found_in(explain(read_run(folder)).to_text())
