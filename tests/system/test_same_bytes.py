"""Two folders of results, and two checkouts: equal but for what is known to differ, or where they differ first."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest
from mcap.writer import Writer

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tools"))
os.environ["RERUN_ANALYTICS"] = "0"  # before it is imported

import same_bytes  # noqa: E402
from first_difference import difference_of_folders  # noqa: E402

Write = Callable[[Path], object]


@pytest.fixture
def found(tmp_path: Path) -> Callable[[str, Write, Write], str | None]:
    """The difference of two folders of one file each."""

    def compare(name: str, before: Write, after: Write) -> str | None:
        for side, write in (("before", before), ("after", after)):
            (tmp_path / side / name).parent.mkdir(parents=True, exist_ok=True)
            write(tmp_path / side / name)
        return difference_of_folders(tmp_path / "before", tmp_path / "after")

    return compare


def text(words: str) -> Write:
    return lambda path: path.write_text(words, encoding="utf-8")


def said(**keys: object) -> Write:
    return text(json.dumps(keys))


def table(**columns: list[object]) -> Write:
    return lambda path: pd.DataFrame(columns).to_parquet(path)


def message(data: bytes) -> Write:
    def write(path: Path) -> None:
        with path.open("wb") as file:
            writer = Writer(file)
            writer.start()
            channel = writer.register_channel("/t", "json", writer.register_schema("s", "jsonschema", b"{}"))
            for k, one in enumerate((b"{}", data)):
                writer.add_message(channel, log_time=k, publish_time=k, data=one)
            writer.finish()

    return write


def shown(value: float = 0.25, view: str = "Near", name: str = "east_m") -> Write:
    """A recording of one curve in two views within tabs, as it is written: every id of rows and views is new."""
    import rerun as rr
    import rerun.blueprint as rrb

    def write(path: Path) -> None:
        stream = rr.RecordingStream("test", recording_id="one", send_properties=False)
        views = [rrb.TimeSeriesView(name=one, origin=name, contents=[f"+ /{name}/**"]) for one in (view, "Far")]
        stream.save(path, default_blueprint=rrb.Blueprint(rrb.Tabs(*views), auto_views=False))
        for k in range(3):
            stream.set_time("step", sequence=k)
            stream.log(name, rr.Scalars(float("nan") if k == 0 else value * k))
        stream.flush()
        stream.disconnect()

    return write


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("out/a.csv", text("a,b\n1,2\n")), ("provenance.json", said(seed=1)), ("a.mcap", message(b"{}")),
        ("a.parquet", table(a=[1.0, float("nan")])), ("replay.rrd", shown()),
    ],
)  # fmt: skip
def test_what_is_written_twice_is_the_same(found, name: str, write: Write) -> None:
    assert found(name, write, write) is None


@pytest.mark.parametrize(
    ("name", "before", "after", "expected"),
    [
        ("a.csv", text("n,b\nx,2\ny,3\n"), text("n,b\nx,2\ny,4\n"),
         "column b, row 1: 3 -> 4 (1 rows of 2 in it; 1 columns of 2)"),
        ("a.csv", text("n,b\n"), text("n,c\n"), "columns: [['n', 'b']] -> [['n', 'c']]"),
        ("a.yaml", text("a: 1\nb: 2\n"), text("a: 1\nb: 2.5\n"), "line 2: b: 2 -> b: 2.5"),
        ("a.yaml", text("a: 1\n"), text("a: 1\nb: 2\n"), "line 2: nothing -> b: 2"),
        ("a.yaml", text("a: 1\n"), text("a: 1\n\n"), "line 2: nothing -> "),
        ("provenance.json", said(runs=[{"run": 7}], seed=1), said(runs=[{"run": 8}], seed=1), "runs[0].run: 7 -> 8"),
        ("provenance.json", said(seed=1), said(seed=1, notes=[]), "notes: nothing -> []"),
        ("provenance.json", said(seed=1), said(seed=1.0), "seed: 1 -> 1.0"),
        ("a.parquet", table(a=[1, 2], b=["x", "y"]), table(a=[1, 3], b=["x", "z"]),
         "column a, row 1: 2 -> 3 (1 rows of 2 in it; 2 columns of 2)"),
        ("a.parquet", table(a=[1.0, None]), table(a=[1.0]), "column a, row 1: None -> nothing (1 rows of 2 in it; "),
        ("a.parquet", table(a=[1]), table(a=[1.0]), "['a: int64'] -> ['a: double']"),
        ("a.mcap", message(b"{}"), message(b"[]"),
         "message 1: ('/t', 's', 1, 1, 0, b'{}') -> ('/t', 's', 1, 1, 0, b'[]')"),
        ("a.png", lambda path: path.write_bytes(b"\x89PNG\0"), lambda path: path.write_bytes(b"\x89PNG\1"),
         "byte 4 of 5 and 5"),
        ("replay.rrd", shown(), shown(0.5), "/east_m step Scalars:scalars, row 1: (1, [0.25]) -> (1, [0.5])"),
        ("replay.rrd", shown(), shown(name="north_m"), "only before: /east_m step Scalars:scalars: (0, [nan])"),
    ],
)  # fmt: skip
def test_the_first_difference_is_told(found, name: str, before: Write, after: Write, expected: str) -> None:
    assert found(name, before, after).startswith(f"{name}: {expected}")


def test_a_layout_differs_by_what_its_views_hold(found) -> None:
    told = found("replay.rrd", shown(), shown(view="Close"))
    assert told.startswith("replay.rrd: only ")
    assert "layout /" in told


def test_what_is_known_to_differ_is_listed_by_file_and_key(found) -> None:
    assert found("b/provenance.json", said(copem_replay="1", seed=1), said(copem_replay="2", seed=1)) is None
    took = "note: accuracy took 93 % of the 16 s of this replay; `measure: {accuracy: false}` leaves it out\n"
    took = f"ready\nreplaying: 45 %, 2 minutes left\nreplaying: 412 of 5000 logs, 9 minutes left\n{took}"
    assert found("printed_0_run.txt", text(took), text("ready\n")) is None
    assert found("kept.pieces/x", text("1"), text("2")) is None
    assert found("provenance.yaml", text("copem_replay: 1"), text("copem_replay: 2")) is not None


def test_a_file_on_one_side_only(tmp_path: Path) -> None:
    for side, names in (("before", "ab"), ("after", "a")):
        (tmp_path / side).mkdir()
        for name in names:
            (tmp_path / side / name).touch()
    assert difference_of_folders(tmp_path / "before", tmp_path / "after") == "b: only before"


def test_tables_come_first(tmp_path: Path) -> None:
    for side, value in (("before", 1), ("after", 2)):
        (tmp_path / side).mkdir()
        for name in ("a.svg", "b.mcap.txt", "c.csv"):
            (tmp_path / side / name).write_text(f"n\n{value}\n")
    told = difference_of_folders(tmp_path / "before", tmp_path / "after")
    assert told == "c.csv: column n, row 0: 1 -> 2 (1 rows of 1 in it; 1 columns of 1); and 2 more files"


# ---------------------------------------------------------------------------------------------------- two checkouts


def checkout(folder: Path, number: int, *, code: int = 0, module: str = "tool") -> str:
    """A project whose command writes `number`, and prints where it began."""
    (folder / "copem_replay").mkdir(parents=True)
    (folder / "pyproject.toml").write_text(f'[project]\nscripts = {{copem-replay = "copem_replay.{module}:main"}}\n')
    (folder / "logs").mkdir()
    for case in same_bytes.CASES:
        if case.recorded is None:
            (folder / f"logs/{case.source}.yaml").write_text("units: {}\n")
    (folder / "copem_replay/__init__.py").touch()
    (folder / f"copem_replay/{module}.py").write_text(
        "import pathlib, sys\n"
        "def main():\n"
        "    print(*sys.argv[1:], pathlib.Path('e.yaml').read_text())\n"
        f"    pathlib.Path('t.csv').write_text('n\\n{number}\\n')\n"
        f"    return {code}\n"
    )
    return str(folder)


def ended(monkeypatch: pytest.MonkeyPatch, *words: str) -> int | str | None:
    monkeypatch.setattr(sys, "argv", ["same_bytes.py", *words])
    try:
        return same_bytes.main()
    except SystemExit as end:
        return end.code


def test_two_checkouts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Equal with modules of other names; different; failing alike, which is no success."""
    one, same, other, fails = (
        checkout(tmp_path / "one", 1), checkout(tmp_path / "same", 1, module="renamed"),
        checkout(tmp_path / "other", 2), checkout(tmp_path / "fails", 1, code=2),
    )  # fmt: skip
    cases = ("--cases", "crossing_units:exact", "tc016d:pieces")
    assert ended(monkeypatch, one, same, *cases) == 0
    *lines, counts = capsys.readouterr().out.splitlines()
    assert [" ".join(line.split()[:2]) for line in lines] == ["tc016d:pieces same", "crossing_units:exact same"]
    assert counts.startswith("2 same, 0 different, 0 left out")
    assert ended(monkeypatch, one, other, "--cases", "tc016d:jobs4", "--keep", str(tmp_path / "kept")) == 1
    out = capsys.readouterr().out
    assert "tc016d:jobs4               t.csv: column n, row 0: 1 -> 2 (1 rows of 1 in it; 1 columns of 1)" in out
    assert (tmp_path / "kept/tc016d_jobs4/after/t.csv").read_text() == "n\n2\n"
    assert ended(monkeypatch, fails, fails, "--cases", "tc016d:jobs4") == 1
    assert "before: `run e.yaml --runs 20 --jobs 4 --out out` ended with 2" in capsys.readouterr().out
    assert ended(monkeypatch, one, same, "--time", "tc016d") == 0
    assert "after : before " in capsys.readouterr().out


