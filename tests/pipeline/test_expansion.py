"""Units that some objects carry and others don't: who does in which run, and what becomes of it.

Where nothing else is said the ego stands at the origin, and so do four vehicles and a pedestrian around it; each list
of a unit holds an object with probability ½.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import scipy.stats
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from copem_replay.cli import main as cli
from copem_replay.core.errors import ExperimentError
from copem_replay.core.tracks import Bool, Int
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import check_against_log, find_problems
from copem_replay.io.recording import Recording
from copem_replay.metrics.detections_table import build_frame
from copem_replay.perception.config import Carriers
from copem_replay.pipeline.closed_form import compute_distributions, exact_table
from copem_replay.pipeline.expansion import ExpandedExperiment, expand_alike, expand_experiment, resolve_for_run
from copem_replay.pipeline.notes import measure_list_rates
from copem_replay.pipeline.prepare import Replay, prepare_log
from copem_replay.pipeline.replay import replay_outcomes
from copem_replay.pipeline.run import run_experiment
from copem_replay.pipeline.tables import add_row_accuracy
from tests.helpers.experiments import changed, source_of
from tests.helpers.recordings import Obj, pedestrian, write_recording
from tests.helpers.replays import study_rows
from tests.helpers.scenes import Thing, driving, experiment, recording, standing
from tests.pipeline.test_closed_form import band, farthest, in_closed_form, same, sure_to

FEW = settings(max_examples=25, suppress_health_check=[HealthCheck.too_slow])  # an example replays a log
RISK = 1e-6
EGO = {"on": "ego", "pem": "p"}
MEASURE: dict[str, Any] = {"objects": {"classes": ["pedestrian"]}, "onset": {"kind": "appears"}}


def things() -> list[Thing]:
    return [
        Thing("ego", "car", standing(0, 0)),
        Thing("12", "car", standing(30, 4)),
        Thing("7", "truck", standing(-20, 4)),
        Thing("w", "pedestrian", standing(15, 12)),
        Thing("3", "car", standing(0, 9)),
        Thing("b", "car", standing(50, -4), size_m=(10, 2.5, 3.2)),
    ]


def street(wanted: Sequence[Thing] | None = None, **changes: Any) -> Recording:
    return recording(things() if wanted is None else wanted, **({"until_s": 1.0} | changes))


def some(share: float, *classes: str, **changes: Any) -> dict[str, Any]:
    """A unit on a share of these classes."""
    return {"on": {"classes": list(classes or ("car",)), "penetration_rate": share}, "pem": "p"} | changes


def plan(units: dict[str, Any], **changes: Any) -> Experiment:
    standard: dict[str, Any] = {
        "runs": 40,
        "pems": {"p": sure_to(0.5)},
        "units": units,
        "configurations": {"all": {"units": "all"}},
        "measure": MEASURE,
    }
    return experiment(**(standard | changes))


def carried(fleet: ExpandedExperiment, runs: int = 500, log: str = "scene") -> Bool:
    there = fleet.equipped(log, np.arange(runs))
    assert there is not None
    return there


def times(table: pd.DataFrame, configuration: str) -> pd.DataFrame:
    """What was detected when, in the order of runs and objects."""
    part = table[table["configuration"] == configuration]
    return part[["run", "object_id", "detection_s", "captured_s"]].reset_index(drop=True)


# ------------------------------------------------------------------------------------------------ expansion


class TestExpansion:
    def test_one_unit_for_each_carrier(self) -> None:
        """In the order of the experiment, then of the log; the ego carries none of them."""
        wanted = plan({"fleet": some(0.3), "ego": EGO, "big": some(1.0, "truck", height_m=2.0)})
        fleet = expand_experiment(wanted, street().scene)
        units = fleet.units
        assert list(units) == ["fleet:12", "fleet:3", "fleet:b", "ego", "big:7"]
        assert [unit.on for unit in units.values()] == ["12", "3", "b", "ego", "7"]
        assert [unit.height_m for unit in units.values()] == [None, None, None, None, 2]
        assert fleet.named == ("fleet", "fleet", "fleet", "ego", "big")
        assert fleet.carrier == ("12", "3", "b", "", "7")
        assert fleet.share.tolist() == [0.3, 0.3, 0.3, 1, 1]

    @pytest.mark.parametrize(
        ("classes", "expected"),
        [
            (["car"], ["12", "3", "b"]),
            (["vehicles"], ["12", "7", "3", "b"]),
            (["truck", "car", "vehicles"], ["12", "7", "3", "b"]),
            (["vru"], ["w"]),
            (["bus"], []),
        ],
    )
    def test_classes_and_groups(self, classes: list[str], expected: list[str]) -> None:
        fleet = expand_experiment(plan({"f": some(0.5, *classes), "ego": EGO}), street().scene)
        assert list(fleet.units) == [*(f"f:{name}" for name in expected), "ego"]

    def test_the_ego_by_any_choice_carries_none(self) -> None:
        scene = street(ego="12").scene
        assert expand_experiment(plan({"f": some(0.5)}), scene).carrier == ("ego", "3", "b")
        assert expand_experiment(plan({"f": some(0.5)}), street(ego=None).scene).carrier == ("ego", "12", "3", "b")

    def test_parked_ones_may_carry_one_too(self) -> None:
        parked = Thing("p", "car", standing(9, 9), moving=False)
        assert expand_experiment(plan({"f": some(0.5)}), street([*things(), parked]).scene).carrier[-1] == "p"

    def test_configurations_name_them_by_the_unit(self) -> None:
        wanted = plan(
            {"ego": EGO, "fleet": some(0.3), "big": some(0.5, "truck")},
            configurations={
                "GT": {"units": "truth", "latency_s": 0.1},
                "all": {"units": "all", "latency_s": {"ego": 0.0, "default": 0.3}},
                "some": {"units": ["fleet", "ego"], "latency_s": {"fleet": 0.2, "big": 0.4, "default": 0.1}},
            },
        )
        expanded = expand_experiment(wanted, street().scene)
        truth, everyone, part = expanded.configurations.values()
        assert truth == wanted.configurations["GT"]
        assert everyone == wanted.configurations["all"]
        assert expanded.units_of(everyone) == ("ego", "fleet:12", "fleet:3", "fleet:b", "big:7")
        assert part.units == ("fleet:12", "fleet:3", "fleet:b", "ego")
        assert expanded.units_of(part) == ("ego", "fleet:12", "fleet:3", "fleet:b")
        assert [part.latency_of(name) for name in ("ego", "fleet:12", "fleet:b", "big:7")] == [0.1, 0.2, 0.2, 0.4]

    def test_latency_by_the_units_name(self) -> None:
        """The pedestrian is known 0.2 s after a capture, by whomever."""
        late = {"late": {"units": ["fleet"], "latency_s": {"fleet": 0.2, "default": 0.05}}}
        found = study_rows(run_experiment(plan({"fleet": some(0.7)}, configurations=late), [street()]))
        seen = found[found["detected"]]
        assert len(seen) > 20
        np.testing.assert_allclose(seen["detection_s"] - seen["captured_s"], 0.2)

    def test_nothing_to_expand(self) -> None:
        wanted = plan({"ego": EGO, "v2v": {"on": "7", "pem": "p"}})
        fleet = expand_experiment(wanted, street().scene)
        assert fleet.units is wanted.units
        assert fleet.equipped("scene", np.arange(3)) is None
        assert resolve_for_run(wanted, street().scene, 0) is wanted

    def test_other_configurations_of_the_same_units(self) -> None:
        late = {"late": {"units": ["fleet"], "latency_s": {"fleet": 0.2, "default": 0.05}}}
        first, other = (
            plan({"fleet": some(0.5), "ego": EGO}),
            plan({"fleet": some(0.5), "ego": EGO}, configurations=late),
        )
        found, expected = (
            expand_alike(other, expand_experiment(first, street().scene)),
            expand_experiment(other, street().scene),
        )
        assert found.configurations == expected.configurations
        assert found.units == expected.units
        assert (found.named, found.facts) == (expected.named, expected.facts)
        assert expand_alike(found, expected) is found, "resolved once"
        with pytest.raises(ValueError, match="the units that the log was prepared for"):
            expand_alike(plan({"fleet": some(0.6), "ego": EGO}), found)

    def test_no_carrier_in_the_log(self) -> None:
        """As if there were no such unit."""
        both = {"all": {"units": "all"}, "none": {"units": ["f"]}}
        wanted = plan({"ego": EGO, "f": some(0.9, "bus")}, configurations=both)
        found = study_rows(run_experiment(wanted, [street()]))
        alone = study_rows(run_experiment(plan({"ego": EGO}), [street()]))
        pd.testing.assert_frame_equal(times(found, "all"), times(alone, "all"))
        assert not found[found["configuration"] == "none"]["detected"].any()

    def test_each_log_has_carriers_of_its_own(self) -> None:
        other = street([Thing("ego", "car", standing(0, 0)), Thing("w", "pedestrian", standing(5, 5)),
                        Thing("x", "car", standing(9, 9))], log="other")  # fmt: skip
        found = study_rows(run_experiment(plan({"f": some(0.9)}), [street(), other]))
        seen = found.dropna(subset="first_unit").groupby("log")["first_unit"].unique()
        assert set(seen["scene"]) == {"f:12", "f:3", "f:b"}
        assert set(seen["other"]) == {"f:x"}

    def test_no_other_unit_may_have_such_a_name(self) -> None:
        """Where there is such an object; elsewhere it is a name like any other."""
        mast = {"at": [0, 0], "height_m": 3.0, "pem": "p"}
        wanted = plan({"ego": EGO, "fleet": some(0.5), "fleet:12": mast})
        (found,) = check_against_log(wanted, street())
        assert found == (("units", "fleet:12"), "this is the name of fleet on object 12")
        with pytest.raises(ExperimentError, match="fleet:12 is what fleet is called on object 12") as caught:
            prepare_log(street(), wanted)
        assert len(caught.value.problems) == 1
        wanted = plan({"ego": EGO, "fleet": some(0.5), "fleet:99": mast})
        assert list(check_against_log(wanted, street())) == []
        assert list(expand_experiment(wanted, street().scene).units)[-1] == "fleet:99"


# ------------------------------------------------------------------------------------- who carries one, and when


class TestShare:
    @settings(max_examples=50)  # an example replays a log
    @given(st.floats(0, 1), st.floats(0, 1), st.integers(-3, 3))
    def test_who_does_at_a_share_does_at_a_larger_one(self, a: float, b: float, seed: int) -> None:
        scene = street().scene
        fewer, more = (carried(expand_experiment(plan({"e": EGO, "f": some(x)}, seed=seed), scene), 100)
                       if x < 1 else np.ones((100, 4), dtype=bool) for x in sorted((a, b)))  # fmt: skip
        assert not (fewer & ~more).any()

    def test_thirty_of_a_hundred_are_among_fifty(self) -> None:
        scene = street().scene
        thirty, fifty = (carried(expand_experiment(plan({"f": some(x)}), scene)) for x in (0.3, 0.5))
        assert not (thirty & ~fifty).any()
        assert (fifty & ~thirty).any(axis=0).all()

    def test_the_share_is_that_of_all_runs_and_of_each_carrier(self) -> None:
        """Counts by the binomial distribution; so are pairs, of carriers and of units: each draws by itself."""
        units = {"e": EGO, "f": some(0.3, "vehicles"), "g": some(0.6, "vehicles")}
        fleet = expand_experiment(plan(units), street().scene)
        runs = 4000
        there = carried(fleet, runs)
        assert there[:, 0].all()
        checks = [(there[:, k], float(fleet.share[k])) for k in range(1, 9)]
        checks += [(a & b, p * q) for (a, p), (b, q) in itertools.combinations(checks, 2)]
        for flags, probability in checks:
            law = scipy.stats.binom(runs, probability)
            assert min(law.cdf(flags.sum()), law.sf(flags.sum() - 1)) > RISK / (2 * len(checks))

    def test_runs_logs_and_seeds_draw_anew(self) -> None:
        wanted = plan({"f": some(0.5, "vehicles")})
        fleet = expand_experiment(wanted, street().scene)
        here = carried(fleet)
        others = [
            carried(fleet, log="other"),
            carried(expand_experiment(wanted.model_copy(update={"seed": 8}), street().scene)),
            np.roll(here, 1, axis=0),
            np.roll(here, 1, axis=1),
        ]
        for other in others:
            agree = int((here == other).sum())
            law = scipy.stats.binom(here.size, 0.5)
            assert min(law.cdf(agree), law.sf(agree - 1)) > RISK / 2

    def test_a_run_by_itself(self) -> None:
        fleet = expand_experiment(plan({"f": some(0.4), "e": EGO}), street().scene)
        whole = carried(fleet, 60)
        for k in (0, 1, 17, 59):
            one = fleet.equipped("scene", np.array([k]))
            assert one is not None
            assert one.tolist() == [whole[k].tolist()]

    def test_the_order_of_objects_and_other_units_do_not_matter(self) -> None:
        def by_name(wanted: dict[str, Any], log: Recording) -> dict[str, list[bool]]:
            fleet = expand_experiment(plan(wanted), log.scene)
            return dict(zip(fleet.units, carried(fleet, 80).T.tolist(), strict=True))

        usual = by_name({"ego": EGO, "f": some(0.4)}, street())
        turned = by_name({"f": some(0.4), "ego": EGO}, street(things()[::-1]))
        more = by_name({"a": some(0.9, "truck"), "f": some(0.4, "vehicles"), "ego": EGO}, street())
        for name, there in usual.items():
            assert turned[name] == there
            assert more[name] == there

    def test_the_name_of_the_unit_does(self) -> None:
        """Two units on the same objects are not carried together."""
        fleet = expand_experiment(plan({"f": some(0.5), "g": some(0.5)}), street().scene)
        there = carried(fleet)
        assert (there[:, :3] != there[:, 3:]).any(axis=0).all()


CONFIGURATIONS = {
    "ego": {"units": ["ego"]},
    "all": {"units": "all", "latency_s": {"ego": 0.0, "default": 0.15}},
    "fleet": {"units": ["fleet"], "latency_s": 0.1},
}
CONFIRMS = [{"hits": 1, "of": 1}, {"hits": 2, "of": 3}, {"hits": 3, "of": 3}]


def on_the_move() -> Recording:
    """Carriers that come and go, and two pedestrians."""
    return street(
        [
            Thing("ego", "car", driving(0, 0, 5)),
            Thing("12", "car", driving(40, 4, -6), lambda t: t < 1.15),
            Thing("w", "pedestrian", driving(20, 8, 0, -1)),
            Thing("3", "car", driving(60, -4, -8), lambda t: not 0.45 < t < 1.35),
            Thing("v", "pedestrian", driving(30, -8, 0, 1), lambda t: t > 0.75),
        ],
        until_s=2.0,
    )


class TestRuns:
    @pytest.mark.parametrize("confirm", CONFIRMS)
    def test_nobody(self, confirm: dict[str, int]) -> None:
        """A share of 0 is the configuration without it."""
        units = {"ego": EGO, "fleet": some(0.0)}
        wanted = plan(units, configurations=CONFIGURATIONS, measure=MEASURE | {"confirm": confirm})
        found = study_rows(run_experiment(wanted, [on_the_move()]))
        pd.testing.assert_frame_equal(times(found, "all"), times(found, "ego"))
        assert not found[found["configuration"] == "fleet"]["detected"].any()
        assert set(found["first_unit"].dropna()) == {"ego"}

    @pytest.mark.parametrize("confirm", CONFIRMS)
    def test_everybody(self, confirm: dict[str, int]) -> None:
        """A share of 1 is every carrier named as a unit of its own, to the last bit."""
        names = {name: {"on": name.partition(":")[2], "pem": "p"} for name in ("fleet:12", "fleet:3")}
        measure = MEASURE | {"confirm": confirm}
        whole = plan({"ego": EGO, "fleet": some(1.0)}, configurations=CONFIGURATIONS, measure=measure)
        each = plan(
            {"ego": EGO, **names},
            configurations=CONFIGURATIONS | {"fleet": {"units": list(names), "latency_s": 0.1}},
            measure=measure,
        )
        log = on_the_move()
        pd.testing.assert_frame_equal(
            study_rows(run_experiment(whole, [log])), study_rows(run_experiment(each, [log])), check_exact=True
        )
        assert measure_list_rates(prepare_log(log, whole), whole) == measure_list_rates(prepare_log(log, each), each)

    @pytest.mark.parametrize(
        ("confirm", "accuracy"), [(CONFIRMS[0], True), *((confirm, False) for confirm in CONFIRMS)]
    )
    @pytest.mark.parametrize(
        "units", [{"ego": EGO, "fleet": some(0.5)}, {"fleet": some(0.5), "ego": EGO, "g": some(0.3)}]
    )
    def test_a_run_by_itself(self, confirm: dict[str, int], accuracy: bool, units: dict[str, Any]) -> None:
        """With the units that are carried in it and no others. How far off lists are has nothing to do with hits."""
        measure = MEASURE | {"confirm": confirm, "accuracy": accuracy}
        wanted = plan(units, configurations=CONFIGURATIONS, measure=measure)
        one_by_one(wanted, on_the_move())
        # One hit without lists to be judged is settled for all runs at once, else for those of the same units.
        parts = replay_outcomes(prepare_log(on_the_move(), wanted), wanted, np.arange(40))
        assert (len(parts) == 1) == (confirm == CONFIRMS[0] and not accuracy)

    def test_one_block_or_many(self) -> None:
        wanted = plan({"ego": EGO, "fleet": some(0.5)}, configurations=CONFIGURATIONS)
        ready = prepare_log(on_the_move(), wanted)
        whole = block(ready, wanted, np.arange(40))
        parts = pd.concat([block(ready, wanted, np.arange(k, k + 5)) for k in range(0, 40, 5)])
        order = ["configuration", "run", "object_id"]
        pd.testing.assert_frame_equal(
            whole.sort_values(order, ignore_index=True), parts.sort_values(order, ignore_index=True)
        )
        log = on_the_move()
        assert study_rows(run_experiment(wanted, [log], jobs=2)).equals(study_rows(run_experiment(wanted, [log])))

    def test_more_carriers_are_never_later(self) -> None:
        """By the same draws, run by run and object by object."""
        shares = (0.0, 0.2, 0.5, 0.9, 1.0)
        found = [
            times(study_rows(run_experiment(plan({"ego": EGO, "fleet": some(s)}, runs=200), [on_the_move()])), "all")
            for s in shares
        ]
        for fewer, more in itertools.pairwise(found):
            assert (more["detection_s"].fillna(np.inf) <= fewer["detection_s"].fillna(np.inf)).all()
        assert (found[-1]["detection_s"].fillna(np.inf) < found[0]["detection_s"].fillna(np.inf)).any()

    def test_a_fleet_leaves_the_draws_of_others_as_they_are(self) -> None:
        without = study_rows(
            run_experiment(plan({"ego": EGO}, configurations={"ego": {"units": ["ego"]}}), [on_the_move()])
        )
        wanted = plan({"fleet": some(0.5), "ego": EGO}, configurations=CONFIGURATIONS)
        found = study_rows(run_experiment(wanted, [on_the_move()]))
        pd.testing.assert_frame_equal(times(found, "ego"), times(without, "ego"))

    def test_the_order_of_objects_does_not_matter(self) -> None:
        log = on_the_move()
        wanted = plan({"ego": EGO, "fleet": some(0.5)}, configurations=CONFIGURATIONS)
        usual = study_rows(run_experiment(wanted, [log]))
        members = [
            Thing("v", "pedestrian", driving(30, -8, 0, 1), lambda t: t > 0.75),
            Thing("3", "car", driving(60, -4, -8), lambda t: not 0.45 < t < 1.35),
            Thing("w", "pedestrian", driving(20, 8, 0, -1)),
            Thing("12", "car", driving(40, 4, -6), lambda t: t < 1.15),
            Thing("ego", "car", driving(0, 0, 5)),
        ]
        turned = study_rows(run_experiment(wanted, [street(members, until_s=2.0)]))
        order = ["configuration", "run", "object_id"]
        columns = [name for name in usual if name != "first_unit"]  # of two at one instant the experiment's first
        pd.testing.assert_frame_equal(
            usual.sort_values(order, ignore_index=True)[columns], turned.sort_values(order, ignore_index=True)[columns]
        )

    @pytest.mark.parametrize(
        "units",
        [
            # Ego and mast list four times a second, 60 ms apart: one instant of capture. Ten lists a second of a car
            # that carries no unit in a run make them two.
            {
                "ego": EGO | {"rate_hz": 4},
                "mast": {"at": [5, 5], "height_m": 3.0, "pem": "p", "rate_hz": 4, "phase_s": 0.06},
                "fleet": some(0.5),
            },
            # Rates and phases of their own.
            {
                "ego": EGO,
                "f": some(0.5, rate_hz=7, phase_s=0.03),
                "g": some(0.5, "car", rate_hz=20),
                "mast": {"at": [5, 5], "height_m": 3.0, "pem": "p", "rate_hz": 3},
            },
            # Nobody lists from 0.6 to 0.9 s where a and c carry a unit and b does not: 0.5 and 1.0 s are consecutive.
            {"fleet": some(0.5, "truck")},
        ],
    )
    def test_confirmation_by_others(self, units: dict[str, Any]) -> None:
        trucks = [
            Thing("a", "truck", standing(30, 14), lambda t: t < 0.55),
            Thing("b", "truck", standing(60, -14)),
            Thing("c", "truck", standing(60, -19), lambda t: t > 0.95),
        ]
        log = street([Thing("ego", "car", standing(0, 0)), Thing("w", "pedestrian", driving(25, 6, 0, -1)), *trucks],
                     until_s=2.0)  # fmt: skip
        if "ego" in units:
            log = on_the_move()
        measure = MEASURE | {"confirm": {"hits": 2, "of": 2}, "accuracy": False}
        wanted = plan(units, runs=300, pems={"p": sure_to(0.3)}, measure=measure)
        one_by_one(wanted, log)

    @staticmethod
    def meeting(share: float, fleet: dict[str, Any], **changes: Any) -> tuple[Experiment, Recording]:
        """A pedestrian steps into the ego's way; a car comes towards it."""
        log = street(
            [
                Thing("ego", "car", driving(-30, 0, 10)),
                Thing("c", "car", driving(10, 4, -9)),
                Thing("w", "pedestrian", driving(0, -3, 0, 1)),
            ],
            until_s=4.0,
        )
        error = {"kind": "gaussian", "covariance_m2": [[1.0, 0.0], [0.0, 1.0]]}
        wanted = plan(
            {"ego": EGO, "fleet": some(share) | fleet},
            runs=60,
            pems={"p": [sure_to(0.3)[0] | {"error": error}]},
            configurations={
                "ego": {"units": ["ego"]},
                "all": {"units": "all", "latency_s": {"ego": 0.0, "default": 0.25}} | changes,
            },
            measure=MEASURE | {"conflict": {"horizon_s": 2.0}},
        )
        return wanted, log

    def test_conflicts_foreseen_by_nobody_else(self) -> None:
        """With a share of 0 a conflict is foreseen when the ego alone foresees it: at its own lists."""
        wanted, log = self.meeting(0.0, {})
        found = study_rows(run_experiment(wanted, [log])).set_index(["run", "object_id"])
        alone, everyone = (found.loc[found["configuration"] == name, "conflict_detection_s"] for name in ("ego", "all"))
        assert alone.notna().any()
        pd.testing.assert_series_equal(everyone, alone)

    @pytest.mark.parametrize("fusion", ["samples", "posterior"])
    @pytest.mark.parametrize("fleet", [{}, {"rate_hz": 7, "phase_s": 0.03}])
    def test_conflicts_foreseen_in_a_run_by_itself(self, fleet: dict[str, Any], fusion: str) -> None:
        wanted, log = self.meeting(0.5, fleet, fusion={"kind": "ideal", "combine": fusion})
        one_by_one(wanted, log)


