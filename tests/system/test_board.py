"""The board: its figures from the files of the results folders, an own fusion, what is refused, and its page."""

from __future__ import annotations

import hashlib
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import copem_replay as cr
from tests.helpers.recordings import Obj, pedestrian, write_recording

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs/guide/board.md"
sys.path.insert(0, str(ROOT / "tools"))

import board  # noqa: E402

OWN = """\
import numpy as np

import copem_replay as cr


class Last(cr.StepFusion):
    def step(self, now_s, inbox, memory):
        return np.concatenate([cr.entries_of(0), *(one.entries for one in inbox.newest[-1:])]), memory
"""


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a drive and one without an ego; three fusions, one kind of units, one radio."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(board, "SITUATIONS", [board.FIRST])
    monkeypatch.setattr(board, "FUSIONS", {name: board.FUSIONS[name] for name in ("union", "gnn", "tracker:predict")})
    frames = [
        (
            0.1 * k,
            [
                Obj(id=1, x=0.5 * k, vx=5.0),
                Obj(id=2, x=70.0 - k, y=3.5, vx=-10.0, yaw=np.pi),
                *(pedestrian(3 + n, 48.0 + n, -4.0 - n + 0.1 * k, vy=1.0) for n in range(6)),
            ],
        )
        for k in range(51)
    ]
    write_recording(tmp_path / "drive.mcap", frames, host=1)
    standing = [[replace(one, x=0.0, vx=0.0) if one.id == 1 else one for one in objects] for _, objects in frames]
    write_recording(tmp_path / "standing.mcap", [(0.1 * k, objects) for k, objects in enumerate(standing)], host=1)
    write_recording(tmp_path / "alone.mcap", [(0.1 * k, [pedestrian(3, 0.1 * k)]) for k in range(20)], host=None)
    (tmp_path / "nearest.py").write_text(OWN)
    return tmp_path


def run(*words: str) -> int:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["board.py", *words])
        return board.main()


def table(printed: str, number: int) -> list[list[str]]:
    """Cells of the rows of a table, that of its head first."""
    blocks = re.findall(r"(?:^\|.*\n)+", printed, re.MULTILINE)
    return [
        [one.strip() for one in line.strip("|").split("|")] for line in blocks[number].splitlines() if "---" not in line
    ]


def figure(cell: str) -> float:
    return float(re.split("<| ", cell)[0].replace("−", "-"))


def tables_on(text: str) -> list[tuple[str, str]]:
    return re.findall(r"(?s)<!-- board: (\w+) -->\n(.*?)\n<!-- /board -->", text)


def known_after_s(folder: Path, name: str) -> float:
    """Mean of min(time, 5 s) of those that began later; where all are detected or gone that is all there is to it."""
    rows = pd.read_parquet(folder / "detections.parquet").query("configuration == @name and began != 'log_start'")
    assert (rows["detected"] | (rows["ended_by"] == "object_left")).all()
    return float(np.minimum(rows["time_to_detection_s"].fillna(5.0), 5.0).mean())


def held_rmse_m(folder: Path, name: str, other: str) -> tuple[float, float]:
    """Of both, over every frame at which both hold the object."""
    rows = pd.read_parquet(folder / "accuracy.parquet").set_index(["configuration", "object_id", "run"])["error_held_m"]
    both = [
        (mine, its)
        for (object_id, run_of), errors in rows[name].items()
        for mine, its in zip(errors, rows[other][object_id, run_of], strict=True)
        if mine is not None and its is not None and not np.isnan([mine, its]).any()
    ]
    assert len(both) > 100
    mine_m, its_m = np.sqrt(np.mean(np.square(both), axis=0))
    return float(mine_m), float(its_m)


def braking_share(folder: Path, name: str) -> float:
    driving_h = pd.read_csv(folder / "summary.csv").set_index("configuration")["driving_h"][name]
    rows = pd.read_parquet(folder / "needless.parquet").query("configuration == @name")
    return float(rows["lasts_s"].sum()) / (2 * 3600 * driving_h)


