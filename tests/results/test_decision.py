"""The decision in one sentence, from comparisons and verdicts written down by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

import copem_replay as cr
from copem_replay.results.compare import Comparison
from copem_replay.results.decision import Decision, decide, decide_compared, describe_verdicts, tell_what_helps
from copem_replay.results.table_files import LogRows
from copem_replay.results.verdicts import MET, NOT_MET, UNDECIDED, Judgement, Verdict
from tests.helpers.recordings import Obj, pedestrian, write_recording
from tests.helpers.scenes import experiment

Row = tuple[str, float, float, float | None, float | None]
"""Configuration, its value, that of the baseline, and the limits of the difference."""


def compared(metric: str, *rows: Row, baseline: str = "PEM", truths: tuple[str, ...] = ()) -> Comparison:
    names = ["configuration", "value", "baseline_value", "low", "high"]
    table = pd.DataFrame(rows, columns=names).astype({"low": float, "high": float})
    table = table.assign(metric=metric, log="all", difference=table["value"] - table["baseline_value"])
    table["interval_over"] = [None if math.isnan(low) else "logs" for low in table["low"]]
    return Comparison(table, baseline, None, tuple(row[0] for row in rows), 5.0, None, (), truths=truths)


def cooperating(**latencies_s: float) -> cr.Experiment:
    """PEM is the ego alone, the others have the mast, too, each with its latency."""
    late = {name: {"units": "all", "latency_s": latency_s} for name, latency_s in latencies_s.items()}
    plain = {
        "version": 1,
        "logs": ["drive.mcap"],
        "pems": {"sure": [{"detection": {"kind": "constant", "probability": 1.0}}]},
        "units": {
            "ego": {"on": "ego", "height_m": 1.8, "pem": "sure"},
            "mast": {"at": [0, 0], "height_m": 5.0, "pem": "sure"},
        },
        "configurations": {"PEM": {"units": ["ego"]}, **late},
    }
    return cr.Experiment.model_validate(plain)


class TestLatencies:
    def test_up_to_which_latency_cooperation_helps(self) -> None:
        found = decide_compared(
            compared(
                "pass_share",
                ("co0", 0.996, 0.844, 0.1, 0.2),
                ("co1", 0.64, 0.844, -0.25, -0.15),
                ("co05", 0.96, 0.844, 0.05, 0.15),
            ),
            cooperating(co0=0.0, co05=0.5, co1=1.0),
        )
        assert found.sentence == (
            "Up to 0.5 s of latency cooperation helps: 96 % of conflicts pass against 84 % with PEM alone, by 11.6 "
            "percentage points [5, 15]; from 1 s of latency on cooperation is worse than PEM alone: 64 %, by 20.4 "
            "percentage points [15, 25]."
        )
        assert found.best == ("co0",)

    def test_with_one_in_between_that_cannot_be_told(self) -> None:
        found = decide_compared(
            compared("ttd_rmst_s", ("co0", 0.0, 0.7, -0.8, -0.6), ("co1", 0.9, 0.7, -0.1, 0.5)),
            cooperating(co0=0.0, co1=1.0),
        )
        assert found.sentence == (
            "Without latency cooperation helps: an object is known after 0.00 s on average against 0.70 s with PEM "
            "alone, by 0.7 s [0.6, 0.8]; up to 1 s of latency no difference to PEM alone is shown: 0.90 s, +0.2 s "
            "[-0.1, 0.5]."
        )

    def test_out_of_their_order_each_is_named(self) -> None:
        found = decide_compared(
            compared("ttd_rmst_s", ("co0", 0.9, 0.7, 0.1, 0.3), ("co1", 0.1, 0.7, -0.7, -0.5)),
            cooperating(co0=0.0, co1=1.0),
        )
        assert found.sentence == (
            "Sooner than PEM (an object is known after 0.70 s on average): co1 by 0.6 s [0.5, 0.7]; later than PEM: "
            "co0 by 0.2 s [0.1, 0.3]."
        )


class TestGroups:
    def test_better_alike_and_worse(self) -> None:
        found = decide_compared(
            compared(
                "pass_share",
                ("GT", 1.0, 0.5, 0.4, 0.6),
                ("a", 0.9, 0.5, 0.3, 0.5),
                ("b", 0.6, 0.5, -0.1, 0.3),
                ("c", 0.2, 0.5, -0.4, -0.2),
                truths=("GT",),
            )
        )
        assert found == Decision(
            "Better than PEM (50 % of conflicts pass): a by 40 percentage points [30, 50]; worse than PEM: c by 30 "
            "percentage points [20, 40]; no difference to PEM is shown: b +10 percentage points [-10, 30].",
            ("a",),
        )

    @pytest.mark.parametrize(("apart_s", "crowned"), [(0.0002, False), (0.049, False), (0.051, True)])
    def test_nobody_is_crowned_by_a_hair(self, apart_s: float, crowned: bool) -> None:
        """All intervals exclude 0."""
        found = decide_compared(compared("ttd_rmst_s", ("a", 1 - apart_s, 1.0, -apart_s - 1e-5, -apart_s + 1e-5)))
        assert found.sentence.startswith("Sooner than PEM" if crowned else "Apart from PEM (an object is known")
        assert found.best == (("a",) if crowned else ("a", "PEM"))

    def test_the_best_has_a_better_mean_than_all_and_no_interval_that_excludes_0(self) -> None:
        found = decide_compared(compared("ttd_rmst_s", ("a", 0.5, 1.0, -1.2, 0.2), ("b", 2.0, 1.0, 0.5, 1.5)))
        assert found.sentence == (
            "Later than PEM (an object is known after 1.00 s on average): b by 1 s [0.5, 1.5]; no difference to PEM is "
            "shown: a -0.5 s [-1.2, 0.2]."
        )
        assert set(found.best) == {"a", "PEM"}

    def test_without_intervals_it_says_so(self) -> None:
        found = decide_compared(compared("pass_share", ("a", 1.0, 0.0, None, None)))
        assert found.sentence == (
            "No interval, so nothing is shown beyond these very objects, against PEM (0 % of conflicts pass): a +100 "
            "percentage points."
        )

    def test_each_is_held_against_the_rows_of_its_own_pair(self) -> None:
        """Of b half of the logs have no units: the baseline is slower there, and no mean of all rows is compared."""
        found = decide_compared(compared("ttd_rmst_s", ("a", 0.5, 1.0, -0.6, -0.4), ("b", 1.2, 1.5, -0.4, -0.2)))
        assert found.sentence == "Sooner than PEM: a by 0.5 s [0.4, 0.6], b by 0.3 s [0.2, 0.4]."
        assert found.best == ("a",)

    def test_who_is_the_same_in_every_pair_is_said_to_be(self) -> None:
        found = decide_compared(compared("ttd_rmst_s", ("a", 1.0, 1.0, None, None), ("b", 1.0, 1.0, -0.1, 0.1)))
        assert found.sentence == (
            "The same as PEM (an object is known after 1.00 s on average): a; no difference to PEM is shown: b 0 s "
            "[-0.1, 0.1]."
        )

    def test_equal_figures_share_a_number_and_many_are_counted(self) -> None:
        rows = [(name, 1.0, 0.5, 0.4, 0.6) for name in "abcdef"]
        found = decide_compared(compared("pass_share", *rows))
        assert found.sentence == (
            "Better than PEM (50 % of conflicts pass): a, b, c and d by 50 percentage points [40, 60] and 2 more."
        )

    @pytest.mark.parametrize(
        ("share", "said"), [(0.994, "99 %"), (0.9951, "99.5 %"), (0.9996, "> 99.9 %"), (0.0004, "< 0.1 %")]
    )
    def test_all_and_none_are_all_and_none(self, share: float, said: str) -> None:
        low, high = sorted([0.5 - share - 0.01, 0.5 - share + 0.01])
        found = decide_compared(compared("pass_share", ("a", 0.5, share, low, high)))
        assert f"than PEM ({said} of conflicts pass)" in found.sentence


def verdict(name: str, word: str) -> Verdict:
    return Verdict(
        name, "PEM", "", "ttd_rmst_s", None, "at_most", 0.5, 0.95, "these_logs", 0.7, 0.6, 0.8, "jackknife", "logs", 5,
        100, word, word == MET, "",
    )  # fmt: skip


class TestBrakingForNothing:
    """`a` and `b` know sooner than PEM, both shown; who brakes for nothing is not among the better ones."""

    SOONER: tuple[Row, ...] = (("a", 0.5, 1.0, -0.6, -0.4), ("b", 0.7, 1.0, -0.4, -0.2))

    def decided(self, *shares: Row) -> Decision:
        times, share = compared("ttd_rmst_s", *self.SOONER), compared("needless_brake_share", *shares)
        return decide_compared(replace(times, table=pd.concat([times.table, share.table], ignore_index=True)))

    def test_who_brakes_for_nothing_is_sooner_at_a_price(self) -> None:
        assert self.decided(("a", 0.25, 0.0, 0.2, 0.3), ("b", 0.0, 0.0, 0.0, 0.0)) == Decision(
            "Sooner than PEM (an object is known after 1.00 s on average): b by 0.3 s [0.2, 0.4]; sooner than PEM, but "
            "braking for nothing: a by 0.5 s [0.4, 0.6]. But with a the driver brakes for nothing in 25 % of the "
            "driving time (PEM: never).",
            ("b",),
        )

    def test_where_the_baseline_does_the_others_are_held_against_the_best_of_them(self) -> None:
        found = self.decided(("a", 0.0, 0.25, -0.3, -0.2), ("b", 0.25, 0.25, -0.01, 0.01))
        assert found.best == ("a",)
        assert found.sentence.startswith("Sooner than PEM (an object is known after 1.00 s on average): a by 0.5 s")
        assert "; sooner than PEM, but braking for nothing: b by 0.3 s" in found.sentence
        assert (
            "But with b the driver brakes for nothing in 25 % of the driving time, with PEM in 25 %" in found.sentence
        )
        assert found.sentence.endswith("(a: never).")

    @pytest.mark.parametrize(
        "share",
        [
            pytest.param(("a", 0.004, 0.0, 0.003, 0.005), id="a half per cent is the least that is said"),
            pytest.param(("a", 0.25, 0.0, -0.1, 0.6), id="the interval includes 0"),
        ],
    )
    def test_what_is_not_shown_or_does_not_matter_is_not_said(self, share: Row) -> None:
        found = self.decided(share, ("b", 0.0, 0.0, 0.0, 0.0))
        assert found.best == ("a",)
        assert "nothing" not in found.sentence


def test_criteria_are_the_sentence() -> None:
    def said(*words: str) -> str:
        return describe_verdicts(Judgement("r", tuple(verdict(f"v{k}", word) for k, word in enumerate(words))))

    assert said(MET) == "Good enough: the one verdict passes."
    assert said(MET, MET) == "Good enough: all 2 verdicts pass."
    assert said(MET, UNDECIDED) == (
        "Not shown to be good enough: 1 of 2 verdicts does not pass: v1 with PEM is undecided (asked: ttd_rmst_s ≤ "
        "0.5, found: 0.7)."
    )
    assert said(UNDECIDED, NOT_MET, MET) == (
        "Not good enough: 2 of 3 verdicts do not pass: v1 with PEM is not met (asked: ttd_rmst_s ≤ 0.5, found: 0.7), "
        "and 1 more."
    )


def test_results_are_decided_on_without_rows_of_accuracy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of an hour they take half a gigabyte, and no decision is about them; a comparison of all metrics reads them."""
    frames = [(0.1 * k, [Obj(id=1, x=1.0 * k), pedestrian(id=2, x=60.0, y=-2)]) for k in range(31)]
    write_recording(tmp_path / "drive.mcap", frames, host=1)
    (tmp_path / "plan.yaml").write_text(
        "version: 1\nlogs: [drive.mcap]\npems: {p: [{detection: {kind: constant, probability: 1}}]}\n"
        "units: {ego: {on: ego, height_m: 1.8, pem: p}}\n"
        "configurations: {ideal: {units: all}, late: {units: all, latency_s: 0.3}}\n"
    )
    read: list[str] = []
    of = LogRows.of

    def watched(self: LogRows, log: str) -> Any:
        read.append(self.place.name)
        return of(self, log)

    monkeypatch.setattr(LogRows, "of", watched)
    result = cr.run(tmp_path / "plan.yaml")
    assert "late" in decide(result).sentence
    assert set(read) == {"detections.parquet"}
    cr.compare(result)
    assert {"accuracy.parquet", "instants.parquet"} <= set(read)