def block(ready: Replay, wanted: Experiment, runs: Int) -> pd.DataFrame:
    """The rows of some runs, how far off the lists were among them."""
    return pd.concat(
        [build_frame(add_row_accuracy(part)) for part in replay_outcomes(ready, wanted, runs)], ignore_index=True
    )


def one_by_one(wanted: Experiment, log: Recording) -> None:
    """Each run, replayed with its own units alone, gives the rows that it has among the others."""
    whole = study_rows(run_experiment(wanted, [log]))
    for _, part in whole.groupby("configuration"):
        assert part["run"].is_monotonic_increasing
    for k in range(wanted.runs):
        alone = resolve_for_run(wanted, log.scene, k)
        assert not any(isinstance(unit.on, Carriers) for unit in alone.units.values())
        found = block(prepare_log(log, alone), alone, np.array([k]))
        expected = whole[whole["run"] == k].reset_index(drop=True)
        pd.testing.assert_frame_equal(found, expected, check_dtype=False, check_exact=True)


# ------------------------------------------------------------------------------------------------- in closed form


@st.composite
def traffic(draw: st.DrawFn) -> tuple[Recording, Experiment]:
    """One to four carriers that come and go, at shares of two units, beside the ego and a mast or without."""
    members = [Thing("ego", "car", standing(0, 0)), Thing("w", "pedestrian", standing(15, 9))]
    for k in range(draw(st.integers(1, 4))):
        first, length = draw(st.integers(0, 5)), draw(st.integers(1, 8))
        there: Any = lambda t, a=first, b=first + length: a <= round(t * 10) <= b  # noqa: E731
        members.append(Thing(f"c{k}", draw(st.sampled_from(["car", "truck"])), standing(30 + 8 * k, 4), there))
    shares = st.sampled_from([0.0, 0.125, 0.3, 0.5, 0.9, 1.0])
    units: dict[str, Any] = {"f": some(draw(shares), "car", rate_hz=draw(st.sampled_from([None, 4.0, 20.0])))}
    if draw(st.booleans()):
        units |= {"g": some(draw(shares), "truck", pem="q")}
    if draw(st.booleans()):
        units |= {"ego": EGO}
    if draw(st.booleans()):
        units |= {"mast": {"at": [9, -9], "height_m": 4.0, "pem": "q", "rate_hz": 5.0}}
    late = {"default": draw(st.sampled_from([0.0, 0.1, 0.25])), "f": draw(st.sampled_from([0.0, 0.13]))}
    wanted = plan(
        units,
        pems={"p": sure_to(0.3), "q": sure_to(0.7)},
        configurations={"all": {"units": "all", "latency_s": late}},
        measure=MEASURE | {"count_earlier": draw(st.booleans()), "onset": {"kind": "at", "time_s": 0.33}},
    )
    return street(members), wanted


