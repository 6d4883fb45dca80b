"""Metrics: one that is written here has a column, a place in the report and in the schema; all are said in the docs."""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import pandas as pd
import pytest

from copem_replay.core import components
from copem_replay.core.errors import InputError
from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.metric import RowMetric
from copem_replay.metrics.summary import format_summary, summarise_rows
from copem_replay.metrics.summary_metrics import COMPARED, METRICS, PARTS
from copem_replay.report.html.page import build_page
from copem_replay.report.html.study import load_study
from copem_replay.results.compare.metrics import FIGURES
from tests.experiment.test_validate import without_logs
from tests.helpers import experiments
from tests.helpers.report_pages import Page, changed, replayed

EVERY = "measure: {onset"
DOCS = Path(__file__).parents[2] / "docs/guide/metrics.md"


class LateShare(RowMetric):
    """Of the detected rows, how many are known later than a limit."""

    help: ClassVar[str] = "of the detected, how many are known too late"
    better: ClassVar[Literal[-1, 0, 1]] = -1

    late_s: float

    def statistics(self, rows: pd.DataFrame) -> Mapping[str, np.ndarray]:
        late = rows["time_to_detection_s"].to_numpy(dtype=float) > self.late_s
        return {"late": late, "detected": rows["detected"].to_numpy(dtype=bool)}

    def value(self, sums: Mapping[str, float]) -> float | None:
        return sums["late"] / sums["detected"] if sums["detected"] else None


class OneNumber(RowMetric):
    def statistics(self, rows: pd.DataFrame) -> Mapping[str, np.ndarray]:
        return {"n": np.array(len(rows))}

    def value(self, sums: Mapping[str, float]) -> float | None:
        return sums["n"]


class AsText(RowMetric):
    def statistics(self, rows: pd.DataFrame) -> Mapping[str, np.ndarray]:
        return {"n": np.ones(len(rows))}

    def value(self, sums: Mapping[str, float]) -> float | None:
        return str(sums["n"])  # type: ignore[return-value]


class NoColumn(RowMetric):
    def statistics(self, rows: pd.DataFrame) -> Mapping[str, np.ndarray]:
        return {"n": rows["no_such_column"].to_numpy()}

    def value(self, sums: Mapping[str, float]) -> float | None:
        return sums["n"]


def own(kind: str, name: str, **keys: Any) -> str:
    said = "".join(f", {key}: {value}" for key, value in keys.items())
    return f"{{kind: '{__name__}:{kind}', name: {name}{said}}}"


def test_an_own_metric_is_in_summary_and_report(tmp_path: Path) -> None:
    """`late` knows both objects after 0.5 s, `hit` after 1.8 s, the truth at once, `never` none: nothing to divide."""
    said = f"measure: {{metrics: [{own('LateShare', 'late_share', late_s=1)}], onset"
    folder = replayed(tmp_path, changed((EVERY, said)))
    rows = pd.read_csv(folder / "summary.csv").set_index("configuration")
    assert list(rows)[-1] == "late_share"
    assert rows["late_share"].drop(["half", "never"]).to_dict() == {"GT": 0.0, "late": 0.0, "hit": 1.0}
    assert np.isnan(rows.loc["never", "late_share"])
    table = pd.read_parquet(folder / "detections.parquet")
    half = table[(table["configuration"] == "half") & table["detected"]]
    assert rows.loc["half", "late_share"] == pytest.approx((half["time_to_detection_s"] > 1).mean())
    found = Page(build_page(load_study(folder)))
    assert found.tables["own"]["hit"]["late_share"].value == "1"
    assert found.tables["own"]["never"]["late_share"].text.strip() == "–"
    assert "of the detected, how many are known too late" in found.words
    printed = format_summary(rows.reset_index()).splitlines()
    assert ["hit", "1"] in [line.split() for line in printed]
    assert "metrics:" in (folder / "experiment.yaml").read_text()


def test_without_own_metrics_the_key_is_not_written(tmp_path: Path) -> None:
    assert "metrics:" not in (replayed(tmp_path) / "experiment.yaml").read_text()


