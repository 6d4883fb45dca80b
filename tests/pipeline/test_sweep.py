"""Sweeps: which points they have, and that each is what the same experiment with that value gives.

Three masts and a connected vehicle beside the ego's unit; the ego drives at 10 m/s towards where a pedestrian crosses.
"""

from __future__ import annotations

import csv
import itertools
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from copem_replay.cli import main as cli
from copem_replay.core.errors import ExperimentError
from copem_replay.experiment.file import log_paths, read_experiment_file
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import find_problems, read_logs
from copem_replay.io.recording import Recording
from copem_replay.metrics.braking.driving import DRIVING
from copem_replay.metrics.summary_metrics import METRICS_OF
from copem_replay.perception.config import Carriers
from copem_replay.pipeline.closed_form import exact_table
from copem_replay.pipeline.prepare import Replay, prepare_log
from copem_replay.pipeline.run import run_experiment
from copem_replay.pipeline.sweep import KINDS, SweepPoint, list_points, resolve_sweep
from tests.helpers.experiments import changed, drive, source_of
from tests.helpers.replays import study_rows
from tests.helpers.scenes import Thing, driving, experiment, recording, standing

FIGURES = [metric.name for metric in (*METRICS_OF["accuracy"], *DRIVING)]
ROOT = Path(__file__).parents[2]
P = {"p": [{"detection": {"kind": "constant", "probability": 0.2}, "error": {"kind": "gaussian",
            "covariance_m2": [[0.5, 0.0], [0.0, 0.5]]}}]}  # fmt: skip
UNITS: dict[str, Any] = {
    "a": {"at": [-5, 9], "height_m": 5.0, "pem": "p"},
    "ego": {"on": "ego", "pem": "p"},
    "b": {"at": [5, 9], "height_m": 5.0, "pem": "p", "rate_hz": 5, "phase_s": 0.02},
    "v2v": {"on": "7", "pem": "p"},
}
CONFIGURATIONS: dict[str, Any] = {
    "GT": {"units": "truth"},
    "PEM": {"units": ["ego"]},
    "all": {"units": "all", "latency_s": 0.1},
    "late": {"units": "all", "latency_s": 0.5},
    "mixed": {"units": "all", "latency_s": {"ego": 0.0, "default": 0.3}},
    "masts": {"units": ["b", "a"]},
    "one": {"units": ["ego", "b"]},
}
DRIVER = {"kind": "constant_deceleration", "a_max_mps2": 8.0, "reaction": {"kind": "constant", "delay_s": 0.3}}


def plan(sweep: dict[str, Any] | None = None, **changes: Any) -> Experiment:
    standard: dict[str, Any] = {
        "runs": 30,
        "pems": P,
        "units": UNITS,
        "configurations": CONFIGURATIONS,
        "measure": {"objects": {"classes": ["pedestrian"]}, "onset": {"kind": "appears"}, "exact": True},
        "braking": {"driver": DRIVER},
        "sweep": sweep,
    }
    return experiment(**(standard | changes))


def crossing() -> Recording:
    """He crosses the ego's way 30 m ahead; another leaves; a third stands aside to the end."""
    return recording(
        [
            Thing("ego", "car", driving(-30, 0, 10)),
            Thing("7", "car", driving(20, 4, -6)),
            Thing("9", "car", standing(-10, -6)),
            Thing("w", "pedestrian", driving(0, -3, 0, 1)),
            Thing("x", "pedestrian", standing(10, 8), lambda t: t < 0.45),
            Thing("y", "pedestrian", standing(-20, 8), lambda t: t > 1.05),
        ],
        until_s=4.0,
    )


def told(wanted: Experiment) -> list[tuple[str, float, list[str]]]:
    return [(point.sweep, point.value, list(point.experiment.configurations)) for point in list_points(wanted)]


def only(wanted: Experiment) -> list[SweepPoint]:
    return list(list_points(wanted))


# ---------------------------------------------------------------------------------------------------- the points