class TestClosedForm:
    @FEW
    @given(traffic())
    def test_over_all_who_may_carry_one(self, given_: tuple[Recording, Experiment]) -> None:
        """The mixture, by the probability of each set of carriers, of the times with these carriers for certain."""
        log, wanted = given_
        ready = prepare_log(log, wanted)
        fleet = ready.expanded
        found = in_closed_form(ready, wanted)["w"]
        unsure = [name for name, share in zip(fleet.units, fleet.share, strict=True) if share < 1]
        share_of = dict(zip(fleet.units, fleet.share.tolist(), strict=True))
        expected: dict[int | None, float] = {}
        for outcome in itertools.product((True, False), repeat=len(unsure)):
            out = [name for name, on in zip(unsure, outcome, strict=True) if not on]
            weight = math.prod(share_of[n] if on else 1 - share_of[n] for n, on in zip(unsure, outcome, strict=True))
            kept = {name: unit for name, unit in fleet.units.items() if name not in out}
            certain = wanted.model_copy(update={"units": kept, "configurations": fleet.configurations})
            for t, p in in_closed_form(prepare_log(log, certain), certain)["w"].items():
                expected[t] = expected.get(t, 0.0) + weight * p
        same(found, expected)

    def test_over_all_outcomes_of_all_lists(self) -> None:
        """Two carriers, three lists each: 2⁸ outcomes of who carries and what is held."""
        log = street(
            [
                Thing("ego", "car", standing(0, 0)),
                Thing("w", "pedestrian", standing(15, 9)),
                Thing("a", "car", standing(9, 4)),
                Thing("b", "car", standing(9, -4), lambda t: t > 0.05),
            ],
            until_s=0.2,
        )
        wanted = plan({"f": some(0.3)}, pems={"p": sure_to(0.4)})
        lists = [("a", 0), ("a", 100), ("a", 200), ("b", 100), ("b", 200)]
        expected: dict[int | None, float] = {}
        for on in itertools.product((True, False), repeat=2):
            for held in itertools.product((True, False), repeat=5):
                weight = math.prod(0.3 if x else 0.7 for x in on) * math.prod(0.4 if x else 0.6 for x in held)
                carries = dict(zip("ab", on, strict=True))
                known = [t for (name, t), x in zip(lists, held, strict=True) if x and carries[name]]
                key = min(known, default=None)
                expected[key] = expected.get(key, 0.0) + weight
        found = in_closed_form(prepare_log(log, wanted), wanted)["w"]
        same(found, expected)
        # By hand: at 0 s by a alone, 0.3 · 0.4; never if both are without or miss it.
        assert found[0] == pytest.approx(0.12)
        assert found[None] == pytest.approx((0.7 + 0.3 * 0.6**3) * (0.7 + 0.3 * 0.6**2))

    def test_it_is_the_unit_that_is_there_or_not_not_each_list(self) -> None:
        """One carrier, share ½, sure to see: known at once or never."""
        members = [Thing("ego", "car", standing(0, 0)), Thing("w", "pedestrian", standing(15, 9)),
                   Thing("a", "car", standing(9, 4))]  # fmt: skip
        wanted = plan({"f": some(0.5)}, pems={"p": sure_to(1.0)}, measure=MEASURE | {"exact": True}, runs=300)
        result = run_experiment(wanted, [street(members)])
        assert result.exact is not None
        assert [p for p in result.exact["probability"] if p > 0] == [0.5, 0.5]
        assert set(study_rows(result)["time_to_detection_s"].dropna()) == {0.0}
        row = result.summary.iloc[0]
        assert row["detected_share_exact"] == 0.5
        assert row["detected_share_low"] < 0.5 < row["detected_share_high"]

    def test_the_runs_are_within_the_band(self) -> None:
        wanted = plan(
            {"ego": EGO | {"pem": "q"}, "fleet": some(0.3), "mast": {"at": [9, -9], "height_m": 4.0, "pem": "q"}},
            runs=2000,
            pems={"p": sure_to(0.5), "q": sure_to(0.05)},
            configurations=CONFIGURATIONS | {"mast": {"units": ["fleet", "mast"]}},
            measure=MEASURE | {"exact": True},
        )
        result = run_experiment(wanted, [on_the_move()])
        assert result.exact is not None
        keys = ["configuration", "object_id"]
        runs = dict(iter(study_rows(result).groupby(keys)))
        parts = dict(iter(result.exact.groupby(keys)))
        assert len(parts) == 4 * 2
        for key, part in parts.items():
            far = farthest(runs[key]["detection_s"].to_numpy(), part)
            assert far <= band(2000, RISK / len(parts)), key
        for row in result.summary.itertuples():
            assert row.detected_share == pytest.approx(row.detected_share_exact, abs=0.06)

    def test_shares_of_nobody_and_of_everybody(self) -> None:
        log = on_the_move()

        def rows(units: dict[str, Any], name: str) -> list[tuple[float, float]]:
            wanted = plan(units, configurations=CONFIGURATIONS)
            found = compute_distributions(prepare_log(log, wanted), wanted, name)[0]
            return [(t, p) for t, p in zip(found.time_s.tolist(), found.probability.tolist(), strict=True) if p > 0]

        assert rows({"ego": EGO, "fleet": some(0.0)}, "all") == rows({"ego": EGO, "fleet": some(0.0)}, "ego")
        assert rows({"ego": EGO, "fleet": some(0.0)}, "fleet") == []
        whole = {"ego": EGO, "fleet": some(1.0)}
        nearly = {"ego": EGO, "fleet": some(1.0 - 1e-12)}
        np.testing.assert_allclose(rows(whole, "all"), rows(nearly, "all"), atol=1e-11)

    def test_several_hits_have_none(self) -> None:
        wanted = plan({"ego": EGO, "fleet": some(0.1)}, measure=MEASURE | {"confirm": {"hits": 2, "of": 3}})
        log = street(things())
        with pytest.raises(ExperimentError, match="closed form") as caught:
            exact_table(prepare_log(log, wanted), wanted)
        assert len(caught.value.problems) == 1


