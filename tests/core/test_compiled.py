"""Where compiled code is cached when neither package nor user's cache can be written; kernels that call others."""

from __future__ import annotations

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
from copem_replay.core.compiled import kernel, making, prepare_cache
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
    for _ in range(2):
        ended = run("check", "e.yaml")
        assert (ended.returncode, ended.stderr) == (0, note(sealed, str(folder)))
        assert folder.stat().st_mode & 0o777 == 0o700
        assert any(folder.iterdir()), "Numba's folders, one for each of the package"
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
    *others, line = compiled_in(run, tmp_path)
    assert others == [said]
    assert line.startswith("note: compiled code of copem_replay.metrics.braking.encounter.")
    assert " could not be read from its" in line
    assert line.endswith("): compiled again")
    assert compiled_in(run, tmp_path) == [said]


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


def test_an_index_older_than_its_source_is_removed(tmp_path: Path) -> None:
    """It may name classes that have gone since, at which Numba fails before it sees that the index is old."""
    (tmp_path / "__init__.py").touch()
    cached = tmp_path / "__pycache__"
    cached.mkdir()
    for name, index_s in (("old", 90), ("new", 110)):
        source, index, data = (
            tmp_path / f"{name}.py",
            cached / f"{name}.f-1.py311.nbi",
            cached / f"{name}.f-1.py311.1.nbc",
        )
        for path, at_s in ((source, 100), (index, index_s), (data, index_s)):
            path.touch()
            os.utime(path, (at_s, at_s))
    (cached / "gone.f-1.py311.nbi").touch()  # its module has gone: Numba never asks for it
    assert prepare_cache(tmp_path, {}) is None
    kept = ["gone.f-1.py311.nbi", "new.f-1.py311.1.nbc", "new.f-1.py311.nbi", "old.f-1.py311.1.nbc"]
    assert sorted(path.name for path in cached.iterdir()) == kept


DAMAGED = """
import json, pickle, sys
from pathlib import Path

import copem_replay

assert "numba" not in sys.modules
import numba
import numpy as np

from copem_replay.core import compiled
from copem_replay.core.geometry import is_in_polygon

SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
GONE = b"cno_such_module\\nThing\\n."
(index,) = Path(sys.argv[1]).rglob("geometry.is_in_polygon-*.nbi") if is_in_polygon(0.5, 0.5, SQUARE) else ()
(code,) = index.parent.glob("geometry.is_in_polygon-*.nbc")
whole = index.read_bytes(), code.read_bytes()
version = pickle.dumps(numba.__version__)
for name, path, content in (
    ("an empty index", index, b""),
    ("an index cut off in its version", index, whole[0][:10]),
    ("an index cut off behind its version", index, whole[0][:-10]),
    ("an index whose version is of a module that is gone", index, GONE),
    ("an index that names a module that is gone", index, version + GONE),
    ("an index that is no pair", index, version + pickle.dumps(7)),
    ("code cut off", code, whole[1][:-10]),
    ("code of a module that is gone", code, GONE),
    ("code of another form", code, pickle.dumps((1, 2))),
):
    index.write_bytes(whole[0]), code.write_bytes(whole[1])
    path.write_bytes(content)
    del compiled._unusable[:]
    first = compiled.borrowing(is_in_polygon.py_func)
    inside = [bool(first(x, 0.5, SQUARE)) for x in (0.5, 1.5)]
    note = compiled.recompiled_note()
    second = compiled.borrowing(is_in_polygon.py_func)
    second(0.5, 0.5, SQUARE)
    print(json.dumps([name, inside, note, len(first.stats.cache_hits), len(second.stats.cache_hits)]))
"""


def test_cached_code_that_cannot_be_used_is_compiled_again(tmp_path: Path) -> None:
    """With a note, and once: the next process finds what this one compiled."""
    ended = subprocess.run(
        [sys.executable, "-c", DAMAGED, str(tmp_path)], cwd=PACKAGE.parent, capture_output=True, text=True, timeout=100,
        env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)},
    )  # fmt: skip
    assert (ended.returncode, ended.stderr) == (0, "")
    found = [json.loads(line) for line in ended.stdout.splitlines()]
    assert len(found) == 9
    for name, inside, note, hits, hits_again in found:
        assert (inside, hits, hits_again) == ([True, False], 0, 1), name
        assert note.startswith(
            "compiled code of copem_replay.core.geometry.is_in_polygon could not be read from its cache ("
        ), name
        assert note.endswith("): compiled again")
    assert "No module named 'no_such_module'" in found[4][2]