def rows_of(*logs: str) -> pd.DataFrame:
    """Two rows of each log in one configuration: known after 1 s, and after 3 s."""
    one = {"configuration": "c", "detected": True, "episode": 0, "onset_s": 0.0, "ended_s": 5.0, "ended_by": "log_end",
           "distance_at_detection_m": 9.0, "run": 0}  # fmt: skip
    return pd.DataFrame(
        [one | {"log": log, "object_id": str(k), "time_to_detection_s": 1.0 + 2 * k} for log in logs for k in (0, 1)]
    )


def test_statistics_are_sums_over_logs() -> None:
    """Late: one of two rows in each of the logs; without rows there is no value."""
    late = LateShare(kind="x:LateShare", name="late_share", late_s=2.0)
    table, _ = summarise_rows(
        rows_of("a", "b", "b2"), ["c", "none"], {"c": 1.0, "none": None}, horizon_s=5.0, own=[late]
    )
    assert table["late_share"].iloc[0] == 0.5
    assert pd.isna(table["late_share"].iloc[1])


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        (OneNumber, r"statistics: n: expected shape \(2,\), found \(\) \(.*test_metric\.py:\d+\)$"),
        (AsText, r"value: expected a number or None, found str \(.*test_metric\.py:\d+\)$"),
        (NoColumn, r"KeyError: 'no_such_column' \(.*test_metric\.py:\d+\)$"),
    ],
)
def test_an_own_metric_that_fails_is_named(kind: type[RowMetric], said: str) -> None:
    with pytest.raises(InputError, match=rf"^measure\.metrics\[0\]: own:X: {said}"):
        summarise_rows(rows_of("a"), ["c"], {"c": 1.0}, horizon_s=5.0, own=[kind(kind="own:X", name="x")])


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (["late", "late"], "metrics: expected a name that no other column has, found 'late'"),
        (["ttd_rmst_s"], "metrics: expected a name that no other column has, found 'ttd_rmst_s'"),
        (["configuration"], "metrics: expected a name that no other column has, found 'configuration'"),
    ],
)
def test_a_column_has_one_name(tmp_path: Path, names: list[str], said: str) -> None:
    listed = ", ".join(own("LateShare", name, late_s=1) for name in names)
    assert without_logs(tmp_path, experiments.changed(f"measure: {{metrics: [{listed}]}}")) == [f"17: measure: {said}"]


def test_installed_metrics_are_in_the_schema(monkeypatch: pytest.MonkeyPatch) -> None:
    def entry_points(group: str) -> list[EntryPoint]:
        return [EntryPoint("late", f"{__name__}:LateShare", group)] if group == "copem_replay.metric" else []

    monkeypatch.setattr(components, "entry_points", entry_points)
    metrics = Experiment.model_json_schema()["$defs"]["Measure"]["properties"]["metrics"]
    kinds = {one["properties"]["kind"].get("const"): set(one["properties"]) for one in metrics["items"]["anyOf"]}
    assert kinds == {"late": {"kind", "name", "late_s"}, None: {"kind"}}


def test_every_metric_is_said_once_and_in_the_docs() -> None:
    names = [metric.name for metric in METRICS]
    assert len(set(names)) == len(names)
    text = DOCS.read_text(encoding="utf-8")
    said = set(re.findall(r"`([a-z0-9_*]+)`", text))
    starred = [re.compile(word.replace("*", ".*")) for word in said if "*" in word]
    for metric in METRICS:
        assert metric.help, metric.name
        assert metric.part in ("", *PARTS)
        assert metric.name in said or any(one.fullmatch(metric.name) for one in starred), metric.name


def test_what_is_compared_has_words_a_figure_and_a_better_direction() -> None:
    for metric in COMPARED.values():
        assert metric.compared is not None
        assert metric.better != 0
        assert metric.compared.words
        assert metric.header, metric.name
        assert callable(metric.compared.figure) or metric.compared.figure in FIGURES