# ------------------------------------------------------------------------------------------------- on the roof


def over_a_wall() -> Recording:
    """A wall, 2 m high and 0.1 m thin, 10 m ahead of a van (3 m) and a car (1.5 m, 6 m farther back).

    20 m ahead of the van a pedestrian, 1.8 m high and 0.5 m deep. From the van's roof one sees over the far edge of the
    wall, 10.05 m ahead: at his near side, 19.75 m ahead, down to 3 − 19.75 / 10.05 = 1.035 m. From the car's: nothing.
    """
    return street(
        [
            Thing("ego", "car", standing(0, -40)),
            Thing("van", "truck", standing(0, 0), size_m=(4.0, 2.0, 3.0)),
            Thing("low", "car", standing(-6, 0)),
            Thing("w", "pedestrian", standing(20, 0)),
            Thing("wall", "other", standing(10, 0), size_m=(0.1, 6.0, 2.0), moving=False),
        ],
        until_s=0.2,
    )


VISIBLE = (1.8 - (3 - 19.75 / 10.05)) / 1.8


@pytest.mark.parametrize(
    ("unit", "expected"),
    [
        (some(0.5, "truck"), VISIBLE),
        (some(0.5, "truck", height_m=3.0), VISIBLE),
        (some(0.5, "truck", height_m=1.5), 0),
        (some(0.5, "car"), 0),
        (some(0.5, "car", height_m=30.0), 1),
        ({"on": "van", "pem": "p"}, VISIBLE),
        ({"on": "low", "pem": "p"}, 0),
    ],
)
def test_a_carried_unit_is_on_the_roof_by_default(unit: dict[str, Any], expected: float) -> None:
    ready = prepare_log(over_a_wall(), plan({"f": unit}))
    assert len(ready.measured.view.visible_share) == 3
    assert ready.measured.view.visible_share == pytest.approx(expected, abs=1e-6)


