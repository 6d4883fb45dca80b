"""Where compiled code is cached, which of it is of use, who writes; kernels that call others."""

from __future__ import annotations

import ast
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import copem_replay
from copem_replay.core.compiled import call_in_room, callee, kernel, making_kernel
from tests.helpers.experiments import TEXT, drive
from tests.system.test_cli import Call, call, raising

__all__ = ["call"]  # a fixture

PACKAGE = Path(copem_replay.__file__).parent
BRAKING = "braking: {driver: {kind: constant_deceleration, a_max_mps2: 8.0}, margin_m: 0.5}\n"
Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def sealed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the package, beside whose files nothing can be cached, not even by root: that is a file."""
    folder = tmp_path_factory.mktemp("sealed")
    shutil.copytree(PACKAGE, folder / "copem_replay", ignore=shutil.ignore_patterns("__pycache__"))
    for path in (folder / "copem_replay").rglob("__init__.py"):
        (path.parent / "__pycache__").touch()
    return folder


@pytest.fixture
def run(sealed: Path, tmp_path: Path) -> Run:
    """A command of that package, of a user whose home is no folder."""
    drive(tmp_path / "drive.mcap")
    (tmp_path / "e.yaml").write_text(TEXT)
    (tmp_path / "tmp").mkdir()
    nowhere = {"HOME": "/dev/null", "TMPDIR": str(tmp_path / "tmp"), "PYTHONPATH": str(sealed)}
    clean = {name: value for name, value in os.environ.items() if name not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}

    def ran(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-B", "-m", "copem_replay.cli.main", *arguments],
            cwd=tmp_path, env=clean | nowhere | environment, capture_output=True, text=True, timeout=100,
        )  # fmt: skip

    return ran


def note(sealed: Path, where: str) -> str:
    package = sealed / "copem_replay"
    begin = f"note: compiled code is cached in {where}, as neither {package} nor /dev/null/.cache can be written"
    return f"{begin}; NUMBA_CACHE_DIR names another\n"


def test_a_folder_of_the_users_own_under_the_temporary_one(run: Run, sealed: Path, tmp_path: Path) -> None:
    folder = tmp_path / f"tmp/copem_replay-{os.geteuid()}"
    (tmp_path / "e.yaml").write_text(TEXT + BRAKING)  # whether they are in conflict is computed by compiled code
    for _ in range(2):
        ended = run("check", "e.yaml")
        assert ended.returncode == 0
        assert ended.stderr.endswith(note(sealed, str(folder)))
        assert folder.stat().st_mode & 0o777 == 0o700
        assert list(folder.glob("*.nbc"))
    assert run("--help").stderr == "", "nothing is compiled"


@pytest.mark.parametrize("kind", ["link", "others may write", "of another user", "file"])
def test_a_folder_that_is_not_the_users_alone_is_not_used(run: Run, sealed: Path, tmp_path: Path, kind: str) -> None:
    """What is in a cache is run."""
    folder = tmp_path / f"tmp/copem_replay-{os.geteuid()}"
    (tmp_path / "theirs").mkdir(mode=0o700)
    if kind == "link":
        folder.symlink_to(tmp_path / "theirs")
    elif kind == "file":
        folder.touch()
    else:
        folder.mkdir(mode=0o700)
        if kind == "others may write":
            folder.chmod(0o770)
        elif os.geteuid():
            pytest.skip("only root can give a folder to another user")
        else:
            os.chown(folder, 65534, 65534)
    ended = run("check", "e.yaml")
    assert ended.returncode == 0
    assert f"{folder}-" in ended.stderr
    assert f" for this process alone ({folder} is not a folder of this user alone), as neither " in ended.stderr
    assert os.listdir(tmp_path / "tmp") == [folder.name], "that of the process has gone with it"
    assert os.listdir(tmp_path / "theirs") == []
    assert kind == "file" or os.listdir(folder) == []


def test_a_folder_that_was_named_is_taken(run: Run, tmp_path: Path) -> None:
    (tmp_path / "e.yaml").write_text(TEXT + BRAKING)  # whether they are in conflict is computed by compiled code
    (said,) = compiled_in(run, tmp_path)
    assert said.startswith("note: drive: no verdict")
    assert os.listdir(tmp_path / "tmp") == []
    cached = list((tmp_path / "mine").rglob("*.nb?"))
    assert {path.suffix for path in cached} == {".nbi", ".nbc"}
    for path in cached:
        path.write_bytes(path.read_bytes()[:60])
    assert compiled_in(run, tmp_path) == [said]
    assert all(path.stat().st_size != 60 for path in cached), "written again"


def compiled_in(run: Run, folder: Path) -> list[str]:
    """What `check` says on stderr with a cache that was named."""
    ended = run("check", "e.yaml", NUMBA_CACHE_DIR=str(folder / "mine"))
    assert ended.returncode == 0
    return ended.stderr.splitlines()


def test_the_users_cache_is_taken_as_ever(run: Run, tmp_path: Path) -> None:
    ended = run("check", "e.yaml", HOME=str(tmp_path / "home"))
    assert (ended.returncode, ended.stderr) == (0, "")
    assert os.listdir(tmp_path / "home/.cache/numba") != []
    assert os.listdir(tmp_path / "tmp") == []


def test_not_even_a_temporary_folder(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    error = RuntimeError("cannot cache function 'assign': no locator available for file 'core/assignment.py'")
    monkeypatch.setattr("copem_replay.experiment.draft.survey.survey_recording", raising(error))
    line = "copem-replay: no folder to cache compiled code in; set NUMBA_CACHE_DIR to one that can be written"
    assert call("info", "drive.mcap") == (2, "", [line])


DAMAGED = """
import json, pickle, sys
from pathlib import Path