class TestPoints:
    def test_none(self) -> None:
        assert only(plan()) == []

    def test_latency_is_that_of_the_whole_list_or_the_default_one(self) -> None:
        """`late` becomes the same as `all`, and is left out; the truth is not swept, nor what states no latency."""
        zero, more = only(plan({"latency_s": [0, 0.2]}))
        assert (zero.sweep, zero.value, more.value) == ("latency_s", 0.0, 0.2)
        late = {name: c.latency_s for name, c in more.experiment.configurations.items()}
        assert late == {"all": 0.2, "mixed": {"ego": 0.0, "default": 0.2}}
        assert zero.experiment.configurations["mixed"].latency_s == {"ego": 0.0, "default": 0.0}
        assert zero.experiment.configurations["all"].latency_s == 0
        for point in (zero, more):
            assert point.experiment.units == plan().units
            assert point.experiment.sweep is None

    def test_a_mapping_without_a_default_gets_one(self) -> None:
        mixed = {"mixed": {"units": "all", "latency_s": {"ego": 0.1}}}
        (point,) = only(plan({"latency_s": [0.7]}, configurations=mixed))
        (configuration,) = point.experiment.configurations.values()
        assert [configuration.latency_of(name) for name in UNITS] == [0.7, 0.1, 0.7, 0.7]

    def test_a_latency_of_0_is_one_where_it_is_by_unit(self) -> None:
        """Above 0 or by unit: what a vehicle sees itself arrives at once, at every latency of the others."""
        given = {
            "alone": {"units": ["ego"]},
            "said": {"units": ["ego"], "latency_s": 0.0},
            "none": {"units": "all", "latency_s": {}},
            "remote": {"units": "all", "latency_s": {"ego": 0.0}},
            "late": {"units": "all", "latency_s": 0.001},
            "truth": {"units": "truth", "latency_s": 0.5},
        }
        assert told(plan({"latency_s": [0.0, 1]}, configurations=given)) == [
            ("latency_s", 0.0, ["remote", "late"]),
            ("latency_s", 1.0, ["remote", "late"]),
        ]

    def test_who_is_named_has_its_latency_varied(self) -> None:
        wanted = plan({"latency_s": [0.4], "rate_hz": [5], "configurations": ["PEM", "mixed"]})
        assert told(wanted) == [("latency_s", 0.4, ["PEM", "mixed"]), ("rate_hz", 5, ["PEM", "mixed"])]
        assert only(wanted)[0].experiment.configurations["PEM"].latency_s == 0.4

    def test_by_quantity(self) -> None:
        """What is not said of one quantity is as by default."""
        by = {"latency_s": ["PEM"], "units": ["late", "masts"]}
        wanted = plan({"latency_s": [0.4], "rate_hz": [5], "units": [1], "configurations": by})
        assert told(wanted) == [
            ("latency_s", 0.4, ["PEM"]),
            ("rate_hz", 5, ["PEM", "all", "late", "mixed", "masts", "one"]),
            ("units", 1, ["late", "masts"]),
        ]

    def test_rate_is_that_of_every_unit(self) -> None:
        slow, fast = only(plan({"rate_hz": [5, 12.5]}))
        assert (slow.sweep, slow.value, fast.value) == ("rate_hz", 5.0, 12.5)
        assert {unit.rate_hz for unit in fast.experiment.units.values()} == {12.5}
        assert fast.experiment.units["b"].phase_s == 0.02
        assert fast.experiment.units["a"].model_copy(update={"rate_hz": None}) == plan().units["a"]
        everything = plan().configurations
        assert fast.experiment.configurations == {n: c for n, c in everything.items() if n != "GT"}

    def test_units_are_the_first_ones_beside_the_egos(self) -> None:
        """In the order of the experiment, whatever that of the configuration; the ego's is always there."""
        by_value = {
            point.value: point.experiment.configurations for point in list_points(plan({"units": [0, 1, 2, 3]}))
        }
        chosen = {value: {name: c.units for name, c in at.items()} for value, at in by_value.items()}
        assert chosen == {
            0: {"all": ("ego",), "late": ("ego",), "mixed": ("ego",), "one": ("ego",)},
            1: {"all": ("a", "ego"), "late": ("a", "ego"), "mixed": ("a", "ego"), "masts": ("a",), "one": ("ego", "b")},
            2: dict.fromkeys(("all", "late", "mixed"), ("a", "ego", "b")) | {"masts": ("a", "b")},
            3: dict.fromkeys(("all", "late", "mixed"), ("a", "ego", "b", "v2v")),
        }
        assert by_value[2]["late"].latency_s == 0.5
        assert by_value[2]["mixed"].latency_s == {"ego": 0.0, "default": 0.3}

    def test_share_is_that_of_all_carriers(self) -> None:
        fleet = {"on": {"classes": ["car"], "penetration_rate": 0.3}, "pem": "p"}
        other = {"on": {"classes": ["truck"], "penetration_rate": 0.9}, "pem": "p"}
        wanted = plan(
            {"penetration_rate": [0, 0.5, 1]},
            units=UNITS | {"fleet": fleet, "other": other},
            configurations=CONFIGURATIONS | {"fleet": {"units": ["fleet"]}},
        )
        zero, half, whole = only(wanted)
        assert [point.value for point in (zero, half, whole)] == [0, 0.5, 1]
        assert half.experiment.units["fleet"].on == Carriers(classes=("car",), penetration_rate=0.5)
        assert half.experiment.units["other"].on == Carriers(classes=("truck",), penetration_rate=0.5)
        assert half.experiment.units["v2v"] == wanted.units["v2v"]
        assert list(half.experiment.configurations) == ["all", "late", "mixed", "fleet"], (
            "who hears of none is as it is"
        )

    def test_a_fleet_is_one_unit(self) -> None:
        fleet = {"on": {"classes": ["car"], "penetration_rate": 0.3}, "pem": "p"}
        wanted = plan({"units": [0, 1]}, units={"ego": UNITS["ego"], "fleet": fleet},
                      configurations={"all": {"units": "all"}})  # fmt: skip
        assert [point.experiment.configurations["all"].units for point in list_points(wanted)] == [
            ("ego",),
            ("ego", "fleet"),
        ]

    def test_what_becomes_equal_at_all_values_is_there_once(self) -> None:
        """`late` has a life of its own as soon as it is not its latency that varies."""
        received = {"x": ["a", "ego"], "y": ["ego", "a"], "z": ["a", "ego"]}
        twins = {name: {"units": units, "latency_s": 0.1} for name, units in received.items()}
        wanted = plan({"units": [0, 1], "latency_s": [0.1]}, configurations=twins | {"late": CONFIGURATIONS["late"]})
        assert told(wanted) == [
            ("latency_s", 0.1, ["x", "y", "late"]),
            ("units", 0, ["x", "late"]),
            ("units", 1, ["x", "late"]),
        ]

    def test_chosen_configurations(self) -> None:
        """In the order of the experiment; the one that is left out is not what another is compared to."""
        wanted = plan({"configurations": ["late", "PEM", "GT"], "latency_s": [0, 1], "units": [1]})
        assert told(wanted) == [
            ("latency_s", 0, ["PEM", "late"]),
            ("latency_s", 1, ["PEM", "late"]),
            ("units", 1, ["late"]),
        ]

    def test_quantity_by_quantity_in_the_order_given(self) -> None:
        wanted = plan({"units": [3, 0], "rate_hz": [20, 10], "latency_s": [1, 0]})
        assert [(point.sweep, point.value) for point in list_points(wanted)] == [
            ("latency_s", 1), ("latency_s", 0), ("rate_hz", 20), ("rate_hz", 10), ("units", 3), ("units", 0),
        ]  # fmt: skip
        assert KINDS == (
            "latency_s",
            "rate_hz",
            "units",
            "penetration_rate",
            "correlation_s",
            "ghosts_in_list",
            "loss",
            "burst_s",
        )

    @pytest.mark.parametrize(
        "sweep",
        [
            {"configurations": ["GT"], "latency_s": [0, 1], "rate_hz": [5], "units": [1]},
            {"configurations": ["PEM"], "units": [0, 1]},
            {"configurations": ["masts"], "units": [0, 3]},
            {"penetration_rate": [0.5]},
        ],
    )
    def test_nothing_to_sweep(self, sweep: dict[str, Any]) -> None:
        assert only(plan(sweep)) == []
        assert run_experiment(plan(sweep, runs=1), [crossing()]).sweep is None

    def test_conflicts_are_sought_only_when_somebody_brakes_for_them(self) -> None:
        """They take time, and no column of a sweep tells of them."""
        measure = {"onset": {"kind": "appears"}, "conflict": {"horizon_s": 2.0}}
        for brakes_for, sought in (("object", False), ("conflict", True)):
            wanted = plan({"units": [1]}, measure=measure, braking={"driver": DRIVER, "brakes_for": brakes_for})
            (point,) = list_points(wanted)
            assert (point.experiment.measure.conflict is not None) == sought
        (point,) = list_points(plan({"units": [1]}, measure=measure, braking=None))
        assert point.experiment.measure.conflict is None

    def test_accuracy_never_is(self) -> None:
        assert plan().measure.accuracy
        found = only(plan(EVERYTHING))
        assert len(found) > 3
        assert not any(point.experiment.measure.accuracy for point in found)

    def test_the_rate_of_what_was_recorded_stays(self) -> None:
        units = {"ego": UNITS["ego"], "r": {"recorded": {"topic": "lists"}}}
        both = {"both": {"units": ["ego", "r"]}, "recorded": {"units": ["r"]}}
        (point,) = only(plan({"rate_hz": [4]}, units=units, configurations=both, measure={}))
        assert {name: unit.rate_hz for name, unit in point.experiment.units.items()} == {"ego": 4, "r": None}
        assert list(point.experiment.configurations) == ["both"]

    @pytest.mark.parametrize(
        "configuration",
        [
            {"units": ["ego"], "latency_s": {"ego": 0.1, "default": 0.3}},
            {"units": ["ego", "a"], "latency_s": {"ego": 0.1, "a": 0.3}},
        ],
    )
    def test_what_is_left_as_it_is_is_left_out(self, configuration: dict[str, Any]) -> None:
        assert told(plan({"latency_s": [0, 0.5]}, configurations={"one": configuration})) == []