# -------------------------------------------------------------------------------------------- one run, and results


class TestOfRun:
    def test_only_what_is_carried_in_it(self) -> None:
        wanted = plan(
            {"fleet": some(0.5), "ego": EGO},
            configurations={
                "part": {"units": ["ego", "fleet"], "latency_s": {"fleet": 0.3, "default": 0.1}},
                "fleet": {"units": ["fleet"]},
                "GT": {"units": "truth"},
            },
        )
        scene = street().scene
        fleet = expand_experiment(wanted, scene)
        there = carried(fleet, 40)
        assert len({tuple(row) for row in there}) == 8, "all sets of three carriers"
        for k in range(40):
            one = resolve_for_run(wanted, scene, k)
            kept = [name for name, on in zip(fleet.units, there[k], strict=True) if on]
            assert list(one.units) == kept
            assert one.units_of(one.configurations["fleet"]) == tuple(kept[:-1])
            assert one.units_of(one.configurations["part"]) == tuple(kept)
            late = [one.configurations["part"].latency_of(name) for name in kept]
            assert late == [0.3] * (len(kept) - 1) + [0.1]
            assert one.configurations["GT"] == wanted.configurations["GT"]
            assert expand_experiment(one, scene).equipped("scene", np.arange(3)) is None

    def test_onsets_are_those_of_all_runs(self) -> None:
        """`line_of_sight_any` does not ask who is only in some runs; no more in a run that is looked at alone."""
        log = street(
            [
                Thing("ego", "car", standing(0, 0)),
                Thing("van", "car", standing(20, 20)),
                Thing("w", "pedestrian", driving(20, 0, 0, 1)),
                Thing("wall", "other", standing(10, -2), size_m=(0.1, 6.0, 4.0), moving=False),
            ],
            until_s=5.0,
        )
        onset = {"onset": {"kind": "line_of_sight_any", "visible_share": 0.5}}
        wanted = plan({"ego": EGO, "f": some(0.5)}, measure={"objects": {"classes": ["pedestrian"]}} | onset)
        expected = prepare_log(log, wanted).episodes.onset_s.tolist()
        assert expected == pytest.approx([2.0], abs=0.15)
        for k in range(6):
            alone = resolve_for_run(wanted, log.scene, k)
            assert prepare_log(log, alone, onsets_of=wanted).episodes.onset_s.tolist() == expected