import numba
import numpy as np

from copem_replay.core.compiled import kernel
from copem_replay.core.geometry import is_in_polygon

SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
GONE = b"cno_such_module\\nThing\\n."
kernel(is_in_polygon)(0.5, 0.5, SQUARE)
(index,) = Path(sys.argv[1]).rglob("geometry.is_in_polygon-*.nbi")
(code,) = index.parent.glob("geometry.is_in_polygon-*.nbc")
(sums,) = index.parent.glob("geometry.is_in_polygon-*.json")
written = {path: path.read_bytes() for path in (index, code, sums)}
version, middle = pickle.dumps(numba.__version__), len(written[code]) // 2
for name, path, content in (
    ("an empty index", index, b""),
    ("an index cut off in its version", index, written[index][:10]),
    ("an index cut off behind its version", index, written[index][:-10]),
    ("an index whose version is of a module that is gone", index, GONE),
    ("an index that names a module that is gone", index, version + GONE),
    ("an index that is no pair", index, version + pickle.dumps(7)),
    ("code cut off", code, written[code][:-10]),
    ("code of a module that is gone", code, GONE),
    ("code of another form", code, pickle.dumps((1, 2))),
    ("code with a byte changed", code, written[code][:middle] + b"\\0\\1" + written[code][middle + 2:]),
    ("no code", code, None),
    ("no checksums", sums, None),
    ("checksums cut off", sums, written[sums][:-3]),
    ("checksums of another form", sums, b"[]"),
):
    for other, whole in written.items():
        other.write_bytes(whole)
    path.unlink() if content is None else path.write_bytes(content)
    first = kernel(is_in_polygon)
    inside = [bool(first(x, 0.5, SQUARE)) for x in (0.5, 1.5)]
    second = kernel(is_in_polygon)
    second(0.5, 0.5, SQUARE)
    print(json.dumps([name, inside, len(first.stats.cache_hits), len(second.stats.cache_hits)]))
"""


def test_cached_code_that_is_damaged_is_compiled_again(tmp_path: Path) -> None:
    """Once: the next process finds what this one compiled."""
    found = [json.loads(line) for line in python(DAMAGED, tmp_path).splitlines()]
    assert len(found) == 14
    for name, inside, hits, hits_again in found:
        assert (inside, hits, hits_again) == ([True, False], 0, 1), name


def python(code: str, cache: Path, *arguments: str, package: Path = PACKAGE) -> str:
    """What a program prints that has its compiled code in that folder."""
    ended = subprocess.run(
        [sys.executable, "-c", code, str(cache), *arguments], cwd=package.parent, capture_output=True, text=True,
        timeout=100, env=os.environ | {"NUMBA_CACHE_DIR": str(cache), "PYTHONPATH": str(package.parent)},
    )  # fmt: skip
    assert (ended.returncode, ended.stderr) == (0, "")
    return ended.stdout


def write_package(folder: Path, **modules: str) -> Path:
    """A package of that name with the cache of this one, and these modules."""
    package = folder / "copem_replay"
    if not package.exists():
        shutil.copytree(PACKAGE / "core", package / "core", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("__init__", *modules):
        (package / f"{name}.py").write_text(modules.get(name, ""))
    return package


CALLER = """from copem_replay.core.compiled import kernel
from copem_replay.middle import middle

@kernel
def outer(x: float) -> float:
    return middle(x) + 1
"""
MIDDLE = """from copem_replay.core.compiled import callee
from copem_replay.inner import STEP, inner

@callee
def middle(x: float) -> float:
    return inner(x) * STEP
"""
INNER = """from copem_replay.core.compiled import callee

