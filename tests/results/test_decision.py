"""The decision in one sentence, from comparisons and verdicts written down by hand."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest
import yaml

import copem_replay as cr
from copem_replay.results.compare import Comparison, compare_folders
from copem_replay.results.decision import Decision, decide, decide_compared, describe_verdicts
from copem_replay.results.table_files import LogRows
from copem_replay.results.verdicts import MET, NOT_MET, UNDECIDED, Judgement, Verdict
from tests.helpers.recordings import Obj, pedestrian, write_recording

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


def study(**latencies_s: float) -> Any:
    """Results of that experiment, in which nobody is asked to brake."""
    return SimpleNamespace(experiment=cooperating(**latencies_s), summary=pd.DataFrame())


class TestLatencies:
    def test_up_to_which_latency_cooperation_helps(self) -> None:
        found = decide_compared(
            compared(
                "pass_share",
                ("co0", 0.996, 0.844, 0.1, 0.2),
                ("co1", 0.64, 0.844, -0.25, -0.15),
                ("co05", 0.96, 0.844, 0.05, 0.15),
            ),
            study(co0=0.0, co05=0.5, co1=1.0),
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
            study(co0=0.0, co1=1.0),
        )
        assert found.sentence == (
            "Without latency cooperation helps: an object is known after 0.00 s on average against 0.70 s with PEM "
            "alone, by 0.70 s [0.60, 0.80]; at 1 s of latency no difference to PEM alone is shown: 0.90 s, 0.20 s "
            "later [-0.10, 0.50]."
        )

    def test_out_of_their_order_each_is_named(self) -> None:
        found = decide_compared(
            compared("ttd_rmst_s", ("co0", 0.9, 0.7, 0.1, 0.3), ("co1", 0.1, 0.7, -0.7, -0.5)),
            study(co0=0.0, co1=1.0),
        )
        assert found.sentence == (
            "Sooner than PEM (known after 0.70 s on average): co1 by 0.60 s [0.50, 0.70]; later than PEM: "
            "co0 by 0.20 s [0.10, 0.30]."
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
        assert (found.sentence, found.best) == (
            "Better than PEM (50 % of conflicts pass): a by 40 percentage points [30, 50]; worse than PEM: c by 30 "
            "percentage points [20, 40]; no difference to PEM is shown: b +10 percentage points [-10, 30].",
            ("a",),
        )

    @pytest.mark.parametrize(("apart_s", "crowned"), [(0.0002, False), (0.049, False), (0.051, True)])
    def test_nobody_is_crowned_by_a_hair(self, apart_s: float, crowned: bool) -> None:
        """All intervals exclude 0."""
        found = decide_compared(compared("ttd_rmst_s", ("a", 1 - apart_s, 1.0, -apart_s - 1e-5, -apart_s + 1e-5)))
        assert found.sentence.startswith("Sooner than PEM" if crowned else "Within 0.05 s of PEM (known")
        assert found.best == (("a",) if crowned else ("a", "PEM"))

    def test_the_best_has_a_better_mean_than_all_and_no_interval_that_excludes_0(self) -> None:
        found = decide_compared(compared("ttd_rmst_s", ("a", 0.5, 1.0, -1.2, 0.2), ("b", 2.0, 1.0, 0.5, 1.5)))
        assert found.sentence == (
            "Later than PEM (known after 1.00 s on average): b by 1.00 s [0.50, 1.50]; no difference to "
            "PEM is shown: a 0.50 s sooner [-0.20, 1.20]."
        )
        assert set(found.best) == {"a", "PEM"}

    def test_without_intervals_it_says_so(self) -> None:
        found = decide_compared(compared("pass_share", ("a", 1.0, 0.0, None, None)))
        assert found.sentence == (
            "On these objects alone, without an interval, against PEM (0 % of conflicts pass): a +100 percentage "
            "points."
        )

    def test_each_is_held_against_the_rows_of_its_own_pair(self) -> None:
        """Of b half of the logs have no units: the baseline is slower there, and no mean of all rows is compared."""
        found = decide_compared(compared("ttd_rmst_s", ("a", 0.5, 1.0, -0.6, -0.4), ("b", 1.2, 1.5, -0.4, -0.2)))
        assert found.sentence == "Sooner than PEM: a by 0.50 s [0.40, 0.60], b by 0.30 s [0.20, 0.40]."
        assert found.best == ("a",)

    def test_who_is_the_same_in_every_pair_is_said_to_be(self) -> None:
        found = decide_compared(compared("ttd_rmst_s", ("a", 1.0, 1.0, None, None), ("b", 1.0, 1.0, -0.1, 0.1)))
        assert found.sentence == (
            "The same as PEM (known after 1.00 s on average): a; no difference to PEM is shown: b 0.00 s "
            "sooner [-0.10, 0.10]."
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
            (
                "Sooner than PEM (known after 1.00 s on average): b by 0.30 s [0.20, 0.40]; sooner than "
                "PEM, but braking for nothing: a by 0.50 s [0.40, 0.60].",
                "But with a the driver brakes for nothing in 25 % of the driving time (PEM: never).",
            ),
            ("b",),
        )

    def test_where_the_baseline_does_the_others_are_held_against_the_best_of_them(self) -> None:
        found = self.decided(("a", 0.0, 0.25, -0.3, -0.2), ("b", 0.25, 0.25, -0.01, 0.01))
        assert found.best == ("a",)
        assert found.sentence.startswith("Sooner than PEM (known after 1.00 s on average): a by 0.50 s")
        assert "; sooner than PEM, but braking for nothing: b by 0.30 s" in found.sentence
        assert (
            "But with b the driver brakes for nothing in 25 % of the driving time, with PEM in 25 %" in found.sentence
        )
        assert found.sentence.endswith("(a: never).")

    @pytest.mark.parametrize(
        ("shares", "said"),
        [
            pytest.param(
                (0.25, 0.0, 0.2, 0.3),
                "But with a the driver brakes for nothing in 25 % of these 360 s of driving (PEM: never), losing up to "
                "0.5 m/s at a time mostly because of old entries.",
                id="of who is named, whatever others brake for",
            ),
            pytest.param(
                (0.25, 0.25, 0.0, 0.0),
                "The driver brakes for nothing mostly because of misplaced true objects.",
                id="all alike",
            ),
        ],
    )
    def test_what_they_brake_for_is_said(self, shares: tuple[float, ...], said: str) -> None:
        times, share = compared("ttd_rmst_s", *self.SOONER), compared("needless_brake_share", ("a", *shares))
        both = replace(times, table=pd.concat([times.table, share.table], ignore_index=True))
        names, of_base = ["a", "PEM"], shares[1]
        summary = pd.DataFrame({"configuration": names, "needless_brake_share": [0.25, of_base], "driving_h": 0.1})
        rows = [("a", "late", 3.0), ("a", "misplaced", 2.0), ("PEM", "misplaced", 9.0), ("PEM", "ghost", 1.0)]
        needless = pd.DataFrame(rows, columns=["configuration", "cause", "lasts_s"])
        results: Any = SimpleNamespace(
            summary=summary.assign(needless_speed_lost_max_mps=0.5), experiment=None,
            has=lambda name: name == "needless.parquet", frame=lambda _: needless,
        )  # fmt: skip
        assert decide_compared(both, results).sentences[-1] == said

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


SPEEDS_MPS = {2: 4.0, 3: 5.0, 4: 8.0, 5: 10.0, 6: 2.5}
"""Of people who walk up to the ego: 20 m later by 5, 4, 2.5, 2 and 8 s, of which 3 s count."""
APPROACH = """\
version: 1
logs: [drive.mcap]
pems:
  near: [{when: {range_m: [0, 20]}, detection: {kind: constant, probability: 1}}]
  far: [{detection: {kind: constant, probability: 1}}]
