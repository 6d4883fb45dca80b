"""Files of a folder that are replaced together, or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from copem_replay.core.errors import OutputError
from copem_replay.core.files import atomic_file, atomic_files

NAMES = ("a", "b", "c")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with two of the files, and one of another kind."""
    made = tmp_path / "made"
    made.mkdir()
    for name in ("a", "b", "mine"):
        (made / name).write_text(f"old {name}")
    return made


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