STEP = 10.0

@callee
def inner(x: float) -> float:
    return x + 100
"""
CALLED = "from copem_replay.outer import outer; print(outer(1.0), sum(outer.stats.cache_hits.values()))"


def test_code_of_a_kernel_is_of_no_use_once_a_file_far_away_has_changed(tmp_path: Path) -> None:
    """A callee of its callee, and a constant there; Numba itself would go on with the old code."""
    cache, modules = tmp_path / "cache", {"outer": CALLER, "middle": MIDDLE, "inner": INNER}
    for inner, said in (
        (INNER, ["1011.0 0", "1011.0 1"]),
        (INNER.replace("100", "200"), ["2011.0 0", "2011.0 1"]),
        (INNER.replace("10.0", "20.0"), ["2021.0 0", "2021.0 1"]),
    ):
        package = write_package(tmp_path, **modules | {"inner": inner})
        assert [python(CALLED, cache, package=package).strip() for _ in range(2)] == said
        assert len(list(cache.rglob("outer.outer-*.nbc"))) == 1, "code of other sources has gone"


def test_every_module_of_a_kernel_says_what_it_imports_so_that_the_cache_sees_it() -> None:
    """Of the package, by `from … import …` of a module: nothing else is followed."""
    from copem_replay.core import kernel_cache

    seen, to_read = set[Path](), [p for p in PACKAGE.rglob("*.py") if "core.compiled import" in p.read_text()]
    while to_read:
        if (path := to_read.pop()) in seen:
            continue
        seen.add(path)
        names = set[str]()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                assert not any(name.name.startswith("copem_replay") for name in node.names), path
            elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("copem_replay") and not node.level:
                for name in (node.module, *(f"{node.module}.{one.name}" for one in node.names)):
                    if node.col_offset == 0 and (PACKAGE.parent / f"{name.replace('.', '/')}.py").exists():
                        names.add(name)
        found = [Path(one) for one in kernel_cache._read_source(str(path))[1]]
        assert {PACKAGE.parent / f"{name.replace('.', '/')}.py" for name in names} <= set(found), path
        to_read += found


WRITES = """
import sys
import numpy as np
from copem_replay.core import kernel_cache
from copem_replay.core.compiled import kernel
from copem_replay.core.geometry import is_in_polygon

def write_when_told(name, data):
    print("writes", flush=True)
    sys.stdin.readline()
    write(name, data)

def sleep(seconds):
    if not sleep.told:
        print("waits", flush=True)
    sleep.told = True

sleep.told = False
kernel_cache.time.sleep = sleep
one, which = kernel(is_in_polygon), sys.argv[2]
write = one._cache._cache_file._save_data
if which == "first":
    one._cache._cache_file._save_data = write_when_told
if which == "second":
    print("ready", flush=True)
    sys.stdin.readline()
x, y = (1, 1) if which in ("first", "whole numbers") else (0.5, 0.5)
print(bool(one(x, y, np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]]))), sum(one.stats.cache_hits.values()))
"""


def test_two_processes_that_compile_at_once_do_not_take_the_code_of_one_another(tmp_path: Path) -> None:
    """For whole numbers, and for floats: others wait while the first one writes, and both codes are found."""

    def begin(which: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-c", WRITES, str(tmp_path), which], cwd=PACKAGE.parent, text=True,
            env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )  # fmt: skip

    with begin("second") as second:
        assert second.stdout is not None
        assert second.stdout.readline() == "ready\n", "its kernel is decorated: the cache is empty"
        first = begin("first")
        assert first.stdout is not None
        assert first.stdout.readline() == "writes\n"
        assert second.stdin is not None
        print(file=second.stdin, flush=True)
        assert second.stdout.readline() == "waits\n"
        with first, begin("whole numbers") as late:
            assert late.stdout is not None
            assert late.stdout.readline() == "waits\n", "what is half written is not taken for damaged"
            assert first.communicate("\n", timeout=100)[0] == "True 0\n"
            assert second.communicate(timeout=100)[0] == "True 0\n"
            assert late.communicate(timeout=100)[0] == "True 1\n"
    for which in ("whole numbers", "floats"):
        assert python(WRITES, tmp_path, which) == "True 1\n"


def test_functions_of_others_are_cached_as_ever(tmp_path: Path) -> None:
    lines = [
        "import numba, sys",
        "from copem_replay.core.compiled import kernel",
        "before = numba.core.config.CACHE_LOCATOR_CLASSES",
        "from copem_replay.core.assignment import assign",
        "assert numba.core.config.CACHE_LOCATOR_CLASSES == before",
        "from theirs import add",
        "print(add(1), add._cache._impl.locator.__class__.__name__, assign._cache._impl.locator.__class__.__name__)",
    ]
    text = "import numba\n\n@numba.njit(cache=True)\ndef add(a):\n    return a + 1\n"
    (tmp_path / "theirs.py").write_text(text)
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n" + "\n".join(lines)
    assert python(code, tmp_path / "cache") == "2 UserProvidedCacheLocator KernelLocator\n"


def test_nothing_of_numba_is_replaced() -> None:
    """After all modules of the package are imported, each function of Numba is the one that its module defines."""
    code = """