units:
  ego: {on: ego, height_m: 1.8, pem: near}
  more: {on: ego, height_m: 1.8, pem: far}
  mast: {at: [0, 0], height_m: 5, pem: far}
configurations: {%s}
measure: {objects: {classes: [pedestrian]}, onset: {kind: in_range, range_m: 40}, horizon_s: 3, accuracy: false}
show: null
"""


def approached(place: Path, **configurations: str) -> tuple[str, ...]:
    """What is decided of people whom the ego knows from 20 m on, the mast from anywhere; from 40 m on it counts."""
    frames = [
        (0.1 * k, [Obj(id=1), *(pedestrian(id, 40 + v * (0.25 - 0.1 * k), vx=-v) for id, v in SPEEDS_MPS.items())])
        for k in range(60)
    ]
    write_recording(place / "drive.mcap", frames, host=1)
    of = ", ".join(f"{name}: {{units: {asked}}}" for name, asked in configurations.items())
    (place / "plan.yaml").write_text(APPROACH % of)
    return decide(cr.run(place / "plan.yaml", jobs=1)).sentences


class TestParts:
    """Alone an object is known after 3, 3, 2.5, 2 and 3 s, 2.7 s on average."""

    def test_cooperation_fusion_and_latency_each_against_its_own(self, tmp_path: Path) -> None:
        cooperation, fusion, latency = approached(
            tmp_path,
            GT="truth",
            ideal="[ego, mast]",
            gnn="[ego, mast], fusion: {kind: gnn}",
            alone="[ego], fusion: {kind: gnn}",
            late="[ego, mast], fusion: {kind: gnn}, latency_s: 0.5",
        )
        assert re.fullmatch(
            r"Cooperation: sooner than alone \(known after 2\.70 s on average\): gnn by 2\.70 s "
            r"\[2\.\d\d, 3\.\d\d\], late by 2\.20 s \[1\.\d\d, 2\.\d\d\]\.",
            cooperation,
        )
        assert fusion == "Fusion: the same as ideal (known after 0.00 s on average): gnn."
        assert latency == "Latency: 0.5 s costs 0.50 s, alike in every pair (late against gnn)."

    def test_an_ideal_whose_lists_nobody_else_has_is_cooperation(self, tmp_path: Path) -> None:
        [cooperation] = approached(tmp_path, car="[ego]", both="[ego, mast]")
        assert cooperation.startswith("Cooperation: sooner than car (known after 2.70 s on average): both")

    def test_who_is_neither_stands_beside_them(self, tmp_path: Path) -> None:
        """Another sensor of the car is no cooperation."""
        _, beside = approached(tmp_path, car="[ego]", better="[ego, more]", both="[ego, mast]")
        assert beside.startswith("Beside them: sooner than car (known after 2.70 s on average): better by")

    def test_of_the_car_alone_there_are_no_parts(self, tmp_path: Path) -> None:
        [told] = approached(tmp_path, car="[ego]", better="[ego, more]")
        assert told.startswith("Sooner than car (known after 2.70 s on average): better by 2.70 s [")

    def test_of_one_unit_fusion_and_latency_are_told(self, tmp_path: Path) -> None:
        assert approached(
            tmp_path,
            ideal="[mast]",
            gnn="[mast], fusion: {kind: gnn}",
            late="[mast], fusion: {kind: gnn}, latency_s: 1",
        ) == (
            "Fusion: the same as ideal (known after 0.00 s on average): gnn.",
            "Latency: 1 s costs 1.00 s, alike in every pair (late against gnn).",
        )

    def test_each_pair_is_compared_once(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        pairs: list[tuple[str, str]] = []

        def counted(*given: Any, **options: Any) -> Comparison:
            found = compare_folders(*given, **options)
            pairs.extend((name, found.baseline) for name in found.configurations)
            return found

        monkeypatch.setattr("copem_replay.results.decision.compare_folders", counted)
        gnn = "[ego, mast], fusion: {kind: gnn}"
        told = approached(
            tmp_path, ideal="[ego, mast]", gnn=gnn, alone="[ego], fusion: {kind: gnn}", late=f"{gnn}, latency_s: 0.5",
            better="[ego, more]",
        )  # fmt: skip
        assert [part.partition(":")[0] for part in told] == ["Cooperation", "Fusion", "Latency", "Beside them"]
        assert sorted(pairs) == sorted({*pairs})
        assert {("gnn", "ideal"), ("gnn", "alone"), ("late", "gnn"), ("better", "alone")} <= {*pairs}

    def test_latencies_between_which_the_help_ends_are_the_sentence(self, tmp_path: Path) -> None:
        [told] = approached(tmp_path, car="[ego]", at_once="[ego, mast]", late="[ego, mast], latency_s: 2.9")
        assert told.startswith("Without latency cooperation helps: an object is known after 0.00 s on average against ")
        assert "; at 2.9 s of latency no difference to car alone is shown: 2.90 s, 0.20 s later [" in told

    def test_without_a_car_the_best_single_unit_is_alone(self, tmp_path: Path) -> None:
        """Each of two masts alone; together they know no sooner than the better one."""
        units = {
            "mast": {"at": [0, 0], "height_m": 5, "pem": "far"},
            "other": {"at": [0, 0], "height_m": 5, "pem": "near"},
        }
        plain = yaml.safe_load(APPROACH % "other: {units: [other]}, mast: {units: [mast]}, both: {units: all}")
        plain |= {"units": units, "logs": [str(tmp_path / "drive.mcap")]}
        plain["measure"]["distance_to"] = "mast"
        approached(tmp_path, car="[ego]")
        found = decide(cr.run(plain, jobs=1)).sentences
        assert found == (
            "Cooperation: the same as mast (known after 0.00 s on average): both.",
            "Beside them: later than mast (known after 0.00 s on average): other by 2.70 s [2.14, 3.00].",
        )


def test_where_no_log_has_both_there_is_no_answer(tmp_path: Path) -> None:
    approached(tmp_path, car="[ego]")
    logs = "[{file: drive.mcap, name: a, units: {mast: null}}, {file: drive.mcap, name: b, units: {ego: null}, %s}]"
    logs %= "measure: {distance_to: mast}, window_s: [0, 4]"
    for more, told in (
        ("", "There is no answer: no log has both car and another configuration."),
        (", ideal: {units: [mast]}, gnn: {units: [mast], fusion: {kind: gnn}}",
         "Cooperation: not known, for no log has both car and ideal or gnn."),
    ):  # fmt: skip
        text = APPROACH % f"car: {{units: [ego]}}, tower: {{units: [mast]}}{more}"
        (tmp_path / "two.yaml").write_text(text.replace("[drive.mcap]", logs))
        assert decide(cr.run(tmp_path / "two.yaml", jobs=1)).sentences[0] == told


def test_criteria_are_the_sentence() -> None:
    def said(*words: str) -> str:
        return describe_verdicts(Judgement("r", tuple(verdict(f"v{k}", word) for k, word in enumerate(words))))

    assert said(MET) == "Good enough: the one verdict passes."
    assert said(MET, MET) == "Good enough: all 2 verdicts pass."
    assert said(MET, UNDECIDED) == (
        "Not shown to be good enough: 1 of 2 verdicts does not pass: v1 with PEM is undecided (asked: known after "
        "(mean) ≤ 0.5 s, found: 0.7)."
    )
    assert said(UNDECIDED, NOT_MET, MET) == (
        "Not good enough: 2 of 3 verdicts do not pass: v1 with PEM is not met (asked: known after (mean) ≤ 0.5 s, "
        "found: 0.7), and 1 more."
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
