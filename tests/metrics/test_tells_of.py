"""Of which instant an entry tells: a property of the fusion, checked captures, and what that makes of late lists."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from copem_replay.core.errors import InputError
from copem_replay.core.object_list import Entries, TellsOf
from copem_replay.core.tracks import AGREE, CLASSES
from copem_replay.fusion.gnn import Gnn
from copem_replay.fusion.interface import Inbox, StepFusion, ask_fusion
from copem_replay.fusion.nms import Nms
from copem_replay.fusion.testing import NonconformingError, check_fusion
from copem_replay.fusion.tracker import Tracker
from copem_replay.fusion.union import Union
from copem_replay.io.recording import read_log
from copem_replay.metrics.matching import DUPLICATE, GHOST, MATCH, match_at_both_times, match_entries
from copem_replay.pipeline.run import run_experiment
from tests.helpers.replays import study_rows
from tests.helpers.reports import entry, inputs_of, joined, lists_of
from tests.helpers.scenes import EGO_UNIT, Thing, driving, experiment, recording, standing
from tests.metrics.test_matching import by_the_rules
from tests.oracles.accuracy import permuted, scene_of, truth_of
from tests.oracles.origin import unknown_origins

# ------------------------------------------------------------------------------------------------- the property


def test_trackers_tell_of_now_in_all_modes_all_others_of_their_capture() -> None:
    assert [fusion.tells_of for fusion in (Union(), Nms(), Gnn())] == ["capture"] * 3
    assert [Tracker(late=late).tells_of for late in ("stale", "predict", "replay")] == ["now"] * 3


class Own(StepFusion):
    """Each unit's newest list, with captures as one likes."""

    kind: str = "tests.metrics.test_tells_of:Own"
    claims: str = "its own"

    def step(self, now_s: float, inbox: Inbox, memory: Any) -> tuple[Entries, Any]:
        entries = joined(*(one.entries for one in inbox.newest))
        entries["track_id"] = -1
        if self.claims == "now":
            entries["captured_s"] = now_s
        elif self.claims == "nearly":
            entries["captured_s"] += 9e-7
        return entries, memory


class Predicting(Own):
    """Says so."""

    kind: str = "tests.metrics.test_tells_of:Predicting"
    tells_of: ClassVar[TellsOf] = "now"


def test_own_ones_tell_of_their_capture_unless_they_say_otherwise() -> None:
    assert (Own().tells_of, Predicting().tells_of) == ("capture", "now")


def test_it_is_no_field_of_a_configuration_and_nothing_else() -> None:
    said = "expected a property of the class, `tells_of: ClassVar"
    with pytest.warns(UserWarning, match="shadows"), pytest.raises(TypeError, match=said):
        type("Field", (Own,), {"__annotations__": {"tells_of": str}, "tells_of": "now"})
    with pytest.raises(TypeError, match="tells_of: expected capture or now, found 'later'"):
        type("Later", (Own,), {"__annotations__": {"tells_of": ClassVar[str]}, "tells_of": "later"})
    with pytest.raises(ValueError, match="tells_of"):
        Own.model_validate({"tells_of": "now"})


# -------------------------------------------------------------------------------------------------- its captures


def told() -> Any:
    """Two units; the second one's lists are 0.3 s late."""
    lists = [[entry(float(f)) for f in range(4)]]
    return inputs_of(lists, ["a", "b", "a", "b"], [0.0, 0.1, 0.2, 0.3], [0.0, 0.4, 0.2, 0.6])


@pytest.mark.parametrize("claims", ["its own", "nearly"])
def test_a_capture_is_that_of_a_list_that_has_arrived(claims: str) -> None:
    found = ask_fusion(Own(claims=claims), told(), "configurations.mine.fusion")
    assert len(found.entries) == 1 + 1 + 2 + 2


def test_another_one_is_an_error_of_the_class_at_the_line_of_its_step() -> None:
    said = r"^configurations.mine.fusion: tests.metrics.test_tells_of:Own: captured_s: "
    said += "expected the capture of a list that has arrived, "
    with pytest.raises(InputError, match=said + r"found 0\.4 s \(.*test_tells_of\.py:\d+\)$") as caught:
        ask_fusion(Own(claims="now"), told(), "configurations.mine.fusion")
    line = int(re.findall(r":(\d+)\)$", str(caught.value))[0])
    assert Path(__file__).read_text().splitlines()[line - 1].startswith("    def step(")


def test_a_capture_that_has_not_arrived_yet_is_none() -> None:
    """At 0.2 s the list of 0.1 s is on its way."""

    class Early(Own):
        kind: str = "tests.metrics.test_tells_of:Early"

        def step(self, now_s: float, inbox: Inbox, memory: Any) -> tuple[Entries, Any]:
            entries, _ = super().step(now_s, inbox, memory)
            entries["captured_s"] = 0.1 if now_s > 0.1 else 0.0
            return entries, memory

    with pytest.raises(InputError, match=r"found 0\.1 s"):
        ask_fusion(Early(), told(), "fusion")