TEXT = """\
version: 1
logs: [square.mcap]
runs: 6
pems:
  p: [{detection: {kind: constant, probability: 1.0}, error: {kind: gaussian, covariance_m2: [[1, 0], [0, 1]]}}]
units:
  ego: {on: ego, pem: p}
  fleet: {on: {classes: [car], penetration_rate: 0.5}, pem: p}
configurations:
  GT: {units: truth}
  V2V: {units: all, latency_s: {ego: 0, default: 0.2}}
measure: {objects: {classes: [pedestrian]}, onset: {kind: appears}, began: [log_start, appeared], exact: true}
show: {run: SHOWN}
"""


@pytest.mark.parametrize("shown", [0, 5])
def test_the_run_that_is_shown_has_its_own_units(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], shown: int
) -> None:
    """The command, its MCAP and its .rrd: of six cars those that carry a unit in that run, and no others."""
    from rerun.chunk import RrdReader

    cars = [Obj(id=k, x=8.0 * k, y=6.0) for k in range(2, 8)]
    frames = [(0.1 * k, [Obj(id=1, x=0.0), *cars, pedestrian(9, 20.0, -5.0 + 0.1 * k, vy=1.0)]) for k in range(6)]
    write_recording(tmp_path / "square.mcap", frames, host=1)
    (tmp_path / "e.yaml").write_text(TEXT.replace("SHOWN", str(shown)))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["copem-replay", "run", "e.yaml"])
    assert cli._run_to_exit_code() == 0, capsys.readouterr().err
    folder = tmp_path / "out" / "e"
    names = {path.name for path in folder.iterdir()}
    assert names == {
        "experiment.yaml", "provenance.json", "detections.parquet", "tally.parquet", "logs.csv", "read.csv",
        "summary.csv",
        "exact.parquet", "replay.mcap", "replay.rrd", "bands.csv", "lists.parquet", "thresholds.parquet",
        "accuracy.parquet", "false_tracks.parquet", "instants.parquet", "made.jsonl",
    }  # fmt: skip
    # Lists of a run come when its own units send them: there are no instants that all runs have.
    assert "run" in pd.read_parquet(folder / "instants.parquet")
    source = source_of(folder, (folder / "experiment.yaml").read_text())
    wanted, found = find_problems(source)
    assert wanted is not None, found
    assert found == []
    assert wanted.units["fleet"].on == Carriers(classes=("car",), penetration_rate=0.5)

    scene = street([Thing("1", "car", standing(0, 0)), *(Thing(str(k), "car", standing(9, 9)) for k in range(2, 8))],
                   ego="1", log="square").scene  # fmt: skip
    expected = list(resolve_for_run(wanted, scene, shown).units)
    assert 1 < len(expected) < 7
    entries: set[str] = set()
    with (folder / "replay.mcap").open("rb") as file:
        reader = make_reader(file)
        for _, _, message in reader.iter_messages(topics=["copem/V2V/detail"]):
            for item in json.loads(message.data)["objects"]:
                entries |= set(item["units"])
        numbered = {
            name
            for record in reader.iter_metadata()
            for key, name in record.metadata.items()
            if key.startswith("unit.")
        }
    assert entries == set(expected)
    assert numbered - {"truth"} == set(expected)
    rows = pd.read_parquet(folder / "detections.parquet")
    firsts = rows.loc[(rows["run"] == shown) & (rows["configuration"] == "V2V"), "first_unit"]
    assert set(firsts) <= set(expected)

    paths = {chunk.entity_path for chunk in RrdReader(folder / "replay.rrd").stream()}
    places = {
        path.removeprefix("/world/units/").replace("\\", "") for path in paths if path.startswith("/world/units/")
    }
    assert places == set(expected)


