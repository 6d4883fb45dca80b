"""Figures and report of many rows: made of counts, or log by log; never of all of `detections.parquet` at once."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from copem_replay.metrics.limits import find_clusters
from copem_replay.metrics.row_figures import FigureRows
from copem_replay.metrics.summary import DETECTED, tally_rows
from copem_replay.pipeline.expansion import find_facts
from copem_replay.report import write_html_report
from copem_replay.report.figures import Selection
from copem_replay.report.figures.detection_curves import build_curve
from copem_replay.report.figures.latency_breakdown import (
    FUSION,
    TRANSPORT,
    UNTIL_CAPTURED,
    count_detected,
    mean_stages,
    mean_stages_by_configuration,
)
from copem_replay.report.figures.registry import write_figure_files
from copem_replay.report.figures.selection import find_differing, pivot_by_run
from copem_replay.report.html.tables import count_misses
from copem_replay.results.read import Results, read_results
from tests.helpers.report_pages import changed, eighteen, replayed

LOGS = "logs: [drive.mcap]"
LOSSY = "{kind: radio, latency: 0.25, reception: {kind: constant, probability: 0.5}}"
RADIO = ("late: {units: [ego], latency_s: 0.5}", f"late: {{units: [weak], link: {LOSSY}}}")


@pytest.fixture(scope="module")
def several(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three logs, of two objects each; some lists come by a link."""
    logs = [f"drive{k}.mcap" for k in range(3)]
    return replayed(tmp_path_factory.mktemp("several"), changed((LOGS, f"logs: [{', '.join(logs)}]"), RADIO), *logs)


