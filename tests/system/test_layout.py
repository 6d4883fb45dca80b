"""The layout of the package: wings on floors, imports one way, no circle; few rooms, none small; names of one thing."""

import ast
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[2] / "copem_replay"
FLOORS = (
    {"core"},
    {"io", "perception", "communication"},
    {"fusion", "metrics"},
    {"experiment"},
    {"pipeline"},
    {"results"},
    {"viewer", "report"},
    {"api"},
    {"cli"},
    {"extras"},
    {"__init__"},  # the public API: no wing, and no wing imports it
)
MOST_LINES = {
    "core": 5_320, "io": 12_430, "perception": 3_820, "communication": 1_200, "fusion": 4_200, "metrics": 10_220,
    "experiment": 4_970, "pipeline": 6_750, "results": 7_430, "viewer": 5_450, "report": 5_250, "api": 1_210,
    "cli": 1_380, "extras": 15_710,
}  # fmt: skip
"""Of a wing. A change that needs more takes something away, or a decision raises the row."""
SMALL_LINES = 60
VERBS_OF_SEVERAL = {
    "frames", "list_recordings",  # what every converter of a data set gives
    "write_section",  # what every section of the report by an extra gives
    "run", "compare", "fit", "view", "why", "require",  # a command, and the function of the public API that does it
}  # fmt: skip
FLOOR = {wing: number for number, wings in enumerate(FLOORS, start=1) for wing in wings}
Edge = tuple[str, str]