class TestResolved:
    """The list that is written is the one that was swept, and gives the same again."""

    @staticmethod
    def said(sweep: dict[str, Any], **changes: Any) -> Any:
        wanted = plan(sweep, **changes)
        again = resolve_sweep(wanted)
        assert told(again) == told(wanted)
        assert again.model_copy(update={"sweep": None}) == wanted.model_copy(update={"sweep": None})
        assert again.sweep is not None
        assert Experiment.model_validate(again.as_written()) == again
        return again.sweep.model_dump(exclude_none=True).get("configurations")

    def test_one_list(self) -> None:
        assert self.said({"latency_s": [0, 1]}) == ("all", "mixed")
        assert self.said({"rate_hz": [5]}) == ("PEM", "all", "late", "mixed", "masts", "one")
        both = {name: CONFIGURATIONS[name] for name in ("all", "mixed")}
        assert self.said({"latency_s": [0, 1], "rate_hz": [5]}, configurations=both) == ("all", "mixed")

    def test_a_list_for_each_quantity_where_they_differ(self) -> None:
        assert self.said({"latency_s": [1], "units": [0, 1], "rate_hz": [5]}) == {
            "latency_s": ("all", "mixed"),
            "rate_hz": ("PEM", "all", "late", "mixed", "masts", "one"),
            "units": ("all", "late", "mixed", "masts", "one"),
        }
        fresh = {name: CONFIGURATIONS[name] for name in ("PEM", "masts")}
        assert self.said({"latency_s": [1], "units": [1]}, configurations=fresh) == {"units": ("masts",)}

    def test_what_is_given_stays(self) -> None:
        assert self.said({"latency_s": [1], "units": [1], "configurations": ["GT", "PEM"]}) == ("GT", "PEM")
        by = {"latency_s": ["GT", "PEM"]}
        assert self.said({"latency_s": [1], "units": [1], "configurations": by}) == {
            "latency_s": ("GT", "PEM"),
            "units": ("all", "late", "mixed", "masts", "one"),
        }

    def test_nothing_to_say(self) -> None:
        assert self.said({"latency_s": [1]}, configurations={"PEM": CONFIGURATIONS["PEM"]}) is None
        assert resolve_sweep(plan()) == plan()