AT_ONCE = """
import sys
from pathlib import Path

import numpy as np

from copem_replay.core import compiled
from copem_replay.core.geometry import is_in_polygon

SQUARE = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]])
one, other, third = (compiled.kernel(is_in_polygon.py_func) for _ in range(3))
file, file_of_other = one._cache._cache_file, other._cache._cache_file
write = file._save_data

def write_after_the_other(name, data):
    # The other process has read the index before this one wrote its own.
    file_of_other._load_index = dict
    other(0.5, 0.5, SQUARE)
    write(name, data)

file._save_data = write_after_the_other
one(1, 1, SQUARE)
found = [bool(third(x, 0.5, SQUARE)) for x in (0.5, 2.5)], bool(third(1, 1, SQUARE))
print(*found, sum(third.stats.cache_hits.values()))
"""


def test_two_processes_that_compile_at_once_do_not_take_the_code_of_one_another(tmp_path: Path) -> None:
    """Whole numbers, and floats: the index that is written last names the code of floats, which is found."""
    ended = subprocess.run(
        [sys.executable, "-c", AT_ONCE], cwd=PACKAGE.parent, capture_output=True, text=True, timeout=100,
        env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)},
    )  # fmt: skip
    assert (ended.returncode, ended.stderr, ended.stdout) == (0, "", "[True, False] True 1\n")


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
    @kernel
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


@pytest.mark.usefixtures("empty_cache")
def test_python_may_call_what_kernels_call() -> None:
    """By code of its own: what its callers have is theirs."""

    @making
    def _count(values: np.ndarray) -> np.ndarray:
        return values + 1

    @kernel
    def _count_twice(values: np.ndarray) -> np.ndarray:
        return _count(_count(values))

    assert _count_twice(np.array([1, 5])).tolist() == [3, 7]
    assert _compile_events(lambda: _count(np.array([1, 5]))) == ["_count"]
    assert _count(np.array([1, 5])).tolist() == [2, 6]
    assert _count(values=np.array([0.5])).tolist() == [1.5]


@pytest.mark.usefixtures("empty_cache")
def test_an_error_in_a_callee_reaches_python() -> None:
    @kernel
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

    from copem_replay.core.callees import call_in_room

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


def test_configurations_are_equal_where_all_options_are() -> None:
    """Numba keeps what it compiled by them."""
    from numba.core.compiler import Flags

    plain, said, other = Flags(), Flags(), Flags()
    said.nrt, other.nrt = plain.nrt, not plain.nrt
    assert plain == said != other
    assert hash(plain) == hash(said)
    assert (plain.values(), other.values()) == (said.values(), {**said.values(), "nrt": other.nrt})
    assert plain != 1


def test_a_kernel_loads_no_linear_algebra_and_products_of_matrices_compile() -> None:
    """Numba imports scipy.linalg to see that BLAS is there; what multiplies matrices finds it without."""
    lines = [
        "import sys",
        "import numba, numpy as np",
        "from copem_replay.core.compiled import cache_note",
        "cache_note()",
        "assert numba.njit(lambda a: a + 1)(1) == 2",
        "print('scipy.linalg' in sys.modules)",
        "print(numba.njit(lambda a: np.dot(a, a))(np.array([[1.0, 2.0], [3.0, 4.0]])).tolist())",
    ]
    done = subprocess.run([sys.executable, "-c", "\n".join(lines)], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["False", "[[7.0, 10.0], [15.0, 22.0]]"]


CACHED = """
import glob, pickle, sys
import numpy as np
from llvmlite.binding import parse_bitcode
from copem_replay.core.compiled import watch_numba
watch_numba()
from copem_replay.core.geometry import is_in_polygon
square = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]])
print(bool(is_in_polygon(1.0, 1.0, square)), bool(is_in_polygon(3.0, 1.0, square)))
print("numba.np.npyimpl" in sys.modules)
[file] = glob.glob(sys.argv[1] + "/**/geometry.is_in_polygon*.nbc", recursive=True)
with open(file, "rb") as opened:
    (_, kind, (code, names)), *_ = pickle.load(opened)
there = parse_bitcode(names)
print(kind, len(list(there.functions)), any("is_in_polygon" in one.name for one in there.global_variables))
"""


def test_what_is_in_the_cache_is_machine_code_and_needs_nothing_of_the_compiler(tmp_path: Path) -> None:
    """The first process compiles, the second one finds the code: the same answers. Beside the code there are names."""
    told = [
        subprocess.run(
            [sys.executable, "-c", CACHED, str(tmp_path)], cwd=PACKAGE.parent, capture_output=True, text=True,
            check=True, env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)},
        ).stdout.splitlines()
        for _ in range(2)
    ]  # fmt: skip
    assert told == [["True False", compiler, "object 0 True"] for compiler in ("True", "False")]