def test_neither_holds_all_rows(several: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def whole(results: Results) -> Any:
        raise AssertionError("all rows at once")

    most: list[int] = []
    each = Results.each

    def watched(results: Results, *columns: str, **given: Any) -> Any:
        for rows in each(results, *columns, **given):
            most.append(len(rows))
            yield rows

    monkeypatch.setattr(Results, "detections", property(whole))
    monkeypatch.setattr(Results, "each", watched)
    assert write_html_report(several, tmp_path / "r.html").exists()
    files, notes = write_figure_files(read_results(several), tmp_path / "figures", Selection())
    assert ({path.stem for path in files}, notes) == (
        {"answer", "differences", "runs", "curves", "late_paths", "distances", "latency_breakdown"}, []
    )  # fmt: skip
    # Of each log five configurations × six runs × two objects.
    assert set(most) == {60}


def test_log_by_log_they_are_as_of_all_rows(several: Path) -> None:
    """What goes log by log, against the whole table."""
    results = read_results(several)
    table = results.detections
    names = tuple(results.experiment.configurations)
    of_all = {name: mean_stages(table[table["configuration"] == name], results.experiment, name) for name in names}
    found = mean_stages_by_configuration(results, names)
    assert found == {name: pytest.approx(of, abs=2e-9) for name, of in of_all.items()}
    assert any(len(of) > 4 for of in found.values()), "the way of lists that come by a link"
    detected = table.groupby("configuration")["detected"].agg(["sum", "size"])
    assert count_detected(results) == {name: tuple(detected.loc[name]) for name in names}
    keys = ["log", "object_id", "run"]
    times = table.set_index([*keys, "configuration"])["detection_s"].unstack("configuration")[list(names)]
    np.testing.assert_array_equal(np.concatenate(list(pivot_by_run(results, "detection_s"))), times.to_numpy())


def test_in_sight_known_in_one_log_alone(several: Path) -> None:
    """Where recorded units do not tell what they had in sight, this is one stage of all logs."""
    experiment = read_results(several).experiment
    one = pd.DataFrame({"detected": True, "onset_s": 1.0, "captured_s": [3.0, 4.0], "detection_s": [5.0, 7.0]})
    logs = [one.assign(configuration="half", out_of_view_s=0.0, hidden_s=hidden_s) for hidden_s in (1.0, np.nan)]
    results: Any = SimpleNamespace(
        experiment=experiment, facts=find_facts(experiment), each=lambda *columns: iter(logs)
    )
    expected = {UNTIL_CAPTURED: 2.5, TRANSPORT: 2.5, FUSION: 0.0}
    assert mean_stages_by_configuration(results, ["half"]) == {"half": expected}
    assert mean_stages(pd.concat(logs), experiment, "half") == expected


def test_those_that_differ_in_one_log_alone(tmp_path: Path) -> None:
    """Of eighteen configurations the same are drawn of two logs as of the whole table's times."""
    text = eighteen().replace(LOGS, "logs: [drive0.mcap, drive1.mcap]")
    results = read_results(replayed(tmp_path, text, "drive0.mcap", "drive1.mcap"))
    names = tuple(results.experiment.configurations)
    table = results.detections.set_index(["log", "object_id", "run", "configuration"])["time_to_detection_s"]
    times = table.unstack("configuration").round(6)
    alike = {name: next(one for one in names if times[one].equals(times[name])) for name in names}
    assert set(find_differing(results, names)) <= set(alike.values())
    assert set(find_differing(results, names, most=len(set(alike.values())))) == set(alike.values())


@st.composite
def tables(draw: st.DrawFn) -> pd.DataFrame:
    """Rows of one configuration: a few instants, many ties, some never, of the objects of some logs."""
    logs, things, runs = draw(st.integers(1, 6)), draw(st.integers(1, 6)), draw(st.integers(1, 6))
    index = pd.MultiIndex.from_product(
        [[f"log {k}" for k in range(logs)], range(runs), [f"{k}" for k in range(things)]],
        names=["log", "run", "object_id"],
    )
    rows = index.to_frame(index=False).assign(configuration="A", object_class="car", episode=0, onset_s=1.0)
    steps = draw(st.lists(st.integers(-2, 12), min_size=len(rows), max_size=len(rows)))
    rows["time_to_detection_s"] = [step / 4 if step <= 8 else np.nan for step in steps]
    ends = draw(st.lists(st.sampled_from(["object_left", "log_end"]), min_size=logs * things, max_size=logs * things))
    episode = rows.groupby(["log", "object_id"], sort=False).ngroup()
    rows["ended_by"], rows["ended_s"] = np.array(ends, dtype=object)[episode], 3.0 + 0.25 * (episode % 5)
    rows["detected"] = rows["time_to_detection_s"].notna()
    rows["detection_s"] = rows["onset_s"] + rows["time_to_detection_s"]
    rows["distance_at_detection_m"] = 50 - rows["detection_s"]
    return rows


@given(tables())
def test_counts_say_what_rows_say(rows: pd.DataFrame) -> None:
    """The same curve to the last bit, the same bands, limits of the mean, and objects that are missed."""
    found = tally_rows(rows)
    counted = found[found["event"] == DETECTED]
    each = rows.assign(runs=1)
    assert counted["runs"].sum() == len(rows)
    clusters = [find_clusters(of) for of in (counted, each)]
    banded = clusters[0] is not None and not clusters[0].by_run
    if not banded:  # of one object runs are the clusters, for which the tally is not taken
        clusters = [None, None]
    one, all_ = (build_curve(*of) for of in zip((counted, each), clusters, strict=True))
    for name in ("times_s", "share", *(("low", "high") if banded and len(one.times_s) else ())):
        np.testing.assert_array_equal(getattr(one, name), getattr(all_, name))
    if banded:
        limits = []
        for of, its in zip((counted, each), clusters, strict=True):
            found_s = FigureRows(of, of["runs"].to_numpy(dtype=float), its).limit_mean_time(4.0, 0.95)
            limits.append((found_s.low, found_s.high))
        assert limits[0] == pytest.approx(limits[1], abs=1e-9, nan_ok=True)
    columns = ["log", "object_id", "missed", "runs", "ended_s", "ended_by"]
    by_name = [
        count_misses(of)[columns].sort_values(["log", "object_id"]).to_numpy().tolist() for of in (counted, each)
    ]
    assert by_name[0] == by_name[1]