# -------------------------------------------------------------------------------------------------- the results


def swept(sweep: dict[str, Any], **changes: Any) -> pd.DataFrame:
    result = run_experiment(plan(sweep, **changes), [crossing()])
    assert result.sweep is not None
    return result.sweep


def rows_at(table: pd.DataFrame, sweep: str, value: float) -> pd.DataFrame:
    """The summary of one point."""
    part = table[(table["sweep"] == sweep) & (table["value"] == value)]
    return part.drop(columns=["sweep", "value"]).reset_index(drop=True)


def plainly(names: list[str], **changes: Any) -> pd.DataFrame:
    """The summary of the experiment as it would be written with that value, but for accuracy."""
    found = without_accuracy(run_experiment(plan(**changes), [crossing()]).summary)
    return found.set_index("configuration").loc[names].reset_index()


def without_accuracy(summary: pd.DataFrame) -> pd.DataFrame:
    return summary.drop(columns=list(FIGURES))


def alike(found: pd.DataFrame, expected: pd.DataFrame) -> None:
    assert list(found) == list(expected)
    pd.testing.assert_frame_equal(found, expected, check_dtype=False, check_exact=True)


class TestResults:
    @pytest.mark.parametrize("latency", [0.0, 0.25, 5.0])
    def test_latency(self, latency: float) -> None:
        names = ["PEM", "all", "mixed", "masts", "one"]
        found = rows_at(swept({"latency_s": [1.0, latency], "configurations": names}), "latency_s", latency)
        late = {name: c | {"latency_s": latency} for name, c in CONFIGURATIONS.items()}
        late["mixed"] = CONFIGURATIONS["mixed"] | {"latency_s": {"ego": 0.0, "default": latency}}
        alike(found, plainly(names, configurations=late))

    def test_who_has_no_latency_stays_as_it_is(self) -> None:
        """The ego by itself does not come to know later because others' lists take longer."""
        found = swept({"latency_s": [0, 3]}, runs=3)
        assert set(found["configuration"]) == {"all", "mixed"}

    @pytest.mark.parametrize("rate", [2.0, 10.0, 33.3])
    def test_rate(self, rate: float) -> None:
        found = rows_at(swept({"rate_hz": [rate]}), "rate_hz", rate)
        units = {name: unit | {"rate_hz": rate} for name, unit in UNITS.items()}
        alike(found, plainly(["PEM", "all", "late", "mixed", "masts", "one"], units=units))

    @pytest.mark.parametrize(
        ("count", "fewer"),
        [
            (0, {"all": ["ego"], "late": ["ego"], "mixed": ["ego"], "one": ["ego"]}),
            (
                1,
                {"all": ["ego", "a"], "late": ["ego", "a"], "mixed": ["a", "ego"], "masts": ["a"], "one": ["ego", "b"]},
            ),
            (3, {"all": "all", "late": "all", "mixed": "all"}),
        ],
    )
    def test_units(self, count: int, fewer: dict[str, Any]) -> None:
        found = rows_at(swept({"units": [count]}), "units", count)
        chosen = {name: CONFIGURATIONS[name] | {"units": units} for name, units in fewer.items()}
        alike(found, plainly(list(fewer), configurations=chosen))

    @pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
    def test_share(self, share: float) -> None:
        def units(at: float) -> dict[str, Any]:
            return UNITS | {"fleet": {"on": {"classes": ["car"], "penetration_rate": at}, "pem": "p"}}

        configurations = {"all": {"units": "all"}, "V2V": {"units": ["ego", "fleet"], "latency_s": {"fleet": 0.1}}}
        found = swept({"penetration_rate": [0.9, share]}, units=units(0.3), configurations=configurations)
        expected = plainly(["all", "V2V"], units=units(share), configurations=configurations)
        alike(rows_at(found, "penetration_rate", share), expected)

    def test_several_hits(self) -> None:
        """Without exact times, which lists of several rates do not have."""
        measure = {"onset": {"kind": "appears"}, "confirm": {"hits": 2, "of": 3}}
        found = swept({"latency_s": [0.3], "rate_hz": [20], "units": [1]}, measure=measure)
        units = {name: unit | {"rate_hz": 20.0} for name, unit in UNITS.items()}
        names = ["PEM", "all", "late", "mixed", "masts", "one"]
        alike(rows_at(found, "rate_hz", 20), plainly(names, units=units, measure=measure))

    def test_braking_for_conflicts(self) -> None:
        changes = {
            "measure": {"onset": {"kind": "appears"}, "conflict": {"horizon_s": 2.0}},
            "braking": {"driver": DRIVER, "brakes_for": "conflict"},
        }
        found = rows_at(swept({"units": [1]}, **changes), "units", 1)
        late = CONFIGURATIONS["late"] | {"units": ["a", "ego"]}
        expected = plainly(["late"], configurations={"late": late}, **changes)
        alike(found[found["configuration"] == "late"].reset_index(drop=True), expected)

    def test_the_horizon_is_that_of_the_experiment(self) -> None:
        measure = plan().measure.model_dump(exclude_defaults=True) | {"horizon_s": 1.5}
        table = swept({"latency_s": [0, 3]}, measure=measure)
        assert set(table["ttd_rmst_horizon_s"]) == {1.5}
        # Episodes of 4, 2.9 and 0.4 s: none lasts 5 s, and two of the three 2.9 s.
        assert set(swept({"latency_s": [0, 3]})["ttd_rmst_horizon_s"]) == {2.9}

    def test_nothing_else_changes(self) -> None:
        whole, plain = (run_experiment(plan(sweep), [crossing()]) for sweep in (EVERYTHING, None))
        pd.testing.assert_frame_equal(study_rows(whole), study_rows(plain), check_exact=True)
        pd.testing.assert_frame_equal(whole.summary, plain.summary, check_exact=True)
        assert whole.exact is not None
        pd.testing.assert_frame_equal(whole.exact, plain.exact, check_exact=True)
        assert whole.notes == plain.notes
        assert plain.sweep is None

    def test_without_anything_to_measure(self) -> None:
        nobody = {"objects": {"classes": ["bus"]}, "exact": True}
        table = swept({"latency_s": [0, 1]}, measure=nobody)
        assert set(table["n"]) == {0}
        assert table["detected_share"].isna().all()

    def test_progress(self) -> None:
        """One after the other, to the end, of everything from the beginning."""
        steps: list[tuple[int, int]] = []
        run_experiment(
            plan({"latency_s": [0, 1], "rate_hz": [5]}), [crossing()], progress=lambda a, b: steps.append((a, b))
        )
        shares = [done / total for done, total in steps]
        assert shares == sorted(set(shares))
        assert shares[-1] == 1
        assert shares[0] <= 1 / 4

    def test_what_has_no_closed_form_is_refused_at_once(self) -> None:
        """The ego's latency stays as it is: only the point at 0.2 s has one."""
        wanted = plan(
            {"latency_s": [0.2, 0.0]},
            units={name: UNITS[name] for name in ("ego", "a")},
            configurations={"all": {"units": "all", "latency_s": {"ego": 0.2, "default": 0.2}}},
            measure={"onset": {"kind": "appears"}, "confirm": {"hits": 2, "of": 2}, "exact": True},
        )
        steps: list[int] = []
        with pytest.raises(ExperimentError, match="no closed form"):
            run_experiment(wanted, [crossing()], progress=lambda done, total: steps.append(done))
        assert steps == []