def test_a_checkout_that_changes_meanwhile_is_no_comparison(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    one, whole = checkout(tmp_path / "one", 1), same_bytes.compared

    def compared(*given: object) -> str | None:
        (tmp_path / "one/copem_replay/new.py").touch()
        (tmp_path / "one/copem_replay/__init__.py").write_text("1\n")
        return whole(*given)

    monkeypatch.setattr(same_bytes, "compared", compared)
    assert ended(monkeypatch, one, one, "--cases", "tc016d") == 2
    assert f"changed meanwhile: {one}, {one}; compare again" in capsys.readouterr().out


def test_changes_are_merged_into_the_experiment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one, kept = checkout(tmp_path / "one", 1), tmp_path / "kept"
    assert ended(monkeypatch, one, one, "--cases", "crossing_units:exact", "--keep", str(kept)) == 0
    printed = (kept / "crossing_units_exact/before/printed_0_run.txt").read_text()
    assert printed.startswith("run e.yaml --runs 20 --jobs 1 --out out units: {}\nmeasure:\n  exact: true\n")


def test_what_cannot_be_compared_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    one = checkout(tmp_path / "one", 1)
    assert "expected a checkout of the project" in str(ended(monkeypatch, one, str(tmp_path)))
    assert "found tc017" in str(ended(monkeypatch, one, one, "--cases", "tc017"))
    assert "--time: expected one of tc016d, " in str(ended(monkeypatch, one, one, "--time", "ind_aah1"))
    monkeypatch.setattr(same_bytes, "DATA", tmp_path / "nowhere")
    assert ended(monkeypatch, one, one, "--cases", "ind_aah1") == 2
    assert f"left out: no ind_aah1.mcap in {tmp_path / 'nowhere'}" in capsys.readouterr().out
