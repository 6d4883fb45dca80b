"""Keys of criteria: which are refused, with file, line and key, and what each names."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import copem_replay as cr
from copem_replay.core.errors import ExperimentError, InputError
from copem_replay.experiment.criteria import Criterion, choose_judged, note_undecidable, parse_fail_on
from copem_replay.experiment.cross_references import read_criteria
from copem_replay.experiment.schema import Configuration
from copem_replay.metrics.config import Measure
from copem_replay.metrics.row_figures import JUDGED, PER_MINUTE, SUMMED
from copem_replay.metrics.summary_metrics import METRIC

STUDY: dict[str, Any] = {"configurations": {"GT": {"units": "truth"}, "gnn": {}, "late": {}}}
BRAKING = {"braking": {"driver": {"kind": "constant_deceleration"}}}


def problems_of(tmp_path: Path, text: str, study: dict[str, Any] = STUDY) -> list[str]:
    path = tmp_path / "limits.yaml"
    path.write_text(text)
    with pytest.raises(ExperimentError) as caught:
        read_criteria(path, study)
    return [problem.removeprefix(f"{path}:") for problem in caught.value.problems]


def test_what_is_judged_is_a_metric() -> None:
    assert {*JUDGED, *SUMMED, *PER_MINUTE} <= METRIC.keys()


REFUSED = {
    "metric: ttd_p96_s, at_most: 1": "metric: expected a column of summary.csv, found ttd_p96_s; did you mean ttd_p95",
    "metric: nonsense, at_most: 1": "metric: expected a column of summary.csv, found nonsense; `copem-replay schema`",
    "metric: pass_share, at_least: 1": "found pass_share; `braking: {driver: …}` would",
    "metric: conflict_ttd_p95_s, at_most: 1": "found conflict_ttd_p95_s; `measure: {conflict: {}}` would",
    "metric: ttd_p95_s_exact, at_most: 1": "found ttd_p95_s_exact; `measure: {exact: true}` would",
    "metric: gospa_m, at_most: 1": "has an interval over logs or runs, found gospa_m; with `against`, gospa_held_m has",
    "metric: list_rate_hz, at_least: 1": "has an interval over logs or runs, found list_rate_hz; there are",
    "metric: gospa_held_m, at_most: 1": "gospa_held_m is a difference of two configurations; say `against:",
    "metric: ttd_p95_s, at_most: 1, against: gnn": "expected a metric that `compare` pairs, as there is `against`",
    "metric: unknown_s": "expected one of `at_most` and `at_least`, found none",
    "metric: unknown_s, at_most: 1, at_least: 0": "expected one of `at_most` and `at_least`, found both",
    "metric: unknown_s, at_most: soon": "at_most: expected a number, found 'soon'",
    "metric: unknown_s, at_most: 1, configurations: [gnm]": "found gnm: no configuration is named 'gnm'",
    "metric: ttd_rmst_s, at_most: 1, against: gnm": "against: expected names of configurations, found gnm",
    "metric: unknown_s, at_most: 1, each: clas": "each: no slice is named 'clas'; did you mean class?",
    "metric: unknown_s, at_most: 1, each: class, by: {class: car}": "expected either `by`, one group, or `each`",
    "metric: unknown_s, at_most: 1, by: {clas: car}": "by: no slice is named 'clas'; did you mean class?",
    "metric: unknown_s, at_most: 1, by: {class: pedestrain}": "by.class: no class is named 'pedestrain'; did you mean",
    "metric: unknown_s, at_most: 1, by: {began: late}": "by.began: no way to begin is named 'late'",
    "metric: unknown_s, at_most: 1, objects: {classes: [pedestrain]}": "objects.classes[0]: expected one of",
    "metric: unknown_s, at_most: 1, objects: {}": "objects: expected one of `classes: [vru]` and `ids: [7, 12]`",
    "metric: unknown_s, at_most: 1, confidence: 95": "confidence: expected at most 0.9999, found 95",
    "metric: unknown_s, at_most: 1, population: all": "population: expected 'such_traffic' or 'these_logs', found",
    "metric: unknown_s, at_most: 1, passes_when: met": "passes_when: expected 'shown' or 'not_refuted', found 'met'",
    "metric: unknown_s, at_most: 1, quantile: 0.9": "quantile: unknown key",
}  # fmt: skip


@pytest.mark.parametrize("keys", REFUSED)
def test_what_is_refused_is_said_with_line_and_key(tmp_path: Path, keys: str) -> None:
    found = problems_of(tmp_path, f"# limits\ncriteria:\n  known soon: {{{keys}}}\n")
    assert len(found) == 1, found
    assert found[0].startswith("3: criteria.known soon")
    assert REFUSED[keys] in found[0]


def test_all_problems_at_once(tmp_path: Path) -> None:
    text = "criteria:\n  a: {metric: ttd_p96_s, at_most: 1}\n  b: {metric: unknown_s}\nruns: 3\n"
    assert sorted(line.partition(":")[0] for line in problems_of(tmp_path, text)) == ["2", "3", "4"]


def test_a_file_without_criteria(tmp_path: Path) -> None:
    missing = ["1: criteria: missing", "1: limits: unknown key; known here: criteria"]
    assert problems_of(tmp_path, "limits: {}\n") == missing
    assert "expected at least one, found none" in problems_of(tmp_path, "criteria: {}\n")[0]
    (line,) = problems_of(tmp_path, "")
    assert "expected keys and values" in line


def test_before_and_truth() -> None:
    known = ["GT", "gnn", "late"]
    units = {"GT": "truth", "gnn": "all", "late": "all"}
    configurations = {name: Configuration(units=of) for name, of in units.items()}
    criterion = Criterion(metric="unknown_s", at_most=0.1, against="before")
    assert criterion.find_against("gnn", known) == ("gnn", True)
    assert choose_judged(criterion, configurations) == ["gnn", "late"]
    other = criterion.model_copy(update={"against": "late@before"})
    assert other.find_against("gnn", known) == ("late", True)
    own = criterion.model_copy(update={"against": "late"})
    assert own.find_against("gnn", known) == ("late", False)
    assert choose_judged(own, configurations) == ["gnn"]
    assert choose_judged(own.model_copy(update={"configurations": ("GT",)}), configurations) == ["GT"]


def test_a_bound_has_to_be_shown_and_a_difference_refuted() -> None:
    bound = Criterion(metric="unknown_s", at_least=0)
    assert (bound.passes_unless_refuted, bound.bound, bound.direction) == (False, 0.0, "at_least")
    difference = Criterion(metric="unknown_s", at_most=0.1, against="gnn")
    assert difference.passes_unless_refuted
    assert not difference.model_copy(update={"passes_when": "shown"}).passes_unless_refuted


def test_what_no_number_of_runs_decides_is_noted() -> None:
    asked = {"a": Criterion(metric="unknown_s", at_most=1), "b": Criterion(metric="unknown_s", at_most=1)}
    (note,) = note_undecidable(asked, [4], Measure())
    assert note.startswith("criteria a, b: such traffic is not measured by 4 objects of one drive, fewer than 5")
    assert "by 2 logs, fewer than 3" in next(note_undecidable(asked, [9, 0, 9], Measure()))
    for counted in ([5], [1, 1, 1]):
        assert not list(note_undecidable(asked, counted, Measure()))
    of_runs = {"a": Criterion(metric="unknown_s", at_most=1, population="these_logs")}
    assert not list(note_undecidable(of_runs, [1], Measure()))


def test_what_so_few_cannot_show_is_noted() -> None:
    """Thirteen objects, all at once: a share of .95 takes 72 of them, a mean of 1 s up to 5 s 17."""
    asked = {
        "share": Criterion(metric="detected_share", at_least=0.95),
        "mean": Criterion(metric="ttd_rmst_s", at_most=1.0),
        "median": Criterion(metric="ttd_median_s", at_most=1.0),
        "paired": Criterion(metric="ttd_rmst_s", at_most=0.1, against="ideal"),
    }
    assert list(note_undecidable(asked, [13], Measure())) == [
        "criteria share: 13 objects cannot show detected_share ≥ 0.95, however good; at least 72 can",
        "criteria mean: 13 objects cannot show ttd_rmst_s ≤ 1, however good; at least 17 can, or a horizon_s of 4",
    ]
    once = {"share": Criterion(metric="detected_share", at_least=0.95, weigh="drives")}
    assert "3 logs cannot show detected_share ≥ 0.95, however good; at least 72 can" in next(
        note_undecidable(once, [20, 20, 20], Measure())
    )


def test_only_figures_of_detections_weigh_drives_alike(tmp_path: Path) -> None:
    (problem,) = problems_of(
        tmp_path, "criteria:\n  far: {metric: position_rmse_m, at_most: 1, weigh: drives}\n"
    )  # fmt: skip
    assert "2: criteria.far.weigh: expected `weigh` with a metric of detections, found position_rmse_m" in problem


def test_conditions_of_fail_on() -> None:
    found = parse_fail_on(["ttd_rmst_s > 0.05", " pass_share<=-1e-2 "], "before", ["gnn"])
    common = {"against": "before", "configurations": ["gnn"]}
    assert found == {
        "ttd_rmst_s > 0.05": {"metric": "ttd_rmst_s", "at_most": 0.05} | common,
        "pass_share<=-1e-2": {"metric": "pass_share", "at_least": -0.01} | common,
    }
    for wrong in ("ttd_rmst_s", "> 3", "a = 3", "a > b > 3", "a > 1.2.3"):
        with pytest.raises(InputError, match="--fail-on: expected a metric and a bound"):
            parse_fail_on([wrong], "before", None)


def test_an_experiment_keeps_its_criteria() -> None:
    given = {"soon": {"metric": "unknown_s", "at_most": 0.5, "each": "class"}}
    experiment = cr.Experiment(
        version=1, logs=("a.mcap",), configurations={"GT": Configuration(units="truth")}, criteria=given
    )
    again = cr.Experiment.model_validate(experiment.as_written())
    assert again.criteria == experiment.criteria
    assert "criteria" not in experiment.model_copy(update={"criteria": {}}).as_written()
