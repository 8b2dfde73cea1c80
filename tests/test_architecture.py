"""Data flows one way: a module imports only from the rooms above its own."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "smartnav_graph"

# From the ground up. A room is a module or a folder of modules.
ORDER = (
    *("core", "session", "readers", "simulation", "vision", "graph", "factors", "smoothers", "estimate"),
    *("evaluation", "output", "cli", "__main__"),
)
DOOR = "__init__"  # it alone may look everywhere
HEAVY = {"rerun", "cv2", "pycolmap", "evo", "pandas", "matplotlib"}

FILES = sorted(PACKAGE.rglob("*.py"))


def room(file: Path) -> str:
    return file.relative_to(PACKAGE).with_suffix("").parts[0]


def name(file: Path) -> str:
    return str(file.relative_to(PACKAGE))


def imports(tree: ast.AST) -> Iterator[tuple[ast.stmt, str]]:
    """Every import in a module, as dotted names, wherever it stands."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative import"
            module = node.module or ""
            yield node, module
            if module == "smartnav_graph":
                yield from ((node, f"{module}.{alias.name}") for alias in node.names)


def parsed(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding="utf-8"))


@pytest.mark.parametrize("file", FILES, ids=name)
def test_imports_go_upwards_only(file):
    if room(file) == DOOR:
        return
    assert room(file) in ORDER, f"{room(file)} has no place in the order"
    above = set(ORDER[: ORDER.index(room(file)) + 1])
    used = {module.split(".")[1] for _, module in imports(parsed(file)) if module.startswith("smartnav_graph.")}
    assert used <= above, f"{name(file)} imports from below: {sorted(used - above)}"


@pytest.mark.parametrize("file", FILES, ids=name)
def test_heavy_libraries_are_imported_inside_functions(file):
    tree = parsed(file)
    top = ast.Module([node for node in tree.body if not isinstance(node, ast.FunctionDef | ast.ClassDef)], [])
    found = {module.split(".")[0] for _, module in imports(_without_type_checking(top))} & HEAVY
    assert not found, f"{name(file)} imports {sorted(found)} when it is loaded"


def _without_type_checking(tree: ast.Module) -> ast.Module:
    kept = [node for node in tree.body if not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")]
    return ast.Module(kept, [])


@pytest.mark.parametrize("file", FILES, ids=name)
def test_only_one_room_knows_rerun(file):
    if "rerun_log" not in file.parts:
        assert "rerun" not in {module.split(".")[0] for _, module in imports(parsed(file))}


@pytest.mark.parametrize("file", FILES, ids=name)
def test_no_print_exit_or_bare_except_outside_the_command_line(file):
    for node in ast.walk(parsed(file)):
        if isinstance(node, ast.ExceptHandler):
            assert node.type is not None, f"{name(file)}:{node.lineno} bare except"
        if isinstance(node, ast.Call) and room(file) not in ("cli", "__main__"):
            assert ast.unparse(node.func) not in ("print", "sys.exit", "exit", "quit"), f"{name(file)}:{node.lineno}"


def test_the_order_names_the_rooms_that_are():
    assert {room(file) for file in FILES} - {DOOR} == set(ORDER)


def test_the_rule_sees_a_violation(tmp_path):
    source = "from smartnav_graph import report\nimport rerun\nfrom smartnav_graph.cli.text import run_text\n"
    found = [module for _, module in imports(ast.parse(source))]
    assert found == ["smartnav_graph", "smartnav_graph.report", "rerun", "smartnav_graph.cli.text"]
