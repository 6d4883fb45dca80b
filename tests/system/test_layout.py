"""The layout of the package: wings on floors, imports one way, no circle, no long chain."""

import ast
from collections import defaultdict
from collections.abc import Iterator
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
    {"cli"},
    {"__init__"},  # the public API: no wing, and no wing imports it
)
LONGEST_CHAIN = 16
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


def longest_chain(edges: dict[Edge, set[str]]) -> list[str]:
    """The longest chain of module-level imports. Fails on a circle."""
    below = defaultdict(list)
    for (a, b), places in edges.items():
        if "module" in places:
            below[a].append(b)
    longest: dict[str, list[str]] = {}

    def chain(module: str, above: tuple[str, ...]) -> list[str]:
        assert module not in above, f"a circle: {' → '.join([*above, module])}"
        if module not in longest:
            longest[module] = [module, *max((chain(b, (*above, module)) for b in below[module]), key=len, default=[])]
        return longest[module]

    return max((chain(module, ()) for module in list(below)), key=len)


def test_there_are_twelve_wings_and_nothing_else() -> None:
    entries = {path.name for path in PACKAGE.iterdir() if path.name != "__pycache__"}
    assert entries == set(FLOOR) - {"__init__"} | {"__init__.py", "py.typed"}
    assert len(FLOORS) - 1 <= 8
    assert sum(map(len, FLOORS)) - 1 <= 12


def test_imports_between_wings_point_one_way() -> None:
    assert arrows_up(graph(PACKAGE)) == []


def test_no_circle_and_no_long_chain() -> None:
    chain = longest_chain(graph(PACKAGE))
    assert len(chain) <= LONGEST_CHAIN, "\n".join(chain)


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


def test_a_circle_is_found(tmp_path: Path) -> None:
    root = tmp_path / "copem_replay"
    (root / "core").mkdir(parents=True)
    (root / "core/a.py").write_text("from copem_replay.core import b")
    (root / "core/b.py").write_text("from copem_replay.core import a")
    with pytest.raises(AssertionError, match="circle"):
        longest_chain(graph(root))
