"""What a run says on a screen: the table in a person's words, and what makes it worthless above it."""

from __future__ import annotations

from dataclasses import replace as with_fields
from pathlib import Path
from typing import Any

import pytest

import copem_replay as cr
from copem_replay.core.errors import wrap_line
from copem_replay.results.compare import comparison_text
from copem_replay.results.decision import decide
from copem_replay.results.read import Results
from copem_replay.results.screen import choose_notes, format_comparison, format_screen
from copem_replay.results.versions import tell_change
from tests.helpers.recordings import Obj, pedestrian, write_recording

PEM = {"p": [{"detection": {"kind": "constant", "probability": 0.6}}]}
UNITS = {"ego": {"on": "ego", "height_m": 1.8, "pem": "p"}, "mast": {"at": [30.0, 9.0], "height_m": 6.0, "pem": "p"}}
CONFIGURATIONS: dict[str, Any] = {
    "GT": {"units": "truth"},
    "ideal": {"units": "all"},
    "same": {"units": "all"},
    "alone": {"units": ["ego"], "fusion": {"kind": "gnn"}},
    "late": {"units": "all", "latency_s": 0.5, "fusion": {"kind": "gnn"}},
}


def replay(folder: Path, walkers: int, *, logs: int = 1, **more: Any) -> Results:
    """The ego comes nearer to some pedestrians, four metres apart."""
    for k in range(logs):
        frames = [
            (0.1 * t, [Obj(id=1, x=0.8 * t), *(pedestrian(id=2 + w, x=62.0 + 4 * w, y=6.0) for w in range(walkers))])
            for t in range(60)
        ]
        write_recording(folder / f"drive{k}.mcap", frames, host=1)
    plan = {
        "version": 1, "runs": 5, "pems": PEM, "units": UNITS, "configurations": CONFIGURATIONS, "show": None,
        "measure": {"onset": {"kind": "in_range", "range_m": 60}, "horizon_s": 1},
    }  # fmt: skip
    return cr.run(plan | more, [folder / f"drive{k}.mcap" for k in range(logs)])


def screen(results: Results) -> list[str]:
    return format_screen(results, results.summary, decide(results).best)[0]


def test_fits_and_says_what_a_person_says(tmp_path: Path) -> None:
    results = replay(tmp_path, 5)
    lines = screen(results)
    assert lines[:2] == ["drive0: 5 objects count, 5 runs", ""]
    assert lines[2].split("  ")[-1] == "at distance, m"
    assert lines[3].split() == ["mean", "median", "95", "%", "by", "median", "detected"]
    assert [line.split("  ")[0] for line in lines[4:7]] == ["ideal, same", "alone", "late"]
    row = results.summary.set_index("configuration").loc["late"]
    times = [f"{row[name]:.2f}" for name in ("ttd_rmst_s", "ttd_median_s", "ttd_p95_s")]
    assert lines[6].split()[1:5] == [*times, f"{row['dad_median_m']:.1f}"]
    assert max(map(len, lines)) <= 80
    assert len(lines) <= 24


def test_rows_of_the_best_are_marked(tmp_path: Path) -> None:
    results = replay(tmp_path, 5)
    lines, marked = format_screen(results, results.summary, ["same"])
    assert marked == [lines[4]]


@pytest.mark.parametrize(
    ("walkers", "logs", "said"),
    [
        (1, 1, "! One object says nothing about other traffic; `check` says who else is there."),
        (3, 1, "! 3 objects of one drive are too few for an interval."),
        (3, 2, "! Two logs tell no interval; three do."),
    ],
)
def test_what_makes_it_worthless_stands_above(tmp_path: Path, walkers: int, logs: int, said: str) -> None:
    lines = screen(replay(tmp_path, walkers, logs=logs))
    assert lines[1] == said


def test_three_logs_need_no_warning(tmp_path: Path) -> None:
    lines = screen(replay(tmp_path, 2, logs=3))
    assert lines[:2] == ["3 logs: 6 objects count, 5 runs", ""]


