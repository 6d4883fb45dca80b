"""Files of a folder that are replaced together, or not at all."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import pytest

from copem_replay.core import files
from copem_replay.core.errors import OutputError
from copem_replay.core.files import (
    DEEPEST_JSON,
    atomic_file,
    atomic_files,
    parse_json,
    portable_name,
    remove_leftovers,
)

NAMES = ("a", "b", "c")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with two of the files, and one of another kind."""
    made = tmp_path / "made"
    made.mkdir()
    for name in ("a", "b", "mine"):
        (made / name).write_text(f"old {name}")
    return made


def raises(code: int) -> Any:
    def fails(*_: object, **__: object) -> None:
        raise OSError(code, os.strerror(code))

    return fails


def content(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir()}


def test_what_is_written_replaces_and_what_is_not_goes(folder: Path) -> None:
    with atomic_files(folder, NAMES) as scratch:
        (scratch / "b").write_text("new b")
        (scratch / "c").write_text("new c")
        assert (folder / "b").read_text() == "old b", "until all is well"
    assert content(folder) == {"mine": "old mine", "b": "new b", "c": "new c"}
    assert [path.name for path in folder.parent.iterdir()] == ["made"]


def test_after_a_failure_all_is_as_before(folder: Path) -> None:
    before = content(folder)

    def fill() -> None:
        with atomic_files(folder, NAMES, way_out="; do so") as scratch:
            (scratch / "b").write_text("new b")
            raise OSError(28, "No space left on device")

    with pytest.raises(OutputError, match=r"^.*/made: cannot be written: No space left on device; do so$"):
        fill()
    assert content(folder) == before


def test_the_folder_is_made_with_those_above_it(tmp_path: Path) -> None:
    with atomic_files(tmp_path / "x" / "y", NAMES) as scratch:
        (scratch / "a").write_text("new a")
        assert not (tmp_path / "x" / "y").exists()
    assert content(tmp_path / "x" / "y") == {"a": "new a"}


def test_a_file_in_the_place_of_the_folder(folder: Path) -> None:
    with pytest.raises(OutputError, match="expected a folder, found a file"), atomic_files(folder / "a", NAMES):
        pytest.fail("nothing is to be written")
    assert (folder / "a").read_text() == "old a"


def test_a_file_alone(folder: Path) -> None:
    def fill() -> None:
        with atomic_file(folder / "a") as scratch:
            scratch.write_text("half")
            raise ValueError("not this time")

    with pytest.raises(ValueError, match="not this time"):
        fill()
    assert (folder / "a").read_text() == "old a"
    with atomic_file(folder / "a") as scratch:
        scratch.write_text("new a")
    assert (folder / "a").read_text() == "new a"


def leftovers(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.parent.iterdir() if path != folder)


