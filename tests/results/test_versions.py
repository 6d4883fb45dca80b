"""Newer results held against older ones, configuration by configuration: differences by hand, and the one line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace as with_fields
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from copem_replay.core.errors import InputError
from copem_replay.results.compare import Comparison, compare_folders, comparison_text
from copem_replay.results.screen import format_comparison
from copem_replay.results.versions import tell_change
from tests.helpers.compare_folders import UNREMARKABLE, Row, limits_of, row, seen, write_folder

Times = Mapping[str, Sequence[float | None]]
OLD: Times = {
    "GT": [0.0] * 5, "ideal": [0.1, 0.2, 0.3, 0.4, 0.5], "gnn": [1.0, 2.0, 3.0, 4.0, 5.0], "late": [0.6, 1, 2, 3, 4],
}  # fmt: skip
LATER = [0.2, 0.3, 0.4, 0.2, 0.4]
NEW: Times = {
    **OLD,
    "gnn": [0.5, 1.5, 2.5, 3.5, 4.5],
    "late": [a + b for a, b in zip([0.6, 1, 2, 3, 4], LATER, strict=True)],
}
"""`gnn` knows each object half a second sooner; `late` 0.2, 0.3, 0.4, 0.2 and 0.4 s later."""
TRUTH = {"GT": {"truth": True}}


def rows(times: Times, runs: int = 1) -> list[Row]:
    """An object for each time, known by each configuration then."""
    return [
        row(name, time_s, 30.0, object_id=str(k), run=run)
        for name, of in times.items()
        for k, time_s in enumerate(of)
        for run in range(runs)
    ]


def compared(tmp_path: Path, *times: Times, **options: Any) -> Comparison:
    names = ("old", "new", "newest")
    return compare_folders(
        [write_folder(tmp_path / name, rows(of), facts=TRUTH) for name, of in zip(names, times, strict=False)],
        **options,
    )


def test_each_is_held_against_itself(tmp_path: Path) -> None:
    found = compared(tmp_path, OLD, NEW)
    assert (found.baseline, found.newer, found.configurations) == ("old", ("new",), ("GT", "ideal", "gnn", "late"))
    assert found.unchanged == ("GT", "ideal")
    times = found.overall[found.overall["metric"] == "ttd_rmst_s"].set_index("configuration")
    assert times["difference"].to_dict() == pytest.approx({"GT": 0, "ideal": 0, "gnn": -0.5, "late": 0.3})
    assert times["baseline"].tolist() == ["old:GT", "old:ideal", "old:gnn", "old:late"]
    assert times["baseline_value"].to_dict() == pytest.approx({"GT": 0, "ideal": 0.3, "gnn": 3, "late": 2.12})
    expected = limits_of([str(k) for k in range(5)], lambda names: sum(LATER[int(k)] for k in names) / len(names))
    assert (times.loc["late", "low"], times.loc["late", "high"]) == pytest.approx(expected)


def test_the_line_of_a_build_says_what_is_worse_and_what_is_better(tmp_path: Path) -> None:
    found = compared(tmp_path, OLD, NEW, metrics=["ttd_rmst_s"])
    change = tell_change(found)
    assert change.head == "new against old: better and worse"
    assert change.sentence == (
        "new against old: worse: late 0.30 s later [0.18, 0.42]; better: gnn 0.50 s sooner (all alike); 1 unchanged"
    )
    assert change.differing == ("late", "gnn")
    lines, marked = format_comparison(found, change.differing)
    assert lines[0] == "each minus itself in old; every figure: --explain"
    assert lines[-4:] == [
        "      known", "gnn   0.50 s sooner (all alike)", "late  0.30 s later [0.18, 0.42] *", "ideal: unchanged"
    ]  # fmt: skip
    assert marked == lines[-3:-1]
    assert max(map(len, lines[2:])) <= 80


def test_of_the_same_results_nothing_changed_and_nothing_has_a_star(tmp_path: Path) -> None:
    found = compared(tmp_path, OLD, OLD)
    assert found.unchanged == found.configurations
    assert (found.overall["difference"].dropna() == 0).all()
    assert found.overall["star"].isna().all()
    assert tell_change(found)[:2] == (
        "new against old: nothing changed",
        "new against old: nothing changed: ideal, gnn, late",
    )
    assert format_comparison(found, []) == (["ideal, gnn, late: unchanged"], [])
    assert comparison_text(found).splitlines()[1] == "unchanged: GT, ideal, gnn, late"


def test_rows_that_change_places_are_no_same_rows(tmp_path: Path) -> None:
    """One object is known a second later and another one as much sooner: the mean is the same."""
    found = compared(tmp_path, OLD, {**OLD, "gnn": [2.0, 1.0, 3.0, 4.0, 5.0]})
    assert "gnn" not in found.unchanged
    assert tell_change(found).sentence == "new against old: no difference is shown: gnn; 2 unchanged"


def test_what_cannot_matter_is_no_difference(tmp_path: Path) -> None:
    """0.01 s later, each: shown as 0.01 s, but less than half of the time between two lists."""
    found = compared(tmp_path, OLD, {**OLD, "gnn": [time_s + 0.01 for time_s in [1.0, 2.0, 3.0, 4.0, 5.0]]})
    assert tell_change(found).head == "new against old: no difference is shown"
    matters = with_fields(found, matters={"ttd_rmst_s": 0.005})
    assert tell_change(matters).head == "new against old: worse", "as the user says what matters"


def test_stars_are_held_over_what_can_differ(tmp_path: Path) -> None:
    """Forty configurations of which nothing is asked take no star from the one that changed."""
    many = {f"same {k}": OLD["ideal"] for k in range(40)}
    alone, among = (
        compared(tmp_path / name, {"late": OLD["late"], **of}, {"late": NEW["late"], **of})
        for name, of in (("alone", {}), ("among", many))
    )
    kept = among.overall[among.overall["configuration"] == "late"]
    assert kept["star"].tolist() == alone.overall["star"].tolist()
    assert (alone.overall["star"] == "*").any()
    assert comparison_text(among).count("differences of this table") == 1
    assert tell_change(among).sentence.endswith("; 40 unchanged")
    assert format_comparison(among, [])[0][-1] == (
        "same 0, same 1, same 2, same 3, same 4, same 5, same 6 and 33 more: unchanged"
    )


def test_an_error_that_grows_is_worse_though_all_is_known_as_soon(tmp_path: Path) -> None:
    """Errors of 1 m become 1.5 m, of each object: RMSE over the pairs of object and frame."""
    folders = [
        write_folder(tmp_path / name, [seen("gnn", [error_m] * 4, [1.0] * 4, object_id=str(k)) for k in range(5)])
        for name, error_m in (("old", 1.0), ("new", 1.5))
    ]
    found = compare_folders(folders)
    assert found.unchanged == ()
    assert tell_change(found).sentence == "new against old: worse: gnn position error +0.5 m (all alike)"


def test_without_an_interval_it_is_said_that_it_is_of_these_objects_alone(tmp_path: Path) -> None:
    found = compared(tmp_path, {"gnn": [1.0, 2.0]}, {"gnn": [1.5, 2.25]})
    assert tell_change(found)[:2] == (
        "new against old: no interval",
        "new against old: without an interval, on these objects alone: gnn 0.38 s later",
    )


def test_configurations_that_one_folder_lacks_are_named(tmp_path: Path) -> None:
    found = compared(tmp_path, {"a": [1.0], "b": [1.0]}, {"b": [1.0], "c": [1.0]})
    assert found.configurations == ("b",)
    assert [note for note in found.notes if note.startswith("only in")] == [
        f"only in {tmp_path}/old, so not compared: a", f"only in {tmp_path}/new, so not compared: c",
    ]  # fmt: skip


def test_folders_without_a_common_configuration_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        compared(tmp_path, {"a": [1.0], "b": [1.0]}, {"c": [1.0]})
    assert caught.value.problems == (
        f"compare: expected a configuration of {tmp_path}/old (a, b) in a later folder, found c; --baseline NAME holds "
        "all against one",
    )


def test_a_name_means_it_in_both(tmp_path: Path) -> None:
    found = compared(tmp_path, OLD, NEW, configurations=["late"])
    assert found.configurations == ("late",)
    assert not any(note.startswith("only in") for note in found.notes)
    with pytest.raises(InputError, match="no configuration is named 'lat'; did you mean late"):
        compared(tmp_path / "again", OLD, NEW, configurations=["lat"])


def test_more_runs_in_the_newer_one_are_left_out(tmp_path: Path) -> None:
    folders = [write_folder(tmp_path / name, rows(OLD, runs)) for name, runs in (("old", 2), ("new", 3))]
    found = compare_folders(folders)
    assert set(found.unchanged) == set(OLD)
    assert any("other numbers of runs" in note and "the first 2 are compared" in note for note in found.notes)


@pytest.mark.parametrize(
    ("more", "said"), [({"seed": 2}, "seed: expected 1 as in"), ({"logs": {"a": "other"}}, "expected the logs of")]
)
def test_other_draws_and_other_logs_are_refused(tmp_path: Path, more: dict[str, Any], said: str) -> None:
    folders = [write_folder(tmp_path / "old", rows(OLD)), write_folder(tmp_path / "new", rows(OLD), **more)]
    with pytest.raises(InputError, match=said):
        compare_folders(folders)


def test_several_newer_ones_are_each_held_against_the_first(tmp_path: Path) -> None:
    found = compared(tmp_path, {"late": OLD["late"]}, {"late": NEW["late"]}, {"late": OLD["late"]})
    assert (found.newer, found.configurations) == (("new", "newest"), ("new:late", "newest:late"))
    assert found.unchanged == ("newest:late",)
    assert tell_change(found).head == "new, newest against old: worse"


def test_no_other_configuration_is_a_baseline(tmp_path: Path) -> None:
    """`gnn` has an ideal in its experiment: here it is held against itself all the same, as is a stack's output."""
    units = {"ego": {"on": "ego", "pem": "p"}, "box": {"recorded": {"topic": "box"}}}
    configurations = {
        "gnn": {"units": ["ego"], "fusion": {"kind": "gnn"}}, "ideal": {"units": ["ego"]},
        "stack": {"recorded": {"topic": "out"}, "inputs": ["box"]}, "stack:ideal": {"units": ["box"]},
    }  # fmt: skip
    experiment = {"units": units, "configurations": configurations}
    times = {name: [1.0, 2.0] for name in configurations}
    folders = [write_folder(tmp_path / name, rows(times), experiment=experiment) for name in ("old", "new")]
    found = compare_folders(folders)
    assert found.overall["baseline"].eq("old:" + found.overall["configuration"]).all()
    assert not any("regret" in note for note in found.notes)
    assert isinstance(found.table, pd.DataFrame)