# ---------------------------------------------------------------------------------------------------- the checks

FLEET = "  mast: {on: {classes: [car], penetration_rate: 0.5}, pem: onboard}"


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ([FLEET], []),
        ([FLEET.replace("0.5", "0")], []),
        ([FLEET.replace("0.5", "1")], []),
        ([FLEET, "measure: {confirm: {hits: 2, of: 3}}"], []),
        (
            [FLEET, "measure: {distance_to: mast}"],
            ["17: measure.distance_to: unit 'mast' is carried by several objects; name a single one"],
        ),
        ([FLEET.replace("pem", "rate_hz: 5, pem"), "measure: {confirm: {hits: 2, of: 3}}"], []),
        (
            [FLEET, "measure: {confirm: {hits: 2, of: 3}, exact: true}"],
            [
                "17: measure.exact: unit 'mast' is only in some runs, and confirmation by several hits then has "
                "no closed form; confirm with one hit"
            ],
        ),
        ([FLEET, "measure: {confirm: {hits: 1, of: 3}, exact: true}"], []),
        ([FLEET, "measure: {exact: true}"], []),
        ([FLEET.replace("0.5", "1.5")], ["12: units.mast.on.penetration_rate: expected at most 1, found 1.5"]),
        ([FLEET.replace("0.5", "-0.1")], ["12: units.mast.on.penetration_rate: expected at least 0, found -0.1"]),
        ([FLEET.replace("0.5", "half")], ["12: units.mast.on.penetration_rate: expected a number, found 'half'"]),
        ([FLEET.replace(", penetration_rate: 0.5", "")], ["12: units.mast.on.penetration_rate: missing"]),
        ([FLEET.replace("classes: [car], ", "")], ["12: units.mast.on.classes: missing"]),
        (
            [FLEET.replace("[car]", "[car, tram]")],
            [
                "12: units.mast.on.classes[1]: expected one of pedestrian, bicycle, motorcycle, car, van, truck, bus, "
                "trailer, animal, other, vehicle, vru, vehicles; found 'tram'"
            ],
        ),
        (
            [FLEET.replace("pem", "at: [1, 2], pem")],
            [
                "12: units.mast: expected one of `on: ego`, `on: <object id>`, `on: {classes, penetration_rate}`, "
                "`at: [x, y]` and `at_wgs84: [latitude, longitude]`"
            ],
        ),
        ([FLEET.replace("onboard", "onbord")], ["12: units.mast.pem: no PEM is named 'onbord'; did you mean onboard?"]),
        (
            [FLEET, "  coPEM: {units: all, latency_s: {'mast:2': 0.5}}"],
            ["16: configurations.coPEM.latency_s.mast:2: no unit is named 'mast:2'; did you mean mast?"],
        ),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_fleet(tmp_path: Path, changes: list[str], expected: list[str]) -> None:
    (tmp_path / "drive.mcap").touch()
    source = source_of(tmp_path, changed(*changes))
    assert [line.removeprefix(f"{source.path}:") for line in find_problems(source)[1]] == expected