class TestInOneStep:
    """Files of several names: at no instant are some of them old and others new."""

    def write(self, folder: Path) -> None:
        with atomic_files(folder, NAMES) as scratch:
            (scratch / "b").write_text("new b")
            (scratch / "c").write_text("new c")

    NEW: Final = {"mine": "old mine", "b": "new b", "c": "new c"}

    def test_killed_before_every_step(self, folder: Path) -> None:
        """A process that ends before its k-th change of names: all old, all new or, between two, put back later."""
        code = (
            "import os, sys\nfrom pathlib import Path\nfrom copem_replay.core import files\n"
            "folder, last, count = Path(sys.argv[1]), int(sys.argv[2]), 0\n"
            "def step(event, arguments):\n    global count\n"
            "    if event in ('os.rename', 'os.remove', 'os.link'):\n"
            "        count += 1\n        if count == last: os._exit(9)\n"
            "with files.atomic_files(folder, ('a', 'b', 'c')) as scratch:\n"
            "    (scratch / 'b').write_text('new b')\n    (scratch / 'c').write_text('new c')\n"
            "    sys.addaudithook(step)\n"
        )
        old, seen = content(folder), []
        for last in range(1, 30):
            code_of_end = subprocess.run([sys.executable, "-c", code, folder, str(last)]).returncode
            if folder.exists():
                assert content(folder) in (old, self.NEW), last
            remove_leftovers(folder)
            assert content(folder) in (old, self.NEW), last
            assert leftovers(folder) == [], last
            seen.append(content(folder) == self.NEW)
            for path in folder.iterdir():
                path.unlink()
            for name, text in old.items():
                (folder / name).write_text(text)
            if code_of_end == 0:
                break
        assert code_of_end == 0
        assert seen == sorted(seen)  # old until one step, new after it
        assert {False, True} == set(seen)

    def test_the_folder_keeps_its_rights_and_a_link_its_place(self, folder: Path) -> None:
        folder.chmod(0o750)
        link = folder.parent / "link"
        link.symlink_to("made")
        self.write(link)
        assert link.is_symlink()
        assert content(folder) == self.NEW
        assert folder.stat().st_mode & 0o777 == 0o750
        assert leftovers(folder) == ["link"]

    @pytest.mark.parametrize("why", ["folder", "working folder", "another's"])
    def test_one_by_one_where_the_folder_has_to_stay(
        self, folder: Path, monkeypatch: pytest.MonkeyPatch, why: str
    ) -> None:
        if why == "folder":
            (folder / "theirs").mkdir()
        elif why == "working folder":
            monkeypatch.chdir(folder)
        elif os.geteuid() == 0:
            os.chown(folder, 12345, -1)
        same = folder.stat().st_ino
        self.write(folder)
        (folder / "theirs").rmdir() if why == "folder" else None
        assert folder.stat().st_ino == same or (why == "another's" and os.geteuid() != 0)
        assert content(folder) == self.NEW
        assert leftovers(folder) == []

    def test_a_file_that_comes_during_the_exchange_stays(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        rename = os.rename

        def late(source: Path, target: Path) -> None:
            if source == folder:
                (folder / "late").write_text("late")
            rename(source, target)

        monkeypatch.setattr(os, "rename", late)
        self.write(folder)
        assert content(folder) == {**self.NEW, "late": "late"}
        assert leftovers(folder) == []


@pytest.mark.parametrize(
    ("name", "written"),
    [
        ("coPEM:0s", "coPEM%3A0s"),
        ("aux", "%61ux"),
        ("Con.txt", "%43on.txt"),
        ("COM1", "%43OM1"),
        ("com10", "com10"),
        ("auxiliary", "auxiliary"),
        ("a.", "a%2E"),
        ("a ", "a%20"),
        ("50%", "50%25"),
        ('<>"|?*\\', "%3C%3E%22%7C%3F%2A%5C"),
        ("a\tb", "a%09b"),
        ("night/nul", "night/%6Eul"),
        ("Kreuzung Süd.1", "Kreuzung Süd.1"),
    ],
)
def test_names_that_every_system_takes(name: str, written: str) -> None:
    assert portable_name(name) == written


class TestLockWithoutFlock:
    """A system without `fcntl`: the byte that Windows locks, by a stand-in, or no lock at all."""

    def test_byte_behind_the_content(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        held: set[int] = set()

        def locking(fd: int, mode: int, count: int) -> None:
            at = os.lseek(fd, 0, os.SEEK_CUR)
            assert (mode, count) == (7, 1)
            if at in held:
                raise OSError(errno.EACCES, "Permission denied")
            held.add(at)

        monkeypatch.setattr(files, "fcntl", None)
        monkeypatch.setitem(sys.modules, "msvcrt", SimpleNamespace(locking=locking, LK_NBLCK=7))
        with (tmp_path / "lock").open("w+b") as file:
            assert files.try_lock(file.fileno()) is True
            files.overwrite_file(file.fileno(), b"process 1")
            assert files.try_lock(file.fileno()) is False
        assert held == {1 << 30}
        assert (tmp_path / "lock").read_bytes() == b"process 1"

    def test_no_locks(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(files, "fcntl", None)
        monkeypatch.setitem(sys.modules, "msvcrt", None)
        with (tmp_path / "lock").open("w+b") as file:
            assert files.try_lock(file.fileno()) is None


@pytest.mark.parametrize(("open_", "close"), [("[", "]"), ('{"a":', "}")])
def test_json_is_read_as_deep_as_anything_that_is_written(open_: str, close: str) -> None:
    """Deeper it is damage, whether Python could read it or not."""
    value: object = 1
    for _ in range(DEEPEST_JSON):
        value = [value] if close == "]" else {"a": value}
    assert parse_json(open_ * DEEPEST_JSON + "1" + close * DEEPEST_JSON) == value
    for deep in (DEEPEST_JSON + 1, 900, 100_000):
        with pytest.raises(ValueError, match="values within values"):
            parse_json(open_ * deep + "1" + close * deep)
    with pytest.raises(ValueError, match="values within values"):
        parse_json((open_ * 100_000).encode())