def test_figures_are_those_of_the_files_and_an_own_fusion_has_a_row(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("drive.mcap", "alone.mcap", "--runs", "2", "--fusion", "nearest:Last") == 0
    printed, folder = capsys.readouterr().out, here / "out/board/usual-units-good-radio"
    names = ["ideal", "ideal:memory", "union", "gnn", "tracker:predict", "nearest:Last"]
    first = table(printed, 0)[1:]
    assert [row[0].split("**")[1] for row in first] == [*names, "alone"]
    alone_s, ideal_s = known_after_s(folder, "alone"), known_after_s(folder, "ideal")
    for name, (_, sooner, later, position, _, brakes) in zip(names, first, strict=False):
        assert figure(sooner) == pytest.approx(alone_s - known_after_s(folder, name), abs=0.0051)
        assert figure(later) == pytest.approx(known_after_s(folder, name) - ideal_s, abs=0.00051)
        mine_m, its_m = held_rmse_m(folder, name, "ideal:memory")
        assert figure(position) == pytest.approx(mine_m - its_m, abs=0.0051)
        share = braking_share(folder, name) - braking_share(folder, "alone")
        assert figure(brakes) == pytest.approx(100 * share, abs=0.051)
    assert f"known after {alone_s:.2f} s" in first[-1][1]
    seen = {figure(row[2]) for row in first[2:-1]}
    assert len(seen) > 1, "the last unit alone is later"
    (of_drive,) = table(printed, 2)[1:]
    assert of_drive[:4] == ["drive", "6", f"{alone_s:.2f}", f"{alone_s - ideal_s:.2f}"]
    digest = hashlib.sha256((here / "drive.mcap").read_bytes()).hexdigest()
    assert f"- `drive` `{digest[:12]}`: yours\n- `alone` is left out: no ego" in printed
    assert [row[0] for row in table(printed, 3)[1:]] == names[2:]


def test_a_vehicle_that_stands_brakes_for_nothing_never(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("standing.mcap", "--runs", "1") == 0
    rows = table(capsys.readouterr().out, 0)[1:]
    assert {row[-1] for row in rows} == {"–", "0", "– % of driving"} - {"0"}


def test_a_page_keeps_what_is_written_around_its_tables_and_comes_out_the_same_again(here: Path) -> None:
    page = "a\n<!-- board: made -->\n\n<!-- /board -->\nb\n<!-- board: first -->\nold\n<!-- /board -->\n"
    (here / "page.md").write_text(page)
    texts = []
    for _ in range(2):
        assert run("drive.mcap", "--runs", "2", "--page", "page.md") == 0
        texts.append((here / "page.md").read_text())
    assert texts[0] == texts[1]
    made, first = (table for _, table in tables_on(texts[0]))
    assert [first.partition("|")[0], made.partition(":")[0]] == ["", "recordings"]
    assert texts[0].replace(first, "old").replace(made, "") == page


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["drive.mcap", "--fusion", "nowhere.at_all:Fusion"], "nowhere"),
        (["drive.mcap", "--fusion", "nearest:First"], "First"),
        (["missing.mcap"], "missing.mcap"),
        (["alone.mcap"], "alone.mcap: expected a drive with an ego, found none"),
    ],
)
def test_what_is_missing_is_one_line(
    here: Path, capsys: pytest.CaptureFixture[str], words: list[str], line: str
) -> None:
    assert run(*words) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert line in said
    assert not (here / "out").exists()


def marks(low: dict[str, float]) -> dict[str, str]:
    """Marks of fusions whose differences to the best end at these lower limits, and are `low ± 1` in two recordings."""

    class Compared:
        table = pd.DataFrame(
            [
                {"metric": "m", "configuration": name, "log": log, "difference": limit + away, "interval_over": "logs",
                 "star": "*" if log == "all" and limit > 0 else None}
                for name, limit in low.items() for log, away in (("all", 1), ("one", 1), ("other", -1))
            ]
        )  # fmt: skip

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cr, "compare", lambda *_, **__: Compared, raising=False)
        patch.setattr(board.Found, "figure", lambda _, name, __: low.get(name, -1.0))
        return board.Found(None, ("best", *low)).marks("m")  # type: ignore[arg-type]


def test_marks_of_the_best_of_whoever_is_not_shown_to_be_worse_and_in_how_many_drives_it_is() -> None:
    assert marks({"a": 0.1, "b": 2.0}) == {"best": " ★", "a": " 1/2", "b": " 2/2"}
    assert marks({"a": -0.1, "b": 2.0}) == {"best": " ☆", "a": " ☆ 1/2", "b": " 2/2"}


def test_the_page_is_of_the_settings_of_the_tool() -> None:
    """Whoever changes units, radios, fusions or runs makes the page anew."""
    shown = dict(tables_on(PAGE.read_text(encoding="utf-8")))
    assert list(shown) == ["first", "situations", "recordings", "time", "made"]
    assert f"settings: `{board.digest_settings(board.RUNS)}`" in shown["made"]
    for path in ("logs/crossing.mcap", "logs/tc016d.mcap"):
        assert hashlib.sha256((ROOT / path).read_bytes()).hexdigest()[:12] in shown["made"]


@pytest.mark.long
def test_the_lines_of_the_samples_on_the_page_come_out_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(board, "SITUATIONS", [board.FIRST])
    assert run(*(str(ROOT / f"logs/{name}.mcap") for name in ("crossing", "tc016d")), "--out", str(tmp_path)) == 0
    shown = dict(tables_on(PAGE.read_text(encoding="utf-8")))["recordings"].splitlines()
    assert table(capsys.readouterr().out, 2)[1:] == table("\n".join(shown[:4]) + "\n", 0)[1:]