import importlib, pkgutil, sys, types
import numba.core.caching, numba.core.targetconfig, numba.np.linalg, numba.core.types.functions, numba.core.dispatcher
def of_numba():
    for name, module in sorted(sys.modules.items()):
        if name.partition(".")[0] in ("numba", "llvmlite"):
            for key, value in vars(module).items():
                yield (name, key), value
                if isinstance(value, type) and value.__module__ == name:
                    yield from (((name, key, inner), one) for inner, one in vars(value).items())
functions = lambda: {key: one for key, one in of_numba() if isinstance(one, types.FunctionType)}
before = functions()
import copem_replay
for found in pkgutil.walk_packages(copem_replay.__path__, "copem_replay."):
    if found.name.startswith(("copem_replay.core", "copem_replay.metrics", "copem_replay.fusion", "copem_replay.cli")):
        importlib.import_module(found.name)
after = functions()
print(len(before) > 1000, [key for key in before if after.get(key) is not before[key]])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "True []\n"


@pytest.fixture
def empty_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path))


def _compile_events(work: Callable[[], object]) -> list[str]:
    """The kernels that are compiled by `work`, in the order in which they are done."""
    from numba.core.event import install_recorder

    with install_recorder("numba:compile") as recorder:
        work()
    names = [event.data["dispatcher"].py_func.__name__ for _, event in recorder.buffer if event.is_end]
    return [name for name in names if name in ("_count", "_count_twice")]


@pytest.mark.usefixtures("empty_cache")
def test_a_callee_is_compiled_once_whatever_literals_it_is_called_with() -> None:
    @callee
    def _count(start: int, step: bool) -> int:
        return start + 1 if step else start

    @kernel
    def _count_twice(times: int) -> int:
        n = 0
        for _ in range(times):
            n = _count(n, True)
        return _count(n, False) + _count(5, True)

    assert _compile_events(lambda: _count_twice(3)) == ["_count", "_count_twice"]
    assert _count_twice(3) == 3 + 6
    assert _compile_events(lambda: _count(3, True)) == [], "Python calls the Python function"
    assert _count(3, True) == 4


@pytest.mark.usefixtures("empty_cache")
def test_python_and_kernels_may_call_a_kernel() -> None:
    @making_kernel
    def _count(values: np.ndarray) -> np.ndarray:
        return values + 1

    @kernel
    def _count_twice(values: np.ndarray) -> np.ndarray:
        return _count(_count(values))

    assert _count_twice(np.array([1, 5])).tolist() == [3, 7]
    assert _compile_events(lambda: _count(np.array([1, 5]))) == [], "compiled for both"
    assert _count(np.array([1, 5])).tolist() == [2, 6]
    assert _count(values=np.array([0.5])).tolist() == [1.5]


@pytest.mark.usefixtures("empty_cache")
def test_an_error_in_a_callee_reaches_python() -> None:
    @callee
    def _count(k: int) -> float:
        if k < 0:
            raise ValueError("expected a number of at least 0")
        return 1 / k

    @kernel
    def _count_twice(k: int) -> float:
        return 2 * _count(k)

    assert _count_twice(4) == 0.5
    with pytest.raises(ValueError, match="of at least 0"):
        _count_twice(-1)
    with pytest.raises(ZeroDivisionError):
        _count_twice(0)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="memory is counted by thread")
def test_calls_in_room_ask_for_no_memory_at_any_depth() -> None:
    """Without room, there is a depth at which each of the thousand calls asks the system for memory."""
    import resource

    def call_often(_: int) -> int:
        before = resource.getrusage(resource.RUSAGE_THREAD).ru_minflt
        for _ in range(1000):
            max((1, 2), key=lambda number: number)
        return resource.getrusage(resource.RUSAGE_THREAD).ru_minflt - before

    def count_most(call: Callable[[int], int]) -> int:
        most, code = 0, call_often.__code__
        for words in range(8, 2100, 4):  # a frame of a piece and a half
            call_often.__code__ = code.replace(co_stacksize=words)
            most = max(most, call(0))
        return most

    assert count_most(lambda _: call_in_room(call_often, 0)) < 500