EVERYTHING = {"latency_s": [0, 0.4], "rate_hz": [4, 20], "units": [0, 2]}


def test_a_sweep_of_several_logs() -> None:
    """Over all of them together, as in the summary."""
    logs = [crossing(), recording([Thing("ego", "car", standing(0, 0)), Thing("7", "car", standing(9, 9)),
                                   Thing("w", "pedestrian", standing(15, 0))], until_s=1.0, log="other")]  # fmt: skip
    found = run_experiment(plan({"latency_s": [0.4], "configurations": ["PEM", "all"]}), logs).sweep
    assert found is not None
    late = {name: c | {"latency_s": 0.4} for name, c in CONFIGURATIONS.items() if name in ("all", "PEM")}
    expected = without_accuracy(run_experiment(plan(configurations=late), logs).summary)
    part = rows_at(found, "latency_s", 0.4)
    alike(part, expected)


# ----------------------------------------------------------------------------------------------- files and commands

Call = Callable[..., list[str]]


@pytest.fixture
def call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Call:
    """A command that ends well in a folder with the small recording; what it says on stderr."""
    drive(tmp_path / "drive.mcap")
    monkeypatch.chdir(tmp_path)

    def called(*arguments: str) -> list[str]:
        monkeypatch.setattr("sys.argv", ["copem-replay", *arguments])
        code = cli._run_to_exit_code()
        said = capsys.readouterr().err
        assert code == 0, said
        return said.splitlines()

    return called


EXACT = "measure: {onset: {kind: in_range, range_m: 60}, exact: true}"
SWEEP = "sweep: {latency_s: [0, 0.25, 1e-1], rate_hz: [5, 20], units: [0, 1]}"


def written(folder: Path, *names: str) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in sorted(folder.iterdir()) if (p.name in names or not names)}


