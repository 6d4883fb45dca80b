"""Slices of results: a group is what an experiment that measures only its objects would give, in every command."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

import copem_replay as cr
from copem_replay.results.slices import groups_text, summarise_slices
from tests.helpers.recordings import Obj, pedestrian, write_recording

CARS, WALKERS = range(2, 8), range(10, 15)
TEXT = """\
version: 1
logs: [one.mcap, two.mcap]
runs: 12
seed: 3
pems:
  dim:
    - when: {classes: [pedestrian]}
      detection: {kind: constant, probability: 0.1}
      error: {kind: gaussian, covariance_m2: [[0.2, 0], [0, 0.2]]}
    - detection: {kind: constant, probability: 0.4}
      error: {kind: gaussian, covariance_m2: [[0.1, 0], [0, 0.1]]}
units: {ego: {on: ego, pem: dim}}
configurations:
  now: {units: [ego]}
  late: {units: [ego], latency_s: 0.2}
measure: {onset: {kind: appears}, began: [log_start, appeared], horizon_s: 1.5, by: [class, log]}
show: null
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six cars and five pedestrians around an ego that stands, for 2 s, in two drives."""
    place = tmp_path_factory.mktemp("slices")
    for drive, y in (("one", 6.0), ("two", 9.0)):
        frames = []
        for k in range(21):
            things = [Obj(id=1, x=0.0)]
            things += [Obj(id=n, x=12.0 * n - 0.1 * k, y=y, vx=-1.0) for n in CARS]
            things += [pedestrian(n, x=4.0 * n, y=-y + 0.1 * k, vy=1.0) for n in WALKERS]
            frames.append((0.1 * k, things))
        write_recording(place / f"{drive}.mcap", frames, host=1)
    (place / "study.yaml").write_text(TEXT)
    cr.run(place / "study.yaml").save(place / "out")
    return place


def changed(folder: Path, old: str, new: str) -> cr.Results:
    path = folder / "changed.yaml"
    path.write_text(TEXT.replace(old, new))
    return cr.run(path)


FIGURES = (
    "n", "detected_share", "detected_share_low", "detected_share_high", "ttd_median_s", "ttd_rmst_s", "unknown_s",
    "dad_median_m", "position_rmse_m", "position_rmse_captured_m", "bias_east_m", "velocity_rmse_mps", "nees",
    "age_of_information_s", "longest_gap_s",
)  # fmt: skip


def equal(found: pd.DataFrame, expected: pd.DataFrame, names: tuple[str, ...]) -> None:
    for name in names:
        assert found[name].astype(float).tolist() == pytest.approx(
            expected[name].astype(float).tolist(), rel=1e-8, abs=1e-12, nan_ok=True
        ), name


def test_a_class_is_as_if_it_alone_were_measured(folder: Path) -> None:
    by = cr.load_results(folder / "out").summary_by
    assert by is not None
    for word in ("car", "pedestrian"):
        alone = changed(folder, "began:", f"objects: {{classes: [{word}]}}, began:")
        equal(by[by["group"] == word], alone.summary, FIGURES)


def test_a_drive_is_as_if_it_alone_were_replayed(folder: Path) -> None:
    by = cr.load_results(folder / "out").summary_by
    assert by is not None
    for drive in ("one", "two"):
        alone = changed(folder, "logs: [one.mcap, two.mcap]", f"logs: [{drive}.mcap]")
        equal(by[by["group"] == drive], alone.summary, (*FIGURES, "false_positives_per_min", "duplicates_per_min"))
        assert by.loc[by["group"] == drive, "interval_over"].tolist() == ["objects"] * 2


def test_what_is_read_back_is_what_the_run_wrote(folder: Path, tmp_path: Path) -> None:
    from copem_replay.results.write import write_csv

    found = summarise_slices(cr.load_results(folder / "out"), ["class", "log"])
    assert found is not None
    write_csv(found, tmp_path / "found.csv")
    assert (tmp_path / "found.csv").read_bytes() == (folder / "out/summary_by.csv").read_bytes()
    in_memory = summarise_slices(cr.run(folder / "study.yaml"), ["class", "log"])
    assert in_memory is not None
    write_csv(in_memory, tmp_path / "memory.csv")
    assert (tmp_path / "memory.csv").read_bytes() == (folder / "out/summary_by.csv").read_bytes()


def test_the_differences_of_a_group_are_those_of_its_objects(folder: Path) -> None:
    comparison = cr.compare(folder / "out", by=["class", "log", "began"])
    groups = comparison.groups
    assert groups is not None

    def rows(table: Any) -> dict[str, tuple[Any, ...]]:
        names = ["value", "baseline_value", "difference", "low", "high", "n"]
        return {row.metric: tuple(getattr(row, name) for name in names) for row in table.itertuples()}

    for word in ("car", "pedestrian"):
        alone = cr.compare(changed(folder, "began:", f"objects: {{classes: [{word}]}}, began:"))
        expected = rows(alone.overall)
        found = rows(groups[groups["group"] == word])
        assert set(found) == set(expected) - {"false_positives_per_min"}  # a ghost has no true class
        for metric in found.keys() - {"gospa_held_m", "ttd_rmst_s_equal_ghosts"}:
            assert found[metric] == pytest.approx(expected[metric], nan_ok=True), metric
    of_logs = comparison.table[comparison.table["log"] == "one"]
    found, expected = rows(groups[groups["group"] == "one"]), rows(of_logs)
    assert found.keys() == expected.keys()
    for metric, row in found.items():
        assert row == pytest.approx(expected[metric], nan_ok=True), metric
    assert set(groups.loc[groups["by"] == "began", "group"]) == {"log_start"}
    assert groups["low"].notna().any()


def test_the_terminal_the_figure_and_the_report_show_it(folder: Path) -> None:
    results = cr.load_results(folder / "out")
    assert results.summary_by is not None
    text = groups_text(results.summary_by)
    assert "by class: 2 groups looked at in 2 configurations" in text
    assert "pedestrian, car: no interval of detected_share: 2 logs, fewer than 3" in text
    assert "95 %: over 11 objects of this drive" in text
    files, _ = cr.write_figures(results, folder / "figures", by=["log*class"])
    assert {"slices.png", "slices.svg"} <= {file.name for file in files}
    assert "one, pedestrian" in (folder / "figures/slices.svg").read_text(encoding="utf-8")
    page = cr.write_report(results, folder / "report.html").read_text(encoding="utf-8")
    links, targets = (set(re.findall(f'{what}="#?(slices-drive-[0-9]+)"', page)) for what in ("href", "id"))
    assert links == targets == {"slices-drive-0", "slices-drive-1"}
    plain = cr.write_report(changed(folder, ", by: [class, log]", ""), folder / "plain.html").read_text(
        encoding="utf-8"
    )
    assert "Which drive, which class" not in plain