def name_of(path: Path, root: Path) -> str:
    parts = list(path.relative_to(root.parent).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def wing_of(module: str) -> str:
    return [*module.split("."), "__init__"][1]


def imports(tree: ast.AST, at: str = "module") -> Iterator[tuple[ast.Import | ast.ImportFrom, str]]:
    """All imports of a module and where they stand: `module`, `function`, or `typing`."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node, at
        elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            yield from imports(node, "typing")
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda) and at == "module":
            yield from imports(node, "function")
        else:
            yield from imports(node, at)


@cache
def graph(root: Path) -> dict[Edge, set[str]]:
    """Which module of a package imports which, and where: (importer, imported) → places."""
    files = {name_of(path, root): path for path in root.rglob("*.py")}
    edges: dict[Edge, set[str]] = defaultdict(set)
    for module, path in files.items():
        for node, at in imports(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{path}: relative import"
                asked = [(node.module or "", f"{node.module}.{alias.name}") for alias in node.names]
            else:
                asked = [(alias.name, alias.name) for alias in node.names]
            for whole, part in asked:
                target = part if part in files else whole
                if target in files and target != module:
                    edges[module, target].add(at)
    return edges


def arrows_up(edges: dict[Edge, set[str]]) -> list[str]:
    """Imports of a wing from its own floor or a higher one."""
    return sorted(
        f"{a} imports {b}" for a, b in edges if wing_of(a) != wing_of(b) and FLOOR[wing_of(b)] >= FLOOR[wing_of(a)]
    )


def circles(edges: Iterable[Edge]) -> list[list[str]]:
    """Modules that import each other, wherever the imports stand: for types, in functions, at module level."""
    below = defaultdict(set)
    for a, b in edges:
        below[a].add(b)

    def reached(module: str) -> set[str]:
        seen: set[str] = set()
        ahead = [module]
        while ahead:
            new = below[ahead.pop()] - seen
            seen |= new
            ahead += new
        return seen

    return [sorted(reached(module) & below.keys()) for module in list(below) if module in reached(module)]


def rooms(root: Path) -> dict[str, str]:
    """The text of each module that is no `__init__`."""
    return {name_of(path, root): path.read_text() for path in root.rglob("*.py") if path.stem != "__init__"}


def small_rooms(root: Path) -> list[str]:
    """Modules of few lines that one other module imports: pieces of that one."""
    importers = Counter(b for _, b in graph(root))
    return sorted(name for name, text in rooms(root).items() if text.count("\n") < SMALL_LINES and importers[name] == 1)


def names_of_several(root: Path) -> dict[str, set[str]]:
    """Names of classes, and of public functions, that stand in several modules, and where."""
    places = defaultdict(set)
    for module, text in rooms(root).items():
        for node in ast.parse(text).body:
            public = isinstance(node, ast.FunctionDef) and not node.name.startswith("_")
            if isinstance(node, ast.ClassDef) or (public and node.name not in VERBS_OF_SEVERAL):
                places[node.name].add(module)
    return {name: modules for name, modules in places.items() if len(modules) > 1}


@pytest.mark.extras
def test_there_are_fourteen_wings_and_nothing_else() -> None:
    entries = {path.name for path in PACKAGE.iterdir() if path.name != "__pycache__"}
    assert entries == set(FLOOR) - {"__init__"} | {"__init__.py", "py.typed"}
    assert MOST_LINES.keys() == set(FLOOR) - {"__init__"}


def test_imports_between_wings_point_one_way() -> None:
    assert arrows_up(graph(PACKAGE)) == []


def test_no_circle() -> None:
    assert circles(graph(PACKAGE)) == []


def test_no_circle_among_tools() -> None:
    files = {path.stem: path for path in (PACKAGE.parent / "tools").glob("*.py")}
    edges = {
        (name, module)
        for name, path in files.items()
        for node, _ in imports(ast.parse(path.read_text()))
        for module in ([node.module] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names])
    }
    assert circles(edge for edge in edges if edge[1] in files) == []


@pytest.mark.extras
def test_no_room_is_a_piece_of_its_only_user() -> None:
    assert small_rooms(PACKAGE) == []


def test_no_wing_outgrows_its_budget() -> None:
    lines = Counter[str]()
    for path in PACKAGE.rglob("*.py"):
        lines[wing_of(name_of(path, PACKAGE))] += path.read_text().count("\n")
    assert {wing: lines[wing] for wing, most in MOST_LINES.items() if lines[wing] > most} == {}


@pytest.mark.extras
def test_the_public_api_alone_names_extras_and_for_types_alone() -> None:
    edges = {(a, tuple(sorted(at))) for (a, b), at in graph(PACKAGE).items() if wing_of(b) == "extras" != wing_of(a)}
    assert edges == {("copem_replay", ("typing",))}


def test_one_name_is_one_thing() -> None:
    assert names_of_several(PACKAGE) == {}


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ("from copem_replay.cli import main", ["copem_replay.core.a imports copem_replay.cli.main"]),
        ("def f():\n    from copem_replay.cli.main import x", ["copem_replay.core.a imports copem_replay.cli.main"]),
        ("from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import copem_replay.cli.main",
         ["copem_replay.core.a imports copem_replay.cli.main"]),
        ("from copem_replay.core import b", []),
    ],
)  # fmt: skip
def test_an_arrow_up_is_found_wherever_it_stands(tmp_path: Path, code: str, expected: list[str]) -> None:
    root = tmp_path / "copem_replay"
    for name, text in {"core/a.py": code, "core/b.py": "", "cli/main.py": "x = 1"}.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    assert arrows_up(graph(root)) == expected


@pytest.mark.parametrize(
    "code",
    [
        "from copem_replay.core import b",
        "def f():\n    from copem_replay.core import b",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from copem_replay.core.b import B",
    ],
)
def test_a_circle_is_found_wherever_its_imports_stand(tmp_path: Path, code: str) -> None:
    root = tmp_path / "copem_replay"
    (root / "core").mkdir(parents=True)
    (root / "core/a.py").write_text(code)
    (root / "core/b.py").write_text("from copem_replay.core import a\nB = 1\n")
    (root / "core/c.py").write_text("from copem_replay.core import a\n")
    both = ["copem_replay.core.a", "copem_replay.core.b"]
    assert circles(graph(root)) == [both, both]


def test_a_small_room_of_one_user_and_a_name_of_two_classes_are_found(tmp_path: Path) -> None:
    root = tmp_path / "copem_replay"
    (root / "core").mkdir(parents=True)
    (root / "core/a.py").write_text("from copem_replay.core import b\n\n\nclass Part:\n    x = 1\n" + "\n" * 60)
    (root / "core/b.py").write_text("class Part:\n    y = 1\n\n\ndef _hidden():\n    pass\n")
    (root / "core/c.py").write_text("def _hidden():\n    pass\n" + "\n" * 60)
    assert small_rooms(root) == ["copem_replay.core.b"]
    assert names_of_several(root) == {"Part": {"copem_replay.core.a", "copem_replay.core.b"}}