class TestFiles:
    def test_columns_and_rows(self, call: Call, tmp_path: Path) -> None:
        (tmp_path / "e.yaml").write_text(changed(EXACT, SWEEP))
        call("run", "e.yaml")
        folder = tmp_path / "out" / "e"
        with (folder / "summary.csv").open(newline="") as file:
            summary = list(csv.reader(file))
        with (folder / "sweep.csv").open(newline="") as file:
            header, *lines = list(csv.reader(file))
        kept = [k for k, name in enumerate(summary[0]) if name not in FIGURES]
        assert {metric.name for metric in METRICS_OF["accuracy"]} <= {*summary[0]}
        assert header == ["sweep", "value", *(summary[0][k] for k in kept)]
        assert "ttd_rmst_s_exact" in header
        assert [(row[0], row[1], row[2]) for row in lines] == [
            ("latency_s", "0", "coPEM"), ("latency_s", "0.25", "coPEM"), ("latency_s", "0.1", "coPEM"),
            ("rate_hz", "5", "PEM"), ("rate_hz", "5", "coPEM"), ("rate_hz", "20", "PEM"), ("rate_hz", "20", "coPEM"),
            ("units", "0", "coPEM"), ("units", "1", "coPEM"),
        ]  # fmt: skip
        # At the values the experiment has itself: the rows of its summary.
        by_name = {row[0]: [row[k] for k in kept] for row in summary[1:]}
        assert lines[-1][2:] == by_name["coPEM"]

    def test_only_where_there_is_a_sweep(self, call: Call, tmp_path: Path) -> None:
        """And nothing else of the results changes."""
        (tmp_path / "with.yaml").write_text(changed(EXACT, SWEEP))
        (tmp_path / "without.yaml").write_text(changed(EXACT))
        call("run", "with.yaml", "--out", "a")
        call("run", "without.yaml", "--out", "b")
        assert (tmp_path / "a" / "sweep.csv").exists()
        assert not (tmp_path / "b" / "sweep.csv").exists()
        names = {path.name for path in (tmp_path / "b").iterdir()} - {"experiment.yaml", "provenance.json"}
        assert {"detections.parquet", "summary.csv", "exact.parquet", "accuracy.parquet", "bands.csv"} < names
        assert written(tmp_path / "a", *names) == written(tmp_path / "b", *names)

    def test_jobs_do_not_matter(self, call: Call, tmp_path: Path) -> None:
        fleet = "  mast: {on: {classes: [car], penetration_rate: 0.5}, pem: onboard}"
        text = changed("runs: 50", fleet, EXACT, SWEEP.replace("}", ", penetration_rate: [0, 0.5, 1]}"))
        (tmp_path / "e.yaml").write_text(text)
        call("run", "e.yaml", "--out", "a", "--jobs", "1")
        call("run", "e.yaml", "--out", "b", "--jobs", "2")
        first = written(tmp_path / "a")
        assert set(first) == {
            "detections.parquet", "exact.parquet", "experiment.yaml", "provenance.json", "summary.csv", "sweep.csv",
            "accuracy.parquet", "bands.csv", "instants.parquet", "lists.parquet", "thresholds.parquet", "tally.parquet",
            "logs.csv", "read.csv", "false_tracks.parquet",
        }  # fmt: skip
        assert first == written(tmp_path / "b")

    def test_the_experiment_that_is_written_gives_the_same(self, call: Call, tmp_path: Path) -> None:
        fleet = "  mast: {on: {classes: [car, vru], penetration_rate: 0.5}, pem: onboard}"
        chosen = SWEEP.replace("}", ", penetration_rate: [0.25]}")
        (tmp_path / "d.yaml").write_text(changed(fleet, EXACT, chosen))
        call("run", "d.yaml", "--out", "c")
        call("run", "c/experiment.yaml", "--out", "d")
        assert written(tmp_path / "c") == written(tmp_path / "d")
        by_default = find_problems(read_experiment_file(tmp_path / "c" / "experiment.yaml"))[0]
        assert by_default is not None
        assert by_default.sweep is not None
        assert by_default.sweep.chosen("latency_s") == ("coPEM",)
        assert by_default.sweep.chosen("rate_hz") == ("PEM", "coPEM")
        chosen = SWEEP.replace("{", "{configurations: [coPEM], ").replace("}", ", penetration_rate: [0.25]}")
        (tmp_path / "e.yaml").write_text(changed(fleet, EXACT, chosen))
        call("run", "e.yaml", "--out", "a")
        said = call("run", "a/experiment.yaml", "--out", "b")
        assert not [line for line in said if not line.startswith("note: ")]
        assert written(tmp_path / "a") == written(tmp_path / "b")
        wanted = find_problems(read_experiment_file(tmp_path / "a" / "experiment.yaml"))[0]
        assert wanted is not None
        assert wanted.sweep is not None
        assert wanted.sweep.configurations == ("coPEM",)
        assert wanted.sweep.latency_s == (0, 0.25, 0.1)
        assert (wanted.sweep.rate_hz, wanted.sweep.units, wanted.sweep.penetration_rate) == ((5, 20), (0, 1), (0.25,))


