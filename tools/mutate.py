"""Change one thing in a module that makes numbers, and see whether a test fails: 100 times, chosen by seed.

python tools/mutate.py [--mutants 100] [--seed 0] [--from 0] [--only 7 12] [--near] [--out out/mutants.csv]

Works on a copy. Of each mutant the tests that import its module come first, then those of its wing, then the others but
notebooks, docs and browsers; `--near`: without these others. What ends within no reasonable time is killed, too. The
test that fails is named. Survivors are for a reader: some change nothing that can be told (equivalent), the others want
a test.
"""

from __future__ import annotations

import argparse
import ast
import csv
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
WINGS = ("core", "perception", "communication", "fusion", "metrics")
_FAR = ("tests/system", "tests/viewer", "tests/report", "tests/cli")
_LONGEST_S = {"module": 900, "wing": 900, "all": 2400}

_COMPARED = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq}
_COMPUTED = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.BitAnd: ast.BitOr,
             ast.BitOr: ast.BitAnd, ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult}  # fmt: skip
_CALLED = {"min": "max", "minimum": "maximum", "any": "all", "sin": "cos", "argmin": "argmax", "floor": "ceil",
           "cumsum": "sort", "ones": "zeros"}  # fmt: skip
_COMPILED = "copem_replay.core.compiled import"
"""What a module with compiled functions has; its mutants are compiled, which takes time."""
_CALLED |= {after: before for before, after in _CALLED.items() if before != "cumsum"}


@dataclass(frozen=True)
class Mutant:
    """One change: where, from what, to what."""

    path: Path
    line: int
    before: str
    after: str
    text: str  # of the whole changed module

    def __str__(self) -> str:
        return f"{self.path.relative_to(ROOT)}:{self.line}: {self.before} -> {self.after}"


def mutants_of(path: Path) -> Iterator[Mutant]:
    """Every change of a module."""
    text = path.read_text(encoding="utf-8")
    starts = [0]
    for line in text.splitlines(keepends=True):
        starts.append(starts[-1] + len(line.encode()))
    for node in _inside(ast.parse(text)):
        changed = _changed(node)
        if changed is None:
            continue
        assert isinstance(node, ast.expr)
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        begin, end = starts[node.lineno - 1] + node.col_offset, starts[node.end_lineno - 1] + node.end_col_offset
        raw = text.encode()
        whole = (raw[:begin] + f"({changed})".encode() + raw[end:]).decode()
        yield Mutant(path, node.lineno, ast.unparse(node), changed, whole)


def _inside(node: ast.AST) -> Iterator[ast.AST]:
    """What is computed: no annotations, no decorators, no text, nothing for the type checker alone."""
    yield node
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "type_params", "msg", "exc"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.JoinedStr | ast.Raise) or not isinstance(child, ast.AST):
                continue
            if isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
                continue
            yield from _inside(child)


def _changed(node: ast.AST) -> str | None:
    """The changed expression; None: this node is not changed."""
    match node:
        case ast.Compare(left=left, ops=[op], comparators=[right]) if type(op) in _COMPARED:
            return ast.unparse(ast.Compare(left, [_COMPARED[type(op)]()], [right]))
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _COMPUTED:
            if isinstance(left, ast.Constant) and isinstance(left.value, str):
                return None
            return ast.unparse(ast.BinOp(left, _COMPUTED[type(op)](), right))
        case ast.BoolOp(op=op, values=values):
            return ast.unparse(ast.BoolOp(ast.Or() if isinstance(op, ast.And) else ast.And(), values))
        case ast.UnaryOp(op=ast.Not() | ast.USub() | ast.Invert(), operand=operand):
            return None if isinstance(operand, ast.Constant) else ast.unparse(operand)
        case ast.IfExp(test=test, body=body, orelse=orelse):
            return ast.unparse(ast.IfExp(test, orelse, body))
        case ast.Constant(value=bool() as value):
            return str(not value)
        case ast.Constant(value=int() as value):
            return str(value + 1)
        case ast.Constant(value=float() as value):
            return str(value * 1.25 if value else 1.0)
        case ast.Call(func=ast.Attribute(value=inner, attr=name), args=args, keywords=keys) if name in _CALLED:
            return ast.unparse(ast.Call(ast.Attribute(inner, _CALLED[name], ast.Load()), args, keys))
        case ast.Call(func=ast.Name(id=name), args=args, keywords=keys) if name in _CALLED:
            return ast.unparse(ast.Call(ast.Name(_CALLED[name], ast.Load()), args, keys))
    return None


