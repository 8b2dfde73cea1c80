"""The layout of the package: imports run downwards only, and sizes stay within bounds."""

import ast
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "smartnav_graph"

# From the ground up: a folder imports only from itself and from those before it.
ORDER = (
    *("core", "session", "readers", "simulation", "vision", "graph", "factors", "smoothers", "estimate"),
    *("evaluation", "calibrate", "output", "cli", "__main__"),
)
API = "__init__"  # it alone may import everything
HEAVY = {"rerun", "cv2", "pycolmap", "pandas", "matplotlib"}

FOLDERS, FILE_LINES, FUNCTION_LINES = 13, 400, 60
ANY = 60  # uses of typing.Any in the package
# Names that have one role in every module of a kind; they are used with the name of the module.
SAME_ROLE = {"build", "draw", "fit", "load", "read", "replay", "smooth"}

FILES = sorted(PACKAGE.rglob("*.py"))


def folder_of(file: Path) -> str:
    return file.relative_to(PACKAGE).with_suffix("").parts[0]


def name(file: Path) -> str:
    return str(file.relative_to(PACKAGE))


def imports(tree: ast.AST) -> Iterator[tuple[ast.stmt, str]]:
    """Every import in a module, as dotted names, at any depth."""
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


def lengths(tree: ast.AST) -> dict[str, int]:
    """Lines of every function of a module, decorators not counted."""
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    return {node.name: (node.end_lineno or node.lineno) - node.lineno + 1 for node in functions}


def count_any(tree: ast.AST) -> int:
    return sum(isinstance(node, ast.Name) and node.id == "Any" for node in ast.walk(tree))


def public_names(tree: ast.Module) -> set[str]:
    """Classes and functions that a module defines at its top level for others."""
    found = {node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    return {name for name in found if not name.startswith("_")}


@pytest.mark.parametrize("file", FILES, ids=name)
def test_imports_run_downwards_only(file):
    if folder_of(file) == API:
        return
    assert folder_of(file) in ORDER, f"{folder_of(file)} has no place in the order"
    below = set(ORDER[: ORDER.index(folder_of(file)) + 1])
    used = {module.split(".")[1] for _, module in imports(parsed(file)) if module.startswith("smartnav_graph.")}
    assert used <= below, f"{name(file)} imports upwards: {sorted(used - below)}"


@pytest.mark.parametrize("file", FILES, ids=name)
def test_heavy_libraries_are_imported_inside_functions(file):
    """The recording, which needs Rerun everywhere, counts as a heavy library of its own."""
    tree = parsed(file)
    top = ast.Module([node for node in tree.body if not isinstance(node, ast.FunctionDef | ast.ClassDef)], [])
    modules = {module for _, module in imports(_without_type_checking(top))}
    found = {module.split(".")[0] for module in modules} & HEAVY
    if "rerun_log" in file.parts:
        found -= {"rerun"}
    else:
        found |= {module for module in modules if module.startswith("smartnav_graph.output.rerun_log")}
    assert not found, f"{name(file)} imports {sorted(found)} when it is loaded"


def _without_type_checking(tree: ast.Module) -> ast.Module:
    kept = [node for node in tree.body if not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")]
    return ast.Module(kept, [])


@pytest.mark.parametrize("file", FILES, ids=name)
def test_only_the_recording_knows_rerun(file):
    if "rerun_log" not in file.parts:
        assert "rerun" not in {module.split(".")[0] for _, module in imports(parsed(file))}


@pytest.mark.parametrize("file", FILES, ids=name)
def test_no_print_exit_or_bare_except_outside_the_command_line(file):
    for node in ast.walk(parsed(file)):
        if isinstance(node, ast.ExceptHandler):
            assert node.type is not None, f"{name(file)}:{node.lineno} bare except"
        if isinstance(node, ast.Call) and folder_of(file) not in ("cli", "__main__"):
            assert ast.unparse(node.func) not in ("print", "sys.exit", "exit", "quit"), f"{name(file)}:{node.lineno}"


def test_the_order_lists_the_folders_that_exist():
    assert {folder_of(file) for file in FILES} - {API} == set(ORDER)


def test_the_package_has_few_folders_and_no_loose_modules():
    entries = {path.name for path in PACKAGE.iterdir()} - {"__pycache__"}
    assert {entry for entry in entries if "." in entry} == {"__init__.py", "__main__.py", "py.typed"}
    assert sum("." not in entry for entry in entries) <= FOLDERS


@pytest.mark.parametrize("file", FILES, ids=name)
def test_files_and_functions_are_short(file):
    assert len(file.read_text(encoding="utf-8").splitlines()) <= FILE_LINES
    too_long = {function: lines for function, lines in lengths(parsed(file)).items() if lines > FUNCTION_LINES}
    assert not too_long, f"{name(file)}: {too_long}"


def test_values_have_types():
    assert sum(count_any(parsed(file)) for file in FILES) <= ANY


def test_a_public_name_means_one_thing():
    homes = defaultdict(list)
    for file in FILES:
        for public in public_names(parsed(file)):
            homes[public].append(name(file))
    several = {public: files for public, files in homes.items() if len(files) > 1 and public not in SAME_ROLE}
    assert not several


def test_the_rules_see_violations():
    source = "from smartnav_graph import report\nimport rerun\nfrom smartnav_graph.cli.text import run_text\n"
    found = [module for _, module in imports(ast.parse(source))]
    assert found == ["smartnav_graph", "smartnav_graph.report", "rerun", "smartnav_graph.cli.text"]
    source = "def f(x: Any) -> dict[str, Any]:\n    return {}\n\nclass _C:\n    def g(self):\n        pass\n"
    assert count_any(ast.parse(source)) == 2 and public_names(ast.parse(source)) == {"f"}
    assert lengths(ast.parse(source)) == {"f": 2, "g": 2}


def test_files_of_tests_have_names_of_their_own():
    """Those in folders that are no packages: pytest imports them by name alone."""
    files = [
        file.name for file in Path(__file__).parent.rglob("test_*.py") if not (file.parent / "__init__.py").exists()
    ]
    assert not {file for file in files if files.count(file) > 1}