class TestCheck:
    @pytest.mark.parametrize(
        ("changes", "expected"),
        [
            ([SWEEP], []),
            (["sweep: {units: [0, 1]}"], []),
            (["sweep: {configurations: [PEM, GT], latency_s: [0]}"], []),
            (
                ["sweep: {configurations: [PEM, coPEN], latency_s: [0]}"],
                ["19: sweep.configurations[1]: no configuration is named 'coPEN'; did you mean coPEM?"],
            ),
            (
                ["sweep: {configurations: [9], latency_s: [0]}"],
                ["19: sweep.configurations[0]: no configuration is named '9'; there are GT, PEM, coPEM"],
            ),
            (
                ["sweep: {units: [0, 2, 1, 7]}"],
                [
                    "19: sweep.units[1]: expected at most 1, the units beside the ego's; found 2",
                    "19: sweep.units[3]: expected at most 1, the units beside the ego's; found 7",
                ],
            ),
            (
                ["sweep: {penetration_rate: [0.5]}"],
                ["19: sweep.penetration_rate: no unit is `on: {classes, penetration_rate}`"],
            ),
            (
                ["  mast: {on: {classes: [car], penetration_rate: 1}, pem: onboard}",
                 "sweep: {penetration_rate: [0.5]}"],
                [],
            ),
            (
                ["sweep: {}"],
                [
                    "19: sweep: expected values of latency_s, rate_hz, units, penetration_rate, correlation_s, "
                    "ghosts_in_list, loss or burst_s, such as `latency_s: [0, 0.5, 1]`"
                ],
            ),
            (
                ["sweep: {configurations: [PEM], latency_s: []}"],
                ["19: sweep.latency_s: expected at least 1 in the list, found []"],
            ),
            (
                ["sweep: {configurations: [PEM]}"],
                [
                    "19: sweep: expected values of latency_s, rate_hz, units, penetration_rate, correlation_s, "
                    "ghosts_in_list, loss or burst_s, such as `latency_s: [0, 0.5, 1]`"
                ],
            ),
            (
                ["sweep: {rate_hz: [20, 10, 10]}"],
                ["19: sweep.rate_hz: expected each value once, found 10 twice"],
            ),
            (
                ["sweep: {configurations: [], latency_s: [0]}"],
                ["19: sweep.configurations: expected at least 1 in the list, found []"],
            ),
            (["sweep: {configurations: {latency_s: [coPEM]}, latency_s: [0]}"], []),
            (
                ["sweep: {configurations: {latency_s: [PEM, coPEN]}, latency_s: [0]}"],
                ["19: sweep.configurations.latency_s[1]: no configuration is named 'coPEN'; did you mean coPEM?"],
            ),
            (
                ["sweep: {configurations: {latencys: [PEM]}, latency_s: [0]}"],
                ["19: sweep.configurations.latencys: unknown key; did you mean latency_s?"],
            ),
            (
                ["sweep: {configurations: {units: [PEM]}, latency_s: [0]}"],
                ["19: sweep: configurations.units: expected values of units beside it, found none"],
            ),
            (["sweep: {configurations: 3, latency_s: [0]}"], ["19: sweep.configurations: expected a list, found 3"]),
            (["sweep: {latency_s: [0, -1]}"], ["19: sweep.latency_s[1]: expected at least 0, found -1"]),
            (["sweep: {rate_hz: [0]}"], ["19: sweep.rate_hz[0]: expected at least 0.001, found 0"]),
            (
                ["sweep: {units: [5], penetration_rate: [2], configurations: [x]}"],
                [
                    "19: sweep.penetration_rate[0]: expected at most 1, found 2",
                    "19: sweep.configurations[0]: no configuration is named 'x'; there are GT, PEM, coPEM",
                    "19: sweep.penetration_rate: no unit is `on: {classes, penetration_rate}`",
                    "19: sweep.units[0]: expected at most 1, the units beside the ego's; found 5",
                ],
            ),
        ],
    )  # fmt: skip
    def test_what_is_wrong_with_a_sweep(self, tmp_path: Path, changes: list[str], expected: list[str]) -> None:
        assert checked(tmp_path, changed(*changes)) == expected

    def test_without_units(self, tmp_path: Path) -> None:
        text = (
            "version: 1\nlogs: [drive.mcap]\nconfigurations: {GT: {units: truth}}\nsweep: {rate_hz: [5], units: [0]}\n"
        )
        assert checked(tmp_path, text) == ["4: sweep.rate_hz: the experiment has no units"]

    def test_our_own_experiments(self) -> None:
        for name in ("tc016d_beyond", "crossing_share"):
            wanted, found = find_problems(read_experiment_file(ROOT / "logs" / f"{name}.yaml"))
            assert found == []
            assert wanted is not None
            assert wanted.sweep is not None


def checked(folder: Path, text: str) -> list[str]:
    (folder / "drive.mcap").touch()
    source = source_of(folder, text)
    return [line.removeprefix(f"{source.path}:") for line in find_problems(source)[1]]


# -------------------------------------------------------------------------------------------- our own experiments


@cache
def ours(name: str) -> tuple[Experiment, Recording]:
    source = read_experiment_file(ROOT / "logs" / f"{name}.yaml")
    wanted, found = find_problems(source)
    assert wanted is not None, found
    (log,), refused = read_logs(wanted, log_paths(source)[0], source)
    assert not refused
    return wanted, log