def test_who_does_not_count_is_said(tmp_path: Path) -> None:
    measure = {"onset": {"kind": "in_range", "range_m": 72}, "horizon_s": 1}
    assert screen(replay(tmp_path, 5, measure=measure))[0] == (
        "drive0: 2 objects count, 5 runs; not 3 more there at the start"
    )


def test_a_horizon_that_few_last_is_said(tmp_path: Path) -> None:
    results = replay(tmp_path, 5, measure={"onset": {"kind": "in_range", "range_m": 60}, "horizon_s": 50})
    used_s = results.provenance.horizon_used_s
    assert used_s < 50
    assert f"Too few are in range for 50 s: means are up to {used_s:.3g} s." in screen(results)


def test_of_nobody_there_is_no_table(tmp_path: Path) -> None:
    results = replay(tmp_path, 2, measure={"onset": {"kind": "in_range", "range_m": 1}})
    assert screen(results) == ["drive0: 0 objects count, 5 runs"]


def test_eighteen_configurations_fit(tmp_path: Path) -> None:
    many = {"GT": {"units": "truth"}} | {
        f"late {k}": {"units": ["ego"], "latency_s": 0.1 * k, "fusion": {"kind": "gnn"}} for k in range(18)
    }
    lines = screen(replay(tmp_path, 5, configurations=many))
    assert "and 6 more: summary.csv" in lines
    assert len(lines) <= 24


def test_who_lists_nobody_is_said_in_a_line(tmp_path: Path) -> None:
    """Ghosts in half of the lists of the ego, a list every 0.1 s."""
    haunted = {"p": {"couples": PEM["p"], "ghosts": [{"in_list": 0.5, "where": {"kind": "field", "range_m": [5, 40]}}]}}
    results = replay(tmp_path, 5, pems=haunted)
    rate = results.summary.set_index("configuration")["false_positives_per_min"]
    assert rate["alone"] > 100 > rate["ideal"] == 0
    (line,) = (line for line in screen(results) if line.startswith("False per minute: "))
    assert len(line) <= 80
    worst = rate.idxmax()
    assert line.startswith(f"False per minute: {worst} {rate[worst]:.0f}")
    lasts_s = results.frame("false_tracks.parquet")["lasts_s"].max()
    assert line.endswith(f"; none lasts over {lasts_s:.2g} s.")
    assert not any("ideal" in name for name in line.split(", "))
    (tmp_path / "sure").mkdir()
    assert not [line for line in screen(replay(tmp_path / "sure", 2)) if line.startswith("False")]


def test_what_the_intervals_of_driving_are_over(tmp_path: Path) -> None:
    """Of one drive they are over its runs, whatever objects there are."""
    braking = {"driver": {"kind": "constant_deceleration", "a_max_mps2": 8.0}}
    compared = cr.compare(replay(tmp_path, 5, braking=braking))
    rows = compared.table["metric"] == "needless_brake_share"
    table = compared.table.copy()
    table.loc[rows, ["low", "high", "clusters"]] = [0.1, 0.2, 5]
    table.loc[rows, "interval_over"] = "runs"
    said = comparison_text(with_fields(compared, table=table))
    over = " ".join(said.split()).partition("[95 %]: over ")[2]
    assert over.startswith("5 objects of this drive: ")
    assert "5 runs of the driving: how far other draws" in over
    assert "of this one object" not in over


def test_newer_results_fit_though_all_changed(tmp_path: Path) -> None:
    """Eleven configurations, each later by another time: the five that changed most, and how many others did."""
    late = {f"late {k}": {"units": ["ego"], "latency_s": 0.1 * k, "fusion": {"kind": "gnn"}} for k in range(11)}
    for name, probability in (("old", 0.9), ("new", 0.2)):
        (tmp_path / name).mkdir()
        sure = {"p": [{"detection": {"kind": "constant", "probability": probability}}]}
        replay(tmp_path / name, 6, configurations=late, pems=sure).save(tmp_path / name / name)
    compared = cr.compare([tmp_path / "old/old", tmp_path / "new/new"])
    change = tell_change(compared)
    lines, _ = format_comparison(compared, change.differing)
    shown = [line for line in lines if line.startswith("late")]
    assert len(shown) == 5
    assert "and 6 more: --explain" in lines
    both = compared.overall[compared.overall["metric"] == "ttd_rmst_s"].set_index("configuration")["difference"]
    assert shown[0].startswith(both.abs().idxmax()) or shown[0].split("  ")[0] in change.differing
    wrapped = [part for line in [change.head, *lines, "", change.sentence] for part in wrap_line(line, 80)]
    assert len(wrapped) <= 21, "with three lines of notes"