def test_what_differs_is_told_by_its_keys(tmp_path: Path) -> None:
    """A key within a couple of a model; of another kind of fusion its kind alone; a link."""

    def experiment(range_m: int, fusion: dict[str, Any], latency_s: float) -> dict[str, Any]:
        seen_to = {"when": {"range_m": [0, range_m]}, "detection": {"kind": "visible_share"}}
        return {
            "pems": {"p": [seen_to]}, "links": {"radio": {"latency": latency_s}},
            "configurations": {"x": {"units": "truth", "fusion": fusion}},
        }  # fmt: skip

    ways = experiment(80, {"kind": "gnn", "gate": 0.9}, 0.1), experiment(40, {"kind": "nms", "radius_m": 2}, 0.2)
    folders = [
        write_folder(tmp_path / name, rows({"x": [1.0]}), experiment=of, configurations={"x": UNREMARKABLE})
        for name, of in zip(("old", "new"), ways, strict=True)
    ]
    assert f"{folders[1]} differs from {folders[0]} in pems.p.0.when.range_m ([0, 80], [0, 40]); " in found_in(folders)
    assert "links.radio.latency (0.1, 0.2); configurations.x.fusion.kind (gnn, nms)" in found_in(folders)
    assert "gate" not in found_in(folders)
    assert "radius_m" not in found_in(folders)


def found_in(folders: Sequence[Path]) -> str:
    return "\n".join(compare_folders(folders).notes)
