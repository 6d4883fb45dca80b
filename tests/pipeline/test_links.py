"""Links in a replay: what arrives when in each run, and what comes of it."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from copem_replay.communication.link import KeptDraws, SentLists
from copem_replay.communication.radio import Radio
from copem_replay.core.errors import ExperimentError
from copem_replay.core.tracks import Tracks
from copem_replay.experiment.file import make_plain_source as filed
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import find_problems
from copem_replay.io.recording import Recording
from copem_replay.perception.perceive import perceive
from copem_replay.pipeline import prepare as chunking
from copem_replay.pipeline import world as perceived
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.replay import replay_outcomes
from copem_replay.pipeline.run import StudyTables, run_experiment
from copem_replay.pipeline.sweep import list_points
from tests.helpers import scenes
from tests.helpers.replays import study_accuracy, study_rows, transmitted, world_of
from tests.helpers.scenes import Thing, driving, experiment, standing

GAMMA = {"kind": "gamma", "min_s": 0.02, "mean_s": 0.06, "shape": 2}
RADIO: dict[str, Any] = {
    "latency": GAMMA,
    "reception": {"kind": "shadowing", "half_at_m": 40, "exponent": 2.27, "sigma_db": 3, "blocked_db": 9},
    "memory": {"reception": [{"share": 0.8, "correlation_s": 0.5}]},
    "order": "kept",
    "channel": {"kbps": 100},
}
BURSTS: dict[str, Any] = {"reception": {"kind": "gilbert_elliott", "bad_share": 0.4, "bad_lasts_s": 0.5}}
ERROR = {"kind": "gaussian", "covariance_m2": [[0.3, 0.0], [0.0, 0.3]]}
HALF = [{"detection": {"kind": "constant", "probability": 0.5}, "error": ERROR}]


def traffic() -> Recording:
    """The ego stands between two masts, 30 m away each; four cars drive by, one after the other."""
    cars = [Thing(f"c{k}", "car", driving(60 + 15 * k, 3 + k, -10), yaw_rad=np.pi) for k in range(4)]
    return scenes.recording([Thing("ego", "car", standing(0, 0)), *cars], until_s=8.0)


def plan(link: object, **changes: Any) -> Experiment:
    """Two masts and the ego, each of which lists half of what there is, by ideal fusion and by nearest neighbours."""
    masts = {name: {"at": [x, 8], "height_m": 5, "pem": "half"} for name, x in (("east", 30.0), ("west", -30.0))}
    units = {"ego": {"on": "ego", "height_m": 1.8, "pem": "half"}, **masts}
    received = {"units": "all", "link": link} if link is not None else {"units": "all"}
    data: dict[str, Any] = {
        "pems": {"half": HALF}, "units": units, "runs": 4, "links": {"v2x": RADIO, "bursts": BURSTS},
        "configurations": {"coop": received, "gnn": {**received, "fusion": {"kind": "gnn"}}},
    }  # fmt: skip
    return experiment(**(data | changes))


def heard_by(experiment: Experiment, name: str = "coop", one: int = 0, recording: Recording | None = None) -> Tracks:
    """What reaches a receiver in one run."""
    return transmitted(prepare_log(recording or traffic(), experiment), experiment, [one]).received(name)


def assert_same(one: StudyTables, other: StudyTables) -> None:
    columns = [name for name in study_rows(one) if name in study_rows(other)]  # one may have no link
    assert study_rows(one)[columns].equals(study_rows(other)[columns])
    columns = [name for name in one.summary if name in other.summary]
    assert one.summary[columns].equals(other.summary[columns])
    assert study_accuracy(one)
    assert study_accuracy(other)
    assert study_accuracy(one)["instants.parquet"].equals(study_accuracy(other)["instants.parquet"])
    assert study_accuracy(one)["lists.parquet"].equals(study_accuracy(other)["lists.parquet"])


def test_a_link_that_is_sure_is_a_latency_to_the_last_bit() -> None:
    configurations = {
        name: {"units": "all", "fusion": {"kind": kind}} for name, kind in (("coop", "ideal"), ("gnn", "tracker"))
    }
    late = {"east": 0.07, "default": 0.31}
    linked: dict[str, dict[str, Any]] = {
        n: c | {"link": {"east": "near", "default": "far"}} for n, c in configurations.items()
    }
    sure = {"near": {"latency": 0.07}, "far": {"latency": 0.31, "reception": {"kind": "constant", "probability": 1}}}
    one = run_experiment(plan(None, configurations=linked, links=sure), [traffic()])
    other = run_experiment(
        plan(None, configurations={n: c | {"latency_s": late} for n, c in configurations.items()}), [traffic()]
    )
    assert_same(one, other)


def test_the_ego_has_its_own_lists_at_once_and_latency_comes_on_top() -> None:
    """No other unit's list is before its capture, nor a moment as any other's."""
    wired = {"coop": {"units": "all", "link": {"default": "v2x", "ego": "none"}, "latency_s": {"ego": 0.25}}}
    received = heard_by(plan(None, configurations=wired))
    delay_s = received.common_arrives_s - received.captured_s
    of_ego = received.frame_unit_ix == 0
    np.testing.assert_allclose(delay_s[of_ego], 0.25, atol=1e-12)
    others = delay_s[~of_ego]
    assert others[np.isfinite(others)].min() > 0.02
    assert 0.1 < np.isinf(others).mean() < 0.9


def test_configurations_have_the_same_numbers() -> None:
    """What a unit sends by one link is late alike in all, whatever else the experiment has; `ready` is in all."""
    ready = {"east": {"at": [30.0, 8], "height_m": 5, "pem": "half", "ready": GAMMA}}
    units = plan(None).as_written()["units"] | ready
    configurations = {
        "coop": {"units": "all", "link": "v2x"}, "one": {"units": ["east"], "link": "v2x"}, "none": {"units": "all"},
    }  # fmt: skip
    links = {"v2x": {"latency": 0.1, "reception": RADIO["reception"]}}
    some = plan(None, units=units, configurations=configurations, links=links)
    coop, one, none = (heard_by(some, name) for name in configurations)
    east = coop.frame_unit_ix == 1
    np.testing.assert_array_equal(coop.common_arrives_s[east], one.common_arrives_s[east])
    came = east & np.isfinite(coop.common_arrives_s)
    np.testing.assert_allclose((coop.common_arrives_s - none.common_arrives_s)[came], 0.1, atol=1e-12)
    ready_s = (none.common_arrives_s - none.captured_s)[east]
    assert ready_s.min() > 0.02
    assert len(np.unique(ready_s)) == len(ready_s)
    np.testing.assert_array_equal(heard_by(some, "one", 1).captured_s, one.captured_s)
    assert (heard_by(some, "none", 1).common_arrives_s[east] != none.common_arrives_s[east]).all()


@pytest.mark.parametrize("link", ["v2x", "bursts"])
def test_a_run_alone_is_the_same_run(link: str) -> None:
    some = plan(link)
    replay = prepare_log(traffic(), some)
    together = replay_outcomes(replay, some, np.arange(4))
    [alone] = replay_outcomes(replay, some, np.array([2]))
    [same] = [part for part in together if part.runs.tolist() == [2]]
    assert alone.table.equals(same.table)
    for name in alone.all_scores:
        assert (alone.all_scores[name].issue_s == same.all_scores[name].issue_s).all()
    assert_same(run_experiment(some, [traffic()]), run_experiment(some, [traffic()], jobs=2))


@pytest.mark.parametrize("link", ["v2x", None])
def test_a_block_perceives_once(monkeypatch: pytest.MonkeyPatch, link: str | None) -> None:
    """Which objects are listed, and with which errors: of all runs at once, or where arrivals are drawn run by run."""
    some, asked = plan(link), []
    replay = prepare_log(traffic(), some)
    replay_outcomes(replay, some, np.arange(1))  # what is found out once a log

    def counted(*given: Any, states: str, **more: Any) -> Tracks:
        asked.append((len(given[3]), states))
        return perceive(*given, states=states, **more)

    monkeypatch.setattr(perceived, "perceive", counted)
    replay_outcomes(replay, some, np.arange(4))
    # How long lists are on air, detection and fusion go by the same rows; lists without rows have no states.
    assert [one for one in asked if one[1] != "true"] == ([(1, "sampled")] * 4 if link else [(4, "sampled")])
    assert len(asked) == (8 if link else 2)


def test_what_a_link_drew_is_drawn_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """For two configurations, and for what is said of links: of four runs four times. Without room more often."""
    some, drawn = plan("v2x"), []

    def counted(radio: Radio, lists: SentLists) -> Any:
        drawn.append(lists)
        return once(radio, lists)

    once = Radio._drawn
    monkeypatch.setattr(Radio, "_drawn", counted)
    kept = run_experiment(some, [traffic()])
    assert len(drawn) == 4
    monkeypatch.setattr(KeptDraws.__init__, "__defaults__", (0,))
    assert_same(kept, run_experiment(some, [traffic()]))
    assert len(drawn) > 8


@pytest.mark.parametrize("fleet", [False, True])
def test_a_log_in_time_chunks_gives_the_same(monkeypatch: pytest.MonkeyPatch, fleet: bool) -> None:
    """Queue, order and bursts go on over the cuts; units that only some runs have, too."""
    some = plan({"default": "v2x", "ego": "bursts"})
    if fleet:
        cars = {"on": {"classes": ["car"], "penetration_rate": 0.5}, "height_m": 1.6, "pem": "half", "ready": GAMMA}
        some = plan({"cars": "v2x"}, units={"ego": {"on": "ego", "height_m": 1.8, "pem": "half"}, "cars": cars})
    whole = run_experiment(some, [traffic()])
    monkeypatch.setattr(chunking, "ROWS_AT_ONCE", 1)
    monkeypatch.setattr(chunking, "ROWS_A_CHUNK", 200)
    cut = run_experiment(some, [traffic()])
    assert len(cut.logs[0].replay().chunks) > 2
    assert_same(whole, cut)


def test_false_positives_are_in_the_air_too() -> None:
    """Masts that list nothing but ghosts: of g in a list it is in the air for 8 (121 + 35 g) / 100 000 s."""
    ghosts = {"in_list": 1.5, "lasts_s": 0.0, "where": {"kind": "field", "range_m": [3, 60]}, "classes": {"car": 1}}
    couples = [{"detection": {"kind": "constant", "probability": 0.0}, "error": ERROR}]
    channel = {"channel": {"kbps": 100}}
    slow = plan("slow", pems={"half": {"couples": couples, "ghosts": [ghosts]}}, links={"slow": channel})
    replay, runs = prepare_log(traffic(), slow), np.array([3])
    found = world_of(replay, slow, runs).ghosts
    assert found is not None
    received = heard_by(slow, "gnn", one=3)
    g = np.bincount(found.observations.tracks.frame_ix, minlength=len(received.stamp_ns))
    assert len(np.unique(g)) > 3
    np.testing.assert_allclose(received.common_arrives_s - received.captured_s, 8 * (121 + 35 * g) / 100_000, atol=1e-9)


def test_lists_queue_for_as_long_as_they_are_in_their_run() -> None:
    """At 100 kbit/s a list of n objects takes 8 (121 + 35 n) / 100 000 s, and its unit sends ten a second."""
    slow = plan("slow", links={"slow": {"channel": {"kbps": 100}}})
    replay, runs = prepare_log(traffic(), slow), np.array([3])
    seen = world_of(replay, slow, runs).listed("true")
    objects = np.bincount(seen.frame_ix[seen.valid[0]], minlength=len(seen.stamp_ns))
    assert len(np.unique(objects)) > 2
    received = heard_by(slow, one=3)
    expected = 8 * (121 + 35 * objects) / 100_000  # less than a tenth of a second: none waits
    np.testing.assert_allclose(received.common_arrives_s - received.captured_s, expected, atol=1e-9)


def test_nothing_is_known_sooner_than_without_the_link() -> None:
    configurations = {"plain": {"units": "all"}, "coop": {"units": "all", "link": "v2x"}}
    table = study_rows(run_experiment(plan(None, configurations=configurations, runs=20), [traffic()]))
    plain, coop = (table[table["configuration"] == name]["detection_s"].to_numpy() for name in configurations)
    assert (np.nan_to_num(coop, nan=np.inf) >= np.nan_to_num(plain, nan=np.inf)).all()
    assert (coop > plain).any()


def one_car(loss: float, **configuration: Any) -> Experiment:
    """The oncoming car is within 60 m from the list of 4 s on, and surely in it; lists come ten a second."""
    return experiment(
        links={"v2x": {"reception": {"kind": "constant", "probability": 1 - loss}}}, runs=600,
        configurations={"PEM": {"units": ["ego"], "link": "v2x", **configuration}}, show=None,
        measure={"onset": {"kind": "in_range", "range_m": 80}, "exact": True, "accuracy": False},
    )  # fmt: skip


@pytest.mark.parametrize("loss", [0.1, 0.5])
def test_mean_delay_by_loss_and_its_closed_form(loss: float) -> None:
    """T p / (1 − p), and exact: each list is the first that arrives with (1 − p) p^k."""
    result = run_experiment(one_car(loss), [scenes.oncoming_car()])
    late_s = study_rows(result)["detection_s"] - 4.0
    expected_s = 0.1 * loss / (1 - loss)
    assert late_s.mean() == pytest.approx(expected_s, abs=4 * late_s.std() / math.sqrt(600))
    assert result.exact is not None
    exact = result.exact[result.exact["probability"] > 0]
    k = np.rint((exact["detection_s"].to_numpy()[:-1] - 4.0) / 0.1)
    np.testing.assert_allclose(exact["probability"].to_numpy()[:-1], (1 - loss) * loss**k, rtol=1e-9)
    counted = np.bincount(np.rint(late_s / 0.1).astype(int), minlength=3)[:3] / 600
    np.testing.assert_allclose(counted, (1 - loss) * loss ** np.arange(3), atol=4 * math.sqrt(0.25 / 600))


def test_fused_lists_are_issued_at_ticks() -> None:
    """At 4 Hz the list of 4.0 s, which arrives at 4.03 s, is in the fused list of 4.25 s, and exact times say so."""
    result = run_experiment(one_car(0.0, issue_hz=4, latency_s=0.03), [scenes.oncoming_car()])
    assert set(study_rows(result)["detection_s"]) == {4.25}
    assert result.exact is not None
    assert result.exact[result.exact["probability"] > 0]["detection_s"].tolist() == [4.25]
    assert result.summary["list_rate_hz"].tolist() == pytest.approx([4.0])


@pytest.mark.parametrize(
    ("link", "unit", "said"),
    [
        ({"latency": GAMMA}, {},
         "link v2x: latency is drawn, and then lists have no common instants; use a constant one"),
        ({"channel": {"kbps": 100}}, {},
         "link v2x: lists queue, each as long as the lists before it are; use no `channel`"),
        (BURSTS, {}, "link v2x: losses come in bursts, and lists are then lost together; use a constant reception"),
        ({"reception": {"kind": "constant", "probability": 0.5},
          "memory": {"reception": [{"share": 1, "correlation_s": 1}]}}, {},
         "link v2x: losses last, and lists are then lost together; use no `memory`"),
        ({"latency": 0.1}, {"ready": GAMMA},
         "unit ego: `ready` is drawn, and then lists have no common instants; make it constant"),
    ],
)  # fmt: skip
def test_exact_is_refused_with_the_reason(link: dict[str, Any], unit: dict[str, Any], said: str) -> None:
    some = one_car(0.0)
    units = {"ego": scenes.EGO_UNIT | unit}
    refused = Experiment.model_validate(some.as_written() | {"links": {"v2x": link}, "units": units})
    with pytest.raises(ExperimentError) as caught:
        run_experiment(refused, [scenes.oncoming_car()])
    assert str(caught.value) == f"exact: configuration PEM: {said}, or leave exact out"


def test_without_a_receiver_there_is_no_distance() -> None:
    alone = scenes.recording([Thing("c", "car", driving(60, 3, -10))], until_s=2.0, ego=None)
    some = plan("v2x", units={"east": {"at": [30.0, 8], "height_m": 5, "pem": "half"}}, ego="none",
                measure={"onset": {"kind": "appears"}, "distance_to": "east"})  # fmt: skip
    with pytest.raises(ExperimentError) as caught:
        run_experiment(some, [alone])
    expected = (
        "links.v2x.reception: shadowing: the distance to a receiver is unknown, for the log has no ego; use constant"
    )
    assert str(caught.value) == f"scene: {expected}"


def test_what_links_make_of_lists_is_in_the_summary() -> None:
    """At 10 Hz and .1 s late, the newest list is between .1 and .2 s old, one age as long as another."""
    link = {"latency": 0.1}
    some = one_car(0.0, latency_s=0.0).model_copy(update={"runs": 1})
    plain = Experiment.model_validate(some.as_written() | {"links": {"v2x": link}})
    [row] = run_experiment(plain, [scenes.oncoming_car()]).summary.to_dict("records")
    assert (row["lost_share"], row["overtaken_share"]) == (0.0, 0.0)
    assert row["age_of_information_p50_s"] == pytest.approx(0.15, abs=1e-6)
    assert row["age_of_information_p95_s"] == pytest.approx(0.195, abs=1e-6)
    [none] = run_experiment(
        experiment(configurations={"PEM": {"units": ["ego"]}}), [scenes.oncoming_car()]
    ).summary.to_dict("records")
    assert "lost_share" not in none


def test_lists_of_wired_units_are_none_of_the_links() -> None:
    slow = {
        "latency": {"kind": "gamma", "mean_s": 0.2, "shape": 1},
        "reception": {"kind": "constant", "probability": 0.5},
    }
    wired = {"coop": {"units": ["ego", "east", "west"], "link": {"default": "slow", "ego": "none"}}}
    unheard = {"far": {"at": [90.0, 8], "height_m": 5, "pem": "half"}}
    units = plan(None).as_written()["units"] | unheard
    some = plan(None, links={"slow": slow}, configurations=wired, runs=30, units=units)
    received = [heard_by(some, one=k) for k in range(30)]
    sent = [one.common_arrives_s[np.isin(one.frame_unit_ix, (1, 2))] for one in received]
    [row] = run_experiment(some, [traffic()]).summary.to_dict("records")
    assert row["lost_share"] == np.mean([np.isinf(one).mean() for one in sent])
    assert row["lost_share"] == pytest.approx(0.5, abs=0.04)
    overtaken, came = 0, 0
    for one in received:  # arrived after a newer one of its unit
        for unit in (1, 2):
            mine = np.flatnonzero((one.frame_unit_ix == unit) & np.isfinite(one.common_arrives_s))
            at = one.common_arrives_s[mine]
            overtaken += sum((at[k + 1 :] <= at[k]).any() for k in range(len(at)))
            came += len(at)
    assert row["overtaken_share"] == pytest.approx(overtaken / came)
    assert overtaken / came > 0.1


@pytest.mark.parametrize("sends", [None, {"kind": "cpm"}])
def test_lists_that_are_taken_in_at_once_are_not_overtaken(sends: object) -> None:
    """At 4 Hz two or three lists come in together, in order. By a drawn latency some are overtaken, ticks or not.

    So do messages that leave objects out, whose entries are still of use.
    """
    units = {"ego": scenes.EGO_UNIT | ({} if sends is None else {"sends": sends})}
    slow = {"latency": {"kind": "gamma", "mean_s": 0.4, "shape": 1}}
    configurations = {
        f"{name}{hz}": {"units": ["ego"], "link": name} | ({"issue_hz": hz} if hz else {})
        for name in ("sure", "slow") for hz in (0, 4)
    }  # fmt: skip
    some = experiment(units=units, links={"sure": {"latency": 0.05}, "slow": slow}, configurations=configurations)
    rows = run_experiment(some, [scenes.oncoming_car()]).summary.set_index("configuration")
    shares = rows["overtaken_share"].to_dict()
    received = heard_by(some, "slow0", recording=scenes.oncoming_car()).common_arrives_s
    overtaken = np.mean([(received[k + 1 :] <= received[k]).any() for k in range(len(received))])
    assert 0.3 < overtaken < 0.6
    assert shares == {"sure0": 0.0, "sure4": 0.0, "slow0": overtaken, "slow4": overtaken}


SWEPT = {
    "loss": ([0.0, 0.2, 0.6], {"reception": {"kind": "gilbert_elliott", "bad_share": 0.4, "bad_lasts_s": 0.5}}),
    "burst_s": ([0.0, 0.5, 3.0], {"reception": {"kind": "constant", "probability": 0.6},
                                  "memory": {"reception": [{"share": 1.0, "correlation_s": 1.0}]}}),
}  # fmt: skip


@pytest.mark.parametrize("kind", list(SWEPT))
def test_sweeps_of_links(kind: str) -> None:
    """More loss only removes lists, run by run; bursts leave the mean loss as it is."""
    values, link = SWEPT[kind]
    some = plan("v2x", links={"v2x": link}, runs=3, sweep={kind: values, "configurations": ["coop"]})
    swept = list(list_points(some))
    assert [point.value for point in swept] == values
    came = [[np.isfinite(heard_by(at.experiment, one=k).common_arrives_s) for k in range(3)] for at in swept]
    if kind == "loss":
        assert all((more <= less).all() for k in range(3) for less, more in pairwise(one[k] for one in came))
        assert np.all(came[0])
    rows = run_experiment(some, [traffic()]).sweep
    assert rows is not None
    lost = rows["lost_share"].to_numpy()
    np.testing.assert_allclose(lost, values if kind == "loss" else [0.4] * 3, atol=0.15)


@pytest.mark.parametrize(
    ("link", "sweep", "said"),
    [
        ({"reception": RADIO["reception"]}, {"loss": [0.1]},
         "sweep.loss: links.v2x.reception: shadowing has no loss to vary; use constant or gilbert_elliott"),
        ({"reception": {"kind": "gilbert_elliott", "bad_share": 0.1, "bad_lasts_s": 1.0, "bad_loss": 0.6}},
         {"loss": [0.2, 0.8]},
         "sweep.loss[1]: expected between good_loss and bad_loss of v2x (0 … 0.6), found 0.8"),
        ({"latency": 0.1}, {"burst_s": [1]},
         "sweep.burst_s: no link has bursts (gilbert_elliott, or memory.reception)"),
    ],
)  # fmt: skip
def test_what_cannot_be_swept_is_said(link: dict[str, Any], sweep: dict[str, Any], said: str) -> None:
    data = plan("v2x", links={"v2x": link}).as_written() | {"sweep": sweep}
    assert [f"experiment: {said}"] == [line for line in find_problems(filed(data))[1] if "sweep" in line]


def test_a_link_that_there_is_not() -> None:
    data = plan("v2x").as_written()
    data["configurations"] = {
        "coop": {"units": "all", "link": "v2y"},
        "two": {"units": "all", "link": {"nobody": "v2x"}},
    }
    del data["links"]["bursts"]
    found = [line for line in find_problems(filed(data))[1] if "link" in line]
    assert found == [
        "experiment: configurations.coop.link: no link 'v2y' (there is v2x)",
        "experiment: configurations.two.link.nobody: no unit is named 'nobody'; there are ego, east, west, default",
    ]


def test_a_link_for_a_unit_that_the_configuration_lacks() -> None:
    data = plan("v2x").as_written()
    data["units"]["box"] = {"recorded": {"topic": "box"}}
    data["configurations"] = {
        "coop": {"units": ["east"], "link": {"east": "v2x", "west": "v2x", "default": "none"}},
        "all": {"units": "all", "link": {"ego": "none", "east": "v2x", "box": "v2x"}},
        "truth": {"units": "truth", "link": {"truth": "v2x", "ego": "v2x"}},
        "no truth": {"units": ["ego", "box"], "link": {"truth": "v2x", "box": "v2x"}},
    }
    ending = "; add it to `units`, or leave it out here"
    start, what = "experiment: configurations", "the configuration has no unit"
    assert [line for line in find_problems(filed(data))[1] if "link" in line] == [
        f"{start}.coop.link.west: {what} 'west' to send by a link (units: east){ending}",
        f"{start}.all.link.box: {what} 'box' to send by a link (units: ego, east, west){ending}",
        f"{start}.truth.link.ego: {what} 'ego' to send by a link (units: truth){ending}",
        f"{start}.no truth.link.truth: {what} 'truth' to send by a link (units: ego, box){ending}",
    ]