def test_a_comparison_says_sooner_and_later(tmp_path: Path) -> None:
    results = replay(tmp_path, 5)
    compared = cr.compare(results)
    lines, marked = format_comparison(compared, ["alone"])
    assert lines[0] == "against ideal (by its name); --baseline names another"
    assert lines[1].startswith("[95 %]: over 5 objects of this drive")
    table, rest = "\n".join(lines).partition("\n\n")[2].split("\n\n")[0].split("\n"), lines[lines.index("") + 1 :]
    assert table[0].split()[0] == "known"
    assert [line.split("  ")[0] for line in table[1:]] == ["same", "alone", "late"], "the truth is none"
    assert table[1].split("  ")[1].strip().startswith("as soon")
    row = compared.overall.set_index(["configuration", "metric"]).loc[("late", "ttd_rmst_s")]
    assert f"{row['difference']:.2f} s later" in table[3]
    assert max(map(len, lines[: lines.index("")])) < 200
    assert max(map(len, rest)) <= 80
    assert marked == [line for line in rest if line.startswith("alone")]
    starred = any(" *" in line for line in rest)
    assert starred == any(line.startswith("*: ") for line in lines), "what a star is, is said where there is one"


def test_figures_that_do_not_fit_side_by_side_stand_below(tmp_path: Path) -> None:
    compared = cr.compare(replay(tmp_path, 5, configurations={"ideal": {"units": "all"}, "a" * 26: {"units": "all"}}))
    differ = {"ttd_rmst_s": 0.5, "position_rmse_held_m": 0.125, "false_positives_per_min": 1250.0}
    table = compared.table.assign(difference=compared.table["metric"].map(differ).fillna(0.0), interval_over="logs")
    table = table.assign(low=table["difference"] * 0.9, high=table["difference"] * 1.1, star="*")
    lines, _ = format_comparison(with_fields(compared, table=table), [])
    assert lines[-5:] == [
        " " * 28 + "known".ljust(29) + "position error, m",
        "a" * 26 + "  0.50 s later [0.45, 0.55] *  +0.125 [0.113, 0.138] *",
        "",
        " " * 28 + "false per minute",
        "a" * 26 + "  +1250 [1125, 1375] *",
    ]


def test_what_the_intervals_of_each_figure_are_over(tmp_path: Path) -> None:
    """Accuracy is of all objects, times of those that count."""
    compared = cr.compare(replay(tmp_path, 5, configurations={"ideal": {"units": "all"}, "b": {"units": "all"}}))
    clusters = {"ttd_rmst_s": 6, "position_rmse_held_m": 9, "false_positives_per_min": 9}
    table = compared.table[compared.table["metric"].isin(list(clusters))]
    table = table.assign(difference=0.5, low=0.25, high=0.75, star="", interval_over="objects")
    told = with_fields(compared, table=table.assign(clusters=table["metric"].map(clusters)))
    assert format_comparison(told, [])[0][1:3] == [
        "[95 %] of known: over 6 objects of this drive: how far other objects of this drive may differ; nothing about "
        "other drives",
        "[95 %] of position error and false per minute: over 9 objects of this drive",
    ]


def test_notes_on_figures_that_are_not_shown_are_left_out() -> None:
    kept = ["no interval of ttd_rmst_s, ttd_rmst_s_equal_ghosts: 2 logs", "drive.mcap has 2 logs"]
    assert choose_notes([*kept, "gnn: no ttd_rmst_s_equal_ghosts: one value"]) == kept


def test_a_comparison_with_an_equal_has_no_table(tmp_path: Path) -> None:
    results = replay(tmp_path, 5, configurations={"ideal": {"units": "all"}, "same": {"units": "all"}})
    assert format_comparison(cr.compare(results), [])[0][-1] == "nothing differs"