def passing(ready: Replay, wanted: Experiment) -> dict[str, float]:
    """The exact share that passes, by configuration; all objects are in conflict."""
    rows = exact_table(ready, wanted)
    assert rows["conflict"].all()
    weighed = (rows["probability"] * rows["pass_probability"]).groupby(rows["configuration"], sort=False).sum()
    return {str(name): float(share) for name, share in weighed.items()}


class TestBeyondThePaper:
    """logs/tc016d_beyond.yaml, in closed form: what it is there to show."""

    def at(self, sweep: str) -> dict[float, dict[str, float]]:
        wanted, log = ours("tc016d_beyond")
        ready = prepare_log(log, wanted)
        return {
            point.value: passing(prepare_log(log, point.experiment) if sweep == "rate_hz" else ready, point.experiment)
            for point in list_points(wanted)
            if point.sweep == sweep
        }

    def test_more_lists_a_second(self) -> None:
        """Each list is one more chance: the ego alone passes more often with 10, 20, 50 Hz. The truth has 10."""
        wanted, log = ours("tc016d_beyond")
        alone = [shares["PEM"] for shares in self.at("rate_hz").values()]
        assert list(self.at("rate_hz")) == [10, 20, 50]
        assert alone[0] == pytest.approx(passing(prepare_log(log, wanted), wanted)["PEM"], abs=1e-9)
        assert alone == pytest.approx([0.85, 0.90, 0.93], abs=0.02)
        assert all(b > a + 0.01 for a, b in itertools.pairwise(alone))

    def test_latency_of_the_roadside_units_alone_never_harms(self) -> None:
        """What the vehicle sees itself it knows at once; with the whole list late it is worse off than by itself."""
        wanted, log = ours("tc016d_beyond")
        by_itself = passing(prepare_log(log, wanted), wanted)["PEM"]
        by_latency = self.at("latency_s")
        assert len(by_latency) == 21
        remote = [shares["remote:0s"] for shares in by_latency.values()]
        assert min(remote) >= by_itself - 1e-12
        assert remote == sorted(remote, reverse=True)
        whole = [shares["coPEM:0s"] for shares in by_latency.values()]
        assert whole == sorted(whole, reverse=True)
        assert whole[0] == pytest.approx(remote[0], abs=1e-12)
        assert whole[-1] < by_itself - 0.5
        assert all(a <= b + 1e-12 for a, b in zip(whole, remote, strict=True))

    def test_more_units_never_harm(self) -> None:
        by_count = self.at("units")
        assert list(by_count) == list(range(21))
        wanted, log = ours("tc016d_beyond")
        alone = passing(prepare_log(log, wanted), wanted)["PEM"]
        for name in ("coPEM:0s", "remote:0s", "remote:0.5s"):
            shares = [at[name] for at in by_count.values()]
            assert shares[0] == pytest.approx(alone, abs=1e-12), "none beside the ego's"
            assert all(b >= a - 1e-12 for a, b in itertools.pairwise(shares))


@pytest.mark.long
def test_more_connected_vehicles_never_harm() -> None:
    """logs/crossing_share.yaml, in closed form: nobody connected is the vehicle on its own; each share is better."""
    wanted, log = ours("crossing_share")
    known: dict[float, pd.Series] = {}
    alone: pd.Series | None = None
    for point in list_points(wanted):
        both = point.experiment.model_copy(update={"configurations": wanted.configurations})
        rows = exact_table(prepare_log(log, both), both)
        rows = rows.assign(tick=(rows["detection_s"] * 10).round())
        by = rows.pivot_table(index=["object_id", "tick"], columns="configuration", values="probability", aggfunc="sum")
        known[point.value] = by["V2V"].dropna().groupby("object_id").cumsum()
        alone = by["onboard"].dropna().groupby("object_id").cumsum()
    assert list(known) == [0, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1]
    assert alone is not None
    common = alone.index.intersection(known[0].index)
    assert len(common) > 1000
    np.testing.assert_allclose(known[0].loc[common], alone.loc[common], atol=1e-9)
    for fewer, more in itertools.pairwise(known.values()):
        both_know = fewer.index.intersection(more.index)
        assert (more.loc[both_know] >= fewer.loc[both_know] - 1e-9).all()


def test_a_sweep_that_changes_nothing_is_said() -> None:
    """The truth has no latency to vary, and nobody is there to carry a unit."""
    truth = {"GT": {"units": "truth"}}
    found = run_experiment(plan({"latency_s": [0, 1]}, configurations=truth), [crossing()])
    assert found.sweep is None
    assert "sweep of latency_s: it changes no configuration" in found.notes
    fresh = truth | {"PEM": {"units": ["ego"]}}
    found = run_experiment(plan({"latency_s": [0, 1]}, configurations=fresh), [crossing()])
    assert found.sweep is None
    assert (
        "sweep of latency_s: it changes no configuration; none states a latency above 0 or by unit, and `sweep: "
        "{configurations: […]}` does not name any"
    ) in found.notes
    units = {"ego": UNITS["ego"], "buses": {"on": {"classes": ["bus"], "penetration_rate": 0.5}, "pem": "p"}}
    found = run_experiment(
        plan({"penetration_rate": [0, 1]}, units=units, configurations={"all": {"units": "all"}}), [crossing()]
    )
    assert any(note.endswith("unit buses: the log has no object to carry it (bus)") for note in found.notes)