def chosen(count: int, seed: int) -> list[Mutant]:
    """So many mutants, a module at a time, so that long modules have no more of them than short ones."""
    rng = random.Random(seed)
    paths = sorted(
        p for wing in WINGS for p in (ROOT / "copem_replay" / wing).rglob("*.py") if "testing" not in p.parts
    )
    by_module = [found for path in paths if (found := list(mutants_of(path)))]
    order = [m for _ in range(-(-count // len(by_module))) for m in rng.sample(by_module, len(by_module))]
    return [rng.choice(module) for module in order[:count]]


def killed_by(mutant: Mutant, copy: Path, *, near: bool) -> tuple[str, str]:
    """Among which tests (`module`, `wing`, `all`) one tells a mutant, and its name; ("", "") where none does."""
    place = copy / mutant.path.relative_to(ROOT)
    slower = 3 if _COMPILED in mutant.text else 1
    env = {"ALL_EXAMPLES": "1", **os.environ, "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1", "CI": "true"}
    place.write_text(mutant.text, encoding="utf-8")
    try:
        for stage, tests in _stages(mutant, copy):
            if near and stage == "all":
                break
            workers = "-n0" if len(tests) < 4 and stage == "module" else "-n2"
            command = [sys.executable, "-m", "pytest", "-x", "-q", workers, "-p", "no:cacheprovider", *tests]
            try:
                longest_s = _LONGEST_S[stage] * slower
                done = subprocess.run(command, cwd=copy, env=env, capture_output=True, timeout=longest_s)
            except subprocess.TimeoutExpired:
                return stage, "no end"
            if done.returncode not in (0, 5):
                failed = re.findall(r"^(?:FAILED|ERROR) (\S+)", done.stdout.decode(), re.MULTILINE)
                return stage, failed[0] if failed else "no test began"
    finally:
        shutil.copy2(mutant.path, place)
    return "", ""


def _stages(mutant: Mutant, copy: Path) -> Iterator[tuple[str, list[str]]]:
    module = ".".join(mutant.path.relative_to(ROOT).with_suffix("").parts)
    wing = mutant.path.relative_to(ROOT).parts[1]
    name = re.compile(rf"\b{re.escape(module)}\b")
    near = [p for p in sorted(copy.glob("tests/**/test_*.py")) if not str(p.relative_to(copy)).startswith(_FAR)]
    near = [str(p.relative_to(copy)) for p in near if name.search(p.read_text(encoding="utf-8"))]
    if near:
        yield "module", near
    yield "wing", [f"tests/{wing}"]
    yield "all", ["tests", *(f"--ignore={folder}" for folder in (*_FAR, f"tests/{wing}"))]


def main() -> None:
    """Try them one after the other; a row as soon as each is known."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--mutants", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--from", dest="first", type=int, default=0)
    parser.add_argument("--only", type=int, nargs="+")
    parser.add_argument("--near", action="store_true")
    parser.add_argument("--out", type=Path, default=ROOT / "out/mutants.csv")
    given = parser.parse_args()
    mutants = list(enumerate(chosen(given.mutants, given.seed)))[given.first :]
    mutants = [m for m in mutants if given.only is None or m[0] in given.only]
    given.out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, given.out.open("a", newline="", encoding="utf-8") as file:
        copy = Path(folder) / "copy"
        shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".venv", ".git", "out", "*.egg-info", "*.rrd"))
        write = csv.writer(file)
        killed = 0
        for number, mutant in mutants:
            stage, test = killed_by(mutant, copy, near=given.near)
            killed += bool(stage)
            write.writerow(
                [number, mutant.path.relative_to(ROOT), mutant.line, mutant.before, mutant.after, stage, test]
            )
            file.flush()
            print(f"{number:3d} {stage or 'SURVIVES':8s} {mutant}  {test}", flush=True)
    print(f"{killed} of {len(mutants)} killed")


if __name__ == "__main__":
    main()
