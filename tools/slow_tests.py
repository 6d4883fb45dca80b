"""Measure the processor time of each test, and write those that `make quick` leaves out into tests/slow.txt.

python tools/slow_tests.py [--seconds 75] [--times out/test_times.txt]    # minutes; after `make test`, which compiles
python tools/slow_tests.py --rooms                                         # the rooms that no quick test enters

Quick are the tests that take least, so many that they take `--seconds` together, children included; all cases of a
function are in or out. A test that is not in the table is quick, so a new one is, until it is measured. `--times` with
a file that is there: the table is written from it, without measuring.
"""

from __future__ import annotations

import argparse
import ast
import os
import resource
import subprocess
import sys
import threading
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
TABLE = ROOT / "tests" / "slow.txt"
_TIMES, _ROOMS = "TEST_TIMES", "TEST_ROOMS"
"""Environment of workers: the file that times are appended to, and the one for files whose functions were called."""
FOR_ROOMS = {
    "tests/experiment/test_frame.py::test_geojson",
    "tests/extras/fitting/test_fit.py::test_what_cannot_be_fitted_is_said_in_a_line",
    "tests/extras/test_crew.py::test_a_client_that_has_closed_itself_is_said",
    "tests/extras/test_film.py::test_what_is_wrong_is_one_line",
    "tests/extras/test_foxglove_layout.py::test_the_sample_layout_is_what_the_command_makes",
    "tests/extras/test_history.py::test_a_history_has_a_strip_for_each_criterion_and_leads_to_the_reports",
    "tests/fusion/test_correlated.py::test_split_is_the_one_written_out",
    "tests/report/test_figures.py::TestSweeps::test_the_command_draws_them",
    "tests/report/test_html.py::TestFigures::test_they_are_those_of_plot",
    "tests/results/test_slices.py::test_the_terminal_the_figure_and_the_report_show_it",
}
"""Quick whatever they take: no quicker test enters their room."""
_called: set[str] = set()


def used_s() -> float:
    """Processor time of this process and of its children that have ended."""
    used = map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(one.ru_utime + one.ru_stime for one in used)


# A plugin of pytest, in each worker.


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Append the time of a test, with what it sets up and takes down."""
    _watch_calls()
    begun_s = used_s()
    result = yield
    if path := os.environ.get(_TIMES):
        with open(path, "a", encoding="utf-8") as file:
            file.write(f"{used_s() - begun_s:.4f} {item.nodeid}\n")
    return result


def _watch_calls() -> None:
    """Watch the calls of functions, where rooms are asked for: for each test anew, as an error takes the hook out."""
    if _ROOMS in os.environ:
        sys.setprofile(_watch)
        threading.setprofile(_watch)


def _watch(frame: FrameType, event: str, argument: object) -> None:
    if event == "call" and frame.f_code.co_name != "<module>":
        _called.add(frame.f_code.co_filename)


def pytest_sessionfinish() -> None:
    """Append the rooms: of plain functions those that were called, of compiled ones those that have a signature."""
    if path := os.environ.get(_ROOMS):
        sys.setprofile(None)
        modules = [module for name, module in [*sys.modules.items()] if name.startswith("copem_replay")]
        entered = [f"{module.__file__}" for module in modules if _is_entered(module)]
        with open(path, "a", encoding="utf-8") as file:
            file.writelines(f"{name}\n" for name in entered)


def _is_entered(module: Any) -> bool:
    tree = ast.parse(Path(module.__file__).read_text(encoding="utf-8"))
    functions = any(isinstance(node, ast.FunctionDef) for node in ast.walk(tree))
    kernels = (one for one in vars(module).values() if getattr(one, "__module__", None) == module.__name__)
    return not functions or module.__file__ in _called or any(getattr(one, "signatures", None) for one in kernels)


# The tool.


def run_tests(which: str, variable: str, path: Path, *words: str) -> None:
    """Run the tests of a marker expression with this plugin, on both cores."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-n",
        "2",
        "--dist",
        "loadfile",
        "-p",
        "tools.slow_tests",
        "-m",
        which,
        *words,
    ]
    environment = {**os.environ, "CI": "true", variable: str(path.resolve())}
    if subprocess.run(command, cwd=ROOT, env=environment).returncode:
        sys.exit("tests fail: nothing is written")


def slow_tests(lines: list[str], seconds: float) -> dict[str, float]:
    """The functions beyond those that take least, by name; `lines`: seconds and test, of each case."""
    total_s = defaultdict[str, float](float)
    for line in lines:
        taken_s, _, test = line.partition(" ")
        total_s[test.partition("[")[0]] += float(taken_s)
    left_s, slow = seconds, {}
    for test, taken_s in sorted(total_s.items(), key=lambda one: (one[1], one[0])):
        left_s -= taken_s
        if left_s < 0:
            slow[test] = taken_s
    return slow


def missing_rooms(entered: set[str]) -> list[str]:
    """Modules of the package that are not among these files."""
    rooms = sorted(path for path in (ROOT / "copem_replay").rglob("*.py") if path.name != "__init__.py")
    return [str(path.relative_to(ROOT)) for path in rooms if str(path) not in entered]


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=75)
    parser.add_argument("--times", type=Path, default=ROOT / "out/test_times.txt")
    parser.add_argument("--rooms", action="store_true")
    given = parser.parse_args()
    if given.rooms:
        path = ROOT / "out/test_rooms.txt"
        run_tests("not slow and not long", _ROOMS, path)
        missing = missing_rooms(set(path.read_text(encoding="utf-8").splitlines()))
        print(*(f"no quick test enters {room}" for room in missing), sep="\n")
        return 1 if missing else 0
    if not given.times.exists():
        run_tests("not long", _TIMES, given.times)
    slow = slow_tests(given.times.read_text(encoding="utf-8").splitlines(), given.seconds)
    slow = {test: taken_s for test, taken_s in slow.items() if test not in FOR_ROOMS}
    TABLE.write_text("".join(f"{slow[test]:.1f} {test}\n" for test in sorted(slow)), encoding="utf-8")
    print(f"{len(slow)} functions are slow")
    return 0


if __name__ == "__main__":
    sys.exit(main())