def test_the_kit_asks_for_it_too() -> None:
    check_fusion(Own())
    with pytest.raises(NonconformingError, match="captured_s: expected the capture of a list that has arrived"):
        check_fusion(Own(claims="now"))


# -------------------------------------------------------------------------------------------------- the two matches


def plainly(entries: Entries, places: Sequence[dict[int, tuple[float, float]]], classes: list[str]) -> Any:
    """One list by the rules of `metrics/matching.py`; `places`: by entry, who is where at the instant it is asked
    about."""

    def within(i: int, free: set[int]) -> list[int]:
        e = entries[i]
        away = {o: np.hypot(e["x_m"] - x, e["y_m"] - y) for o, (x, y) in places[i].items() if o in free}
        said = int(np.argmax(e["class_probability"]))
        near = [o for o, d in away.items() if d <= 2.0 + 1e-9 and AGREE[said, CLASSES.index(classes[o])]]
        return sorted(near, key=lambda o: (away[o], places[i][o][0], o))

    return by_the_rules(entries, within, set(range(len(classes))))


PLACE = st.tuples(st.integers(-3, 3), st.integers(-3, 3))
KIND = st.sampled_from(["pedestrian", "car", "other"])
SAID = st.tuples(PLACE, KIND, st.sampled_from([0.3, 0.6]), st.integers(-1, 1), st.integers(0, 3))


@given(
    things=st.lists(st.tuples(KIND, st.lists(st.none() | PLACE, min_size=3, max_size=3)), max_size=5),
    runs=st.lists(st.lists(st.lists(SAID, max_size=7), min_size=2, max_size=2), min_size=1, max_size=3),
    seed=st.integers(0, 2**32 - 1),
)
def test_entries_of_one_list_may_tell_of_different_instants(things: Any, runs: Any, seed: int) -> None:
    """Lists at 1 and 2 s, captures at 0, 1 and 2 s, and one at 3 s of which the truth knows nothing."""
    classes = [kind for kind, _ in things]

    def places(instants: Sequence[int]) -> Any:
        return {o: [ways[t] for t in instants] for o, (_, ways) in enumerate(things)}

    def there(t: int) -> dict[int, tuple[float, float]]:
        return {o: ways[t] for o, (_, ways) in enumerate(things) if t < 3 and ways[t] is not None}

    lists = lists_of(
        [[joined(*(entry(*at, of=of, existence=p, unit_ix=u, captured_s=float(t)) for at, of, p, u, t in one))
          for one in each] for each in runs]
    )  # fmt: skip
    then, now = truth_of(places([0, 1, 2]), [0.0, 1.0, 2.0]), truth_of(places([1, 2]), [1.0, 2.0])
    scene = scene_of(*classes)
    about, at_once = match_at_both_times(lists, then, now, scene, unknown_origins(lists), gate_m=2.0)
    for s in range(len(runs)):
        for k in (0, 1):
            of_list, one = slice(lists.start[s, k], lists.start[s, k + 1]), lists.of(s, k)
            for found, asked in ((about, [int(e["captured_s"]) for e in one]), (at_once, [k + 1] * len(one))):
                got = list(zip(found.object_ix[of_list].tolist(), found.role[of_list].tolist(), strict=True))
                assert got == plainly(one, [there(t) for t in asked], classes)
                for (o, role), t, x, y in zip(got, asked, found.x_m[of_list], found.y_m[of_list], strict=True):
                    assert role == GHOST or (x, y) == there(t)[o]
    for one, world, tells_of in ((about, then, "capture"), (at_once, now, "now")):
        alone = match_entries(lists, world, scene, unknown_origins(lists), gate_m=2.0, tells_of=tells_of)  # type: ignore[arg-type]
        np.testing.assert_array_equal(alone.object_ix, one.object_ix)
        np.testing.assert_array_equal(alone.role, one.role)
    shuffled, _, to = permuted(lists, None, np.random.default_rng(seed))
    again, _ = match_at_both_times(shuffled, then, now, scene, unknown_origins(shuffled), gate_m=2.0)
    assert sorted(again.role[np.argsort(to)].tolist()) == sorted(about.role.tolist())


def test_at_the_instant_an_object_has_one_match_whichever_instants_its_entries_tell_of() -> None:
    """A car at 10 m/s: of its entries of now and of a second ago the surer one is the match, where either was right."""
    world = truth_of({0: [(0, 0), (10, 0)]}, [0.0, 1.0])
    now = truth_of({0: [(10, 0)]}, [1.0])
    lists = lists_of([[joined(entry(0.5, captured_s=0.0, existence=0.9), entry(10, captured_s=1.0, existence=0.5))]])
    about, at_once = match_at_both_times(lists, world, now, scene_of("car"), unknown_origins(lists), gate_m=3.0)
    assert about.role.tolist() == [MATCH, DUPLICATE]
    assert at_once.role.tolist() == [GHOST, MATCH]


