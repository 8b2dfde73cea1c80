"""Every public name of the package says what it is."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator
from pathlib import Path

import smartnav_graph as sn

PACKAGE = Path(__file__).parents[1] / "smartnav_graph"
Defined = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef


def public(body: list[ast.stmt]) -> Iterator[Defined]:
    return (one for one in body if isinstance(one, Defined) and not one.name.startswith("_"))


def is_documented(one: Defined) -> bool:
    """Whether it has a docstring; that of an overload is at its implementation."""
    names = [ast.unparse(mark) for mark in one.decorator_list]
    return ast.get_docstring(one) is not None or "overload" in names or any(name.endswith(".setter") for name in names)


def signature(one: Defined) -> tuple[str, ...]:
    """Name and names of the arguments."""
    arguments = [] if isinstance(one, ast.ClassDef) else [argument.arg for argument in one.args.args]
    return (one.name, *arguments)


def missing(trees: dict[str, ast.Module]) -> Iterator[str]:
    """Public modules, functions, classes and methods without a docstring.

    A method that overrides a documented one of the package, as those of builders and commands do, has that of the
    method that it overrides; one with name and arguments of a documented method of a protocol has that.
    """
    classes = {one.name: one for tree in trees.values() for one in public(tree.body) if isinstance(one, ast.ClassDef)}
    protocols = [one for one in classes.values() if "Protocol" in map(ast.unparse, one.bases)]
    promised = {signature(method) for one in protocols for method in public(one.body) if is_documented(method)}

    def inherits(kind: ast.ClassDef, method: str) -> bool:
        for base in map(ast.unparse, kind.bases):
            parent = classes.get(base.split("[")[0].split(".")[-1])
            if parent is None:
                continue
            own = next((one for one in public(parent.body) if one.name == method), None)
            if (own is not None and is_documented(own)) or inherits(parent, method):
                return True
        return False

    for place, tree in trees.items():
        if tree.body and ast.get_docstring(tree) is None:
            yield f"{place}: module"
        for one in public(tree.body):
            if not is_documented(one):
                yield f"{place}:{one.lineno}: {one.name}"
            if isinstance(one, ast.ClassDef):
                for method in public(one.body):
                    promise = is_documented(method) or inherits(one, method.name) or signature(method) in promised
                    if not promise:
                        yield f"{place}:{method.lineno}: {one.name}.{method.name}"


def package() -> dict[str, ast.Module]:
    return {
        path.relative_to(PACKAGE.parent).as_posix(): ast.parse(path.read_text(encoding="utf-8"))
        for path in sorted(PACKAGE.rglob("*.py"))
    }


def test_every_public_name_has_a_docstring():
    assert not list(missing(package()))


def test_a_name_without_one_is_found():
    method = '    """About."""\n    def f(self): ...\n'
    source = f'"""About."""\nclass A:\n{method}\nclass B(A):\n{method}'
    assert list(missing({"m.py": ast.parse(source)})) == ["m.py:4: A.f", "m.py:8: B.f"]
    assert not list(missing({"m.py": ast.parse(source.replace("f(self): ...", 'f(self): """It."""', 1))}))
    assert list(missing({"m.py": ast.parse("def f(): ...\ndef _g(): ...")})) == ["m.py: module", "m.py:1: f"]


def test_names_that_notebooks_use_describe_themselves():
    for name in sn.__all__:
        text = inspect.getdoc(getattr(sn, name)) or ""
        assert len(text) > 20 and not text.startswith(f"{name}("), name