# ------------------------------------------------------------------------------- what would help with one object


def helps(known_s: dict[str, float | None]) -> str:
    """The sentence on an object that configurations know after some seconds; None: never."""
    units = {name: {"at": [0, k], "height_m": 5.0, "pem": "sure"} for k, name in enumerate(("m1", "m2", "m3", "m4"))}
    given = experiment(
        units=units,
        links={"radio": {"latency": 0.1}},
        configurations={
            "GT": {"units": "truth"},
            "one": {"units": ["m1"]},
            "two": {"units": ["m1", "m2"]},
            "all": {"units": "all"},
            "late": {"units": "all", "latency_s": 1.5},
            "gnn": {"units": "all", "fusion": {"kind": "gnn"}},
            "air": {"units": "all", "link": "radio"},
            "other": {"units": ["m3", "m4"], "fusion": {"kind": "gnn"}, "latency_s": {"default": 0.5}},
        },
    )
    return tell_what_helps(
        given, pd.DataFrame({"configuration": [*known_s], "time_to_detection_s": [*known_s.values()]})
    )


@pytest.mark.parametrize(
    ("known_s", "change"),
    [
        ({"all": 0.2, "late": 1.7}, "late: 0 s of latency instead of 1.5 s, as in all: known 1.50 s earlier"),
        (
            {"two": 0.2, "one": None},
            "one: the lists of m2 as well, as in two: known 0.20 s after the onset instead of never",
        ),
        ({"two": 0.9, "all": 0.0}, "two: the lists of m3, m4 as well, as in all: known 0.90 s earlier"),
        ({"one": 0.1, "two": 0.4}, "two: the lists of m1 instead, as in one: known 0.30 s earlier"),
        ({"all": 0.1, "gnn": 0.4}, "gnn: fusion ideal instead of gnn, as in all: known 0.30 s earlier"),
        ({"all": 0.1, "air": 0.4}, "air: no link, as in all: known 0.30 s earlier"),
        ({"air": 0.1, "all": 0.4}, "all: another link, as in air: known 0.30 s earlier"),
        ({"two": 0.1, "all": 0.0, "one": 3.0}, "one: the lists of m2, m3, m4 as well, as in all: known 3.00 s earlier"),
        (
            {"other": None, "one": None, "two": 1.0},
            "one: the lists of m2 as well, as in two: known 1.00 s after the onset instead of never",
        ),
        # With more units more keys may differ; fewer come first.
        (
            {"one": 3.0, "gnn": 0.5},
            "one: the lists of m2, m3, m4 as well (and another fusion), as in gnn: known 2.50 s earlier",
        ),
        (
            {"other": None, "air": 0.5},
            "other: the lists of m1, m2 as well (and another link and latency and fusion), as in air: known "
            "0.50 s after the onset instead of never",
        ),
        ({"one": 3.0, "gnn": 0.0, "two": 1.0}, "one: the lists of m2 as well, as in two: known 2.00 s earlier"),
    ],
)
def test_one_key_of_another_configuration_would_help(known_s: dict[str, float | None], change: str) -> None:
    assert helps(known_s) == f"What would help {change}, with the same draws."


@pytest.mark.parametrize(
    "known_s",
    [
        {},
        {"one": 0.3},
        {"GT": 0.0, "one": 0.3},
        {"all": 0.3, "late": 0.3},
        {"late": None, "all": None},
        {"other": 2.0, "one": 0.0},  # it has other units, and more keys are different
        {"late": 1.0, "gnn": 0.0},
    ],
)
def test_what_would_help_is_not_made_up(known_s: dict[str, float | None]) -> None:
    assert helps(known_s) == ""