# -------------------------------------------------------------------------------------------------- whole replays

FUSIONS = {"union": {"kind": "union"}, "gnn": {"kind": "gnn"}, "tracker": {"kind": "tracker"}}


def late(latency_s: Any, *names: str, **more: Any) -> Any:
    """A car that passes at 12 m/s, one unit, everything late."""
    log = recording(
        [Thing("ego", "car", standing(0, 0)), Thing("fast", "car", driving(-40, 8, 12)),
         Thing("slow", "pedestrian", driving(10, 5, 1))],
        until_s=5.0,
    )  # fmt: skip
    configurations: dict[str, Any] = {"ideal": {"units": "all"}, "GT": {"units": "truth"}}
    configurations |= {name: {"units": "all", "fusion": fusion} for name, fusion in FUSIONS.items()}
    configurations = {name: configurations[name] | {"latency_s": latency_s} for name in names or configurations}
    couple = {
        "detection": {"kind": "constant", "probability": 0.8},
        "error": {"kind": "gaussian", "covariance_m2": [[0.2, 0.0], [0.0, 0.2]]},
    }
    plan = experiment(
        pems={"p": [couple]}, units={"ego": EGO_UNIT | {"pem": "p"}}, runs=4, configurations=configurations,
        measure={"onset": {"kind": "appears"}} | more,
    )  # fmt: skip
    return run_experiment(plan, [log])


def test_latency_costs_its_length_by_match_as_by_truth_id() -> None:
    result = study_rows(late(0.5))
    of = {name: part.set_index(["run", "object_id"])["detection_s"] for name, part in result.groupby("configuration")}
    for name in ("union", "gnn"):
        pd.testing.assert_series_equal(of[name], of["ideal"], check_names=False)


def test_no_row_depends_on_other_configurations() -> None:
    both = late(0.5)
    for name in ("ideal", "union", "tracker"):
        alone = late(0.5, name)
        mine = study_rows(both)[study_rows(both)["configuration"] == name].reset_index(drop=True)
        pd.testing.assert_frame_equal(study_rows(alone), mine, check_exact=True)
        of = both.summary[both.summary["configuration"] == name].reset_index(drop=True)
        pd.testing.assert_frame_equal(alone.summary, of, check_exact=True, check_dtype=False)


def test_error_grows_with_latency_as_far_as_the_object_goes() -> None:
    rmse_m = [late(latency_s, "gnn").summary["position_rmse_m"].iloc[0] for latency_s in (0.0, 0.3, 0.6, 1.2)]
    assert np.diff(rmse_m).min() > 1.5


def test_calibration_does_not_go_by_latency() -> None:
    now, then = (late(latency_s, "gnn").summary["existence_ece"].iloc[0] for latency_s in (0.0, 0.6))
    assert then == pytest.approx(now, abs=0.02)


# -------------------------------------------------------------------------------------------------- real recordings

SHARED = Path(__file__).parents[3] / "shared/data"


@pytest.mark.parametrize(
    ("name", "latency_s", "classes", "mast"),
    [
        ("av2_3b3570b4", 0.6, "vehicles", {"at": [76.1, 71.0], "yaw_deg": -90}),
        ("drone_swerve", 0.5, "vehicles", {"at": [-61.9, 24.2], "yaw_deg": -90}),
    ],
)
def test_of_real_traffic_late_lists_are_known_as_late_as_they_are(
    name: str, latency_s: float, classes: str, mast: dict[str, Any]
) -> None:
    """What `init` proposes, all lists late. The first drive had 8.9 s for `gnn` and 3.9 s for the ideal."""
    path = SHARED / f"{name}.mcap"
    if not path.exists():
        pytest.skip(f"no {path}")
    couple = {
        "when": {"range_m": [0, 80]},
        "detection": {"kind": "visible_share"},
        "error": {"kind": "gaussian", "frame": "line_of_sight", "covariance_m2": [[0.5, 0.0], [0.0, 0.1]]},
    }
    late = {"units": "all", "latency_s": latency_s}
    plan = experiment(
        runs=3, pems={"p": [couple]},
        units={"ego": {"on": "ego", "pem": "p"}, "roadside": {"height_m": 6.0, "pem": "p"} | mast},
        configurations={"ideal": late, "now": {"units": "all"}, "gnn": late | {"fusion": {"kind": "gnn"}}},
        measure={"objects": {"classes": [classes]}, "accuracy": False},
    )  # fmt: skip
    summary = run_experiment(plan, [read_log(path, name=name)]).summary.set_index("configuration")
    gnn_s, ideal_s, now_s = (summary.loc[one, "ttd_rmst_s"] for one in ("gnn", "ideal", "now"))
    assert gnn_s == pytest.approx(ideal_s, abs=0.02)
    assert now_s < ideal_s
