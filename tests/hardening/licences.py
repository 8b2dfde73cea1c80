"""Licences of all pinned packages, those of the tests too, as their metadata state them: docs/licences.md.

python tests/hardening/licences.py > docs/licences.md
"""

import re
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path

PINS = Path(__file__).parents[2] / "constraints.txt"
COPYLEFT = re.compile(r"\bA?GPL|GNU (Affero )?General|SSPL|Commons Clause")
HEAD = """# Licences

Of every package of constraints.txt, as its metadata state it; a test checks that none is under the GPL.

| package | licence |
|---|---|
"""


def licence(name):
    """The licence that a package states; None where it is not installed."""
    try:
        about = metadata(name)
    except PackageNotFoundError:
        return None
    classifiers = [text.rpartition(" :: ")[2] for text in about.get_all("Classifier") or [] if "License ::" in text]
    first = (about["License"] or "").strip().split("\n")[0][:80]
    return about["License-Expression"] or ", ".join(classifiers) or first or "not stated"


def rows(names=None):
    """Licences by package."""
    pinned = [line.split("==")[0] for line in PINS.read_text().splitlines() if line and line[0] != "#"]
    return {name: found for name in names or pinned if (found := licence(name)) is not None}


if __name__ == "__main__":
    print(HEAD + "\n".join(f"| {name} | {text} |" for name, text in sorted(rows().items())))
