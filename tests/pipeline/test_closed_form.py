"""Exact detection times against plain enumeration of all outcomes, numbers worked out by hand, and the runs themselves.

Where nothing else is said the ego stands at the origin, frames come every 0.1 s, and each list of a unit holds an
object with one probability, whatever it looks like.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import pandas as pd
import pytest
import scipy.stats
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from mpmath import mp, mpf
from pyarrow import parquet

from copem_replay.cli import main as cli
from copem_replay.core.errors import ExperimentError
from copem_replay.core.tracks import Float
from copem_replay.experiment.file import log_paths, read_experiment_file
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import find_problems, read_logs
from copem_replay.io.recording import Recording
from copem_replay.metrics.braking.driver import Reaction
from copem_replay.metrics.braking.verdict import judge_braking
from copem_replay.metrics.columns import TABLES
from copem_replay.metrics.detection.by_truth_id import detect_by_truth_id
from copem_replay.metrics.summary import summarise_rows
from copem_replay.metrics.survival import CENSORED, DETECTED, LEFT, cumulative_incidence, quantile_with_never
from copem_replay.pipeline.closed_form import compute_distributions, exact_table
from copem_replay.pipeline.prepare import Replay, prepare_log
from copem_replay.pipeline.run import StudyTables, run_experiment
from tests.helpers.drawn import examples
from tests.helpers.experiments import changed, drive, source_of
from tests.helpers.replays import study_rows, transmitted
from tests.helpers.scenes import Thing, driving, experiment, recording, standing

ROOT = Path(__file__).parents[2]
SOME = settings(
    max_examples=examples(80), suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much]
)  # an example replays a log
NEVER = None
Times = dict[int | None, float]
"""How probable each time of the first detection is, in milliseconds since the log's start; None: never."""


def sure_to(probability: float) -> list[dict[str, Any]]:
    """A PEM whose lists hold everything with one probability."""
    return [{"detection": {"kind": "constant", "probability": probability}}]


# ------------------------------------------------------------ the oracle: every outcome of the lists, one by one


@dataclass(frozen=True)
class Station:
    """A unit, told in milliseconds: how probably each of its lists holds an object, when they are made, how late."""

    probability: float
    latency: int = 0
    rate_hz: float | None = None
    phase: int = 0

    def captures(self, world: World) -> list[int]:
        if self.rate_hz is None:
            return [k * world.frame for k in range(world.last + 1)]
        period = round(1000 / self.rate_hz)
        return list(range(self.phase, world.last * world.frame + 1, period))


@dataclass(frozen=True)
class World:
    """A log of frames 0 … `last`, `frame` ms apart; the frames at which each walker is in it; who perceives them.

    `onset` is an instant in ms, or None: when a walker appears.
    """

    frame: int
    last: int
    walkers: dict[str, frozenset[int]]
    stations: dict[str, Station]
    hits: int = 1
    of: int = 1
    onset: int | None = None
    count_earlier: bool = False

    @property
    def measured(self) -> list[str]:
        """Who has an onset."""
        spans = {name: (min(there) * self.frame, max(there) * self.frame) for name, there in self.walkers.items()}
        return [n for n, (a, b) in spans.items() if self.onset is None or a <= self.onset <= b]

    def present(self, walker: str, t: int) -> bool:
        """At its frames, and between two that are at most half a second apart."""
        frames = [k * self.frame for k in self.walkers[walker]]
        before, after = [f for f in frames if f <= t], [f for f in frames if f >= t]
        return bool(before and after) and (max(before) == t or min(after) - max(before) <= 500)

    def lists_of(self, walker: str) -> list[tuple[int, int, float]]:
        """Captured, arrives, probability: of each list that may hold the walker."""
        return [
            (t, t + s.latency, s.probability)
            for s in self.stations.values()
            for t in s.captures(self)
            if self.present(walker, t)
        ]

    def counted(self, walker: str) -> list[tuple[int, int, float]]:
        """Those captured at or after the onset that arrive before we stop looking."""
        frames = [k * self.frame for k in self.walkers[walker]]
        onset = min(frames) if self.onset is None else self.onset
        lists = self.lists_of(walker)
        return [x for x in lists if (x[0] >= onset or self.count_earlier) and x[1] <= max(frames)]


def first_known(world: World, held: list[tuple[int, int, float]]) -> int | None:
    """When `hits` of some `of` consecutive capture instants are first seen to hold it, from the lists that hold it."""
    captures = sorted({t for s in world.stations.values() for t in s.captures(world)})
    for now in sorted({arrives for _, arrives, _ in held}):
        if world.hits == 1:
            return now
        instants = {captures.index(t) for t, arrives, _ in held if arrives <= now}
        if any(sum(1 for i in instants if a <= i < a + world.of) >= world.hits for a in instants):
            return now
    return NEVER


def every_outcome(world: World, walker: str) -> Times:
    """The distribution, from all outcomes of all lists that are up to chance."""
    lists = world.counted(walker)
    sure, chance = [x for x in lists if x[2] == 1], [x for x in lists if 0 < x[2] < 1]
    result: Times = {}
    for outcome in itertools.product((True, False), repeat=len(chance)):
        weight = math.prod(x[2] if yes else 1 - x[2] for x, yes in zip(chance, outcome, strict=True))
        known = first_known(world, sure + [x for x, yes in zip(chance, outcome, strict=True) if yes])
        result[known] = result.get(known, 0.0) + weight
    return result


# -------------------------------------------------------------------------------- the same world, replayed


def replayed(world: World) -> tuple[Replay, Experiment]:
    things = [Thing("ego", "car", standing(0, 0))]
    for k, (name, there) in enumerate(world.walkers.items()):
        seen: Any = lambda t, there=there: round(t * 1000 / world.frame) in there  # noqa: E731
        things.append(Thing(name, "pedestrian", standing(10, 5 * k), seen))
    log = recording(things, until_s=world.last * world.frame / 1000, rate_hz=1000 / world.frame)
    units: dict[str, Any] = {}
    for name, s in world.stations.items():
        place = {"on": "ego"} if name == "ego" else {"at": [5, -5], "height_m": 4.0}
        units[name] = place | {"pem": name, "rate_hz": s.rate_hz, "phase_s": s.phase / 1000}
    onset = {"kind": "appears"} if world.onset is None else {"kind": "at", "time_s": world.onset / 1000}
    latency = {name: s.latency / 1000 for name, s in world.stations.items()}
    plan = experiment(
        pems={name: sure_to(s.probability) for name, s in world.stations.items()},
        units=units,
        configurations={"all": {"units": "all", "latency_s": latency}},
        measure={
            "onset": onset,
            "confirm": {"hits": world.hits, "of": world.of},
            "count_earlier": world.count_earlier,
        },
    )
    return prepare_log(log, plan), plan


def ms(time_s: float) -> int:
    """Milliseconds of an instant that is a whole number of them, to a microsecond."""
    assert abs(time_s - round(time_s * 1000) / 1000) < 1e-6
    return round(time_s * 1000)


def in_closed_form(ready: Replay, plan: Experiment, name: str = "all") -> dict[str, Times]:
    """What the package says, object by object."""
    result = {}
    for object_ix, of in zip(ready.episodes.object_ix, compute_distributions(ready, plan, name), strict=True):
        assert (np.diff(of.time_s) > 0).all()
        assert (of.probability >= 0).all()
        times: Times = {ms(t): float(p) for t, p in zip(of.time_s, of.probability, strict=True)}
        assert len(times) == len(of.time_s)
        result[ready.scene.object_ids[object_ix]] = {**times, NEVER: math.exp(of.log_never)}
    return result


def by_detect(ready: Replay, plan: Experiment, name: str = "all") -> dict[str, Times]:
    """What `detect` makes of every outcome of the lists, those before the onset and after the end included."""
    configuration = plan.configurations[name]
    tracks, probability = ready.measured.tracks, ready.measured.probability
    result = {}
    for m, object_ix in enumerate(ready.episodes.object_ix):
        mine = tracks.row_object_ix == object_ix
        chance = np.flatnonzero(mine & (probability > 0) & (probability < 1))
        outcomes = np.array(list(itertools.product((True, False), repeat=len(chance))), dtype=bool)
        valid = np.repeat((mine & (probability == 1))[None], len(outcomes), axis=0)
        valid[:, chance] = outcomes
        weight = np.where(outcomes, probability[chance], 1 - probability[chance]).prod(axis=1)
        found = detect_by_truth_id(
            transmitted(ready, plan).receive(replace(tracks, valid=valid), name),
            ready.episodes,
            confirm=plan.measure.confirm,
            count_earlier=plan.measure.count_earlier,
            max_age_s=configuration.max_age_s,
        ).detection_s[:, m]
        times: Times = {}
        for t, w in zip(found.tolist(), weight.tolist(), strict=True):
            key = NEVER if math.isnan(t) else ms(t)
            times[key] = times.get(key, 0.0) + w
        result[ready.scene.object_ids[object_ix]] = times
    return result


def same(found: Times, expected: Times) -> None:
    for key in found.keys() | expected.keys():
        assert found.get(key, 0.0) == pytest.approx(expected.get(key, 0.0), abs=1e-12), key


PROBABILITIES = st.sampled_from([0.0, 0.125, 0.3, 0.5, 0.9, 1.0])
MOST_LISTS = 10


@st.composite
def presences(draw: st.DrawFn, last: int) -> frozenset[int]:
    """In the log from one frame to another, perhaps with a gap."""
    first = draw(st.integers(0, last - 1))
    end = draw(st.integers(first + 1, last))
    gap = draw(st.sets(st.integers(first + 1, end - 1))) if end - first > 1 else set()
    return frozenset(range(first, end + 1)) - gap


@st.composite
def worlds(draw: st.DrawFn) -> World:
    """Units of any rate and latency, one hit."""
    frame = draw(st.sampled_from([100, 250]))
    last = draw(st.integers(2, 8))
    names = draw(st.sampled_from([("ego",), ("ego", "mast"), ("mast", "ego", "pole")]))
    rates = st.sampled_from([None, None, 10.0, 20.0, 4.0, 5.0])
    stations = {}
    for name in names:
        rate = draw(rates)
        phase = 0 if rate is None else draw(st.sampled_from([0, 30, 100, 250]))
        stations[name] = Station(draw(PROBABILITIES), draw(st.sampled_from([0, 50, 100, 130, 1000])), rate, phase)
    world = World(
        frame,
        last,
        {name: draw(presences(last)) for name in draw(st.sampled_from([("a",), ("a", "b")]))},
        stations,
        onset=draw(st.sampled_from([None, 0, 250, 333])),
        count_earlier=draw(st.booleans()),
    )
    for name in world.measured:
        assume(sum(1 for *_, p in world.lists_of(name) if 0 < p < 1) <= MOST_LISTS)
    return world


@st.composite
def confirming(draw: st.DrawFn) -> World:
    """Units that capture together and whose lists arrive together, and several hits."""
    hits, of = draw(st.sampled_from([(2, 2), (2, 3), (3, 3), (3, 5), (2, 5), (4, 5), (1, 3)]))
    frame = draw(st.sampled_from([100, 250]))
    last = draw(st.integers(3, 8))
    rate = draw(st.sampled_from([None, 1000 / frame]))
    latency = draw(st.sampled_from([0, frame, 130]))
    names = draw(st.sampled_from([("ego",), ("ego",), ("ego", "mast")]))
    world = World(
        frame,
        last,
        {name: draw(presences(last)) for name in draw(st.sampled_from([("a",), ("a", "b")]))},
        {name: Station(draw(PROBABILITIES), latency, rate) for name in names},
        hits,
        of,
        onset=draw(st.sampled_from([None, 0, 250])),
        count_earlier=draw(st.booleans()),
    )
    for name in world.measured:
        assume(sum(1 for *_, p in world.lists_of(name) if 0 < p < 1) <= MOST_LISTS)
    return world


def compared(world: World) -> None:
    ready, plan = replayed(world)
    found, real = in_closed_form(ready, plan), by_detect(ready, plan)
    assert list(found) == world.measured
    for name in world.measured:
        expected = every_outcome(world, name)
        same(real[name], expected)
        same(found[name], expected)


@SOME
@given(worlds())
def test_one_hit_against_every_outcome(world: World) -> None:
    compared(world)


@SOME
@given(confirming())
def test_several_hits_against_every_outcome(world: World) -> None:
    compared(world)


EVERY_FRAME = frozenset(range(9))


@pytest.mark.parametrize(("hits", "of"), [(2, 2), (2, 3), (3, 5), (5, 5)])
@pytest.mark.parametrize(
    ("frame", "there"),
    [
        (100, EVERY_FRAME),
        (100, EVERY_FRAME - {6, 7, 8}),  # leaves
        (100, EVERY_FRAME - {3, 4}),  # missing for 0.3 s: bridged
        (250, EVERY_FRAME - {3, 4}),  # missing for 0.75 s: absent at two captures
        (250, EVERY_FRAME - {1, 2, 6, 7}),  # twice
        (250, EVERY_FRAME - {1, 2, 3, 4, 5, 6}),  # for longer than any window
    ],
)
def test_captures_without_the_object_count(hits: int, of: int, frame: int, there: frozenset[int]) -> None:
    compared(World(frame, 8, {"a": there}, {"ego": Station(0.4)}, hits, of))


def test_lists_captured_at_different_times_that_arrive_together() -> None:
    """The mast's captures are 40 ms after the ego's: one instant of capture, and by its latency one of arrival."""
    things = [Thing("ego", "car", standing(0, 0)), Thing("a", "pedestrian", standing(10, 0), lambda t: t > 0.15)]
    log = recording(things, until_s=0.55, rate_hz=20)
    plan = experiment(
        pems={"p": sure_to(0.3)},
        units={
            "ego": {"on": "ego", "pem": "p", "rate_hz": 10},
            "mast": {"at": [5, 5], "height_m": 4.0, "pem": "p", "rate_hz": 10, "phase_s": 0.04},
        },
        configurations={"all": {"units": "all", "latency_s": {"ego": 0.04, "mast": 0.0}}},
        measure={"onset": {"kind": "at", "time_s": 0.22}, "confirm": {"hits": 2, "of": 3}},
    )
    ready = prepare_log(log, plan)
    found, real = in_closed_form(ready, plan)["a"], by_detect(ready, plan)["a"]
    same(found, real)
    # At 0.24 s by the mast alone, whose capture is after the onset; two hits need the next instant.
    assert found[340] == pytest.approx(0.3 * (1 - 0.7**2))


def test_the_truth_is_certain() -> None:
    for hits, of, known in ((1, 1, 500), (2, 3, 600), (3, 3, 700)):
        world = World(100, 8, {"a": frozenset(range(2, 9))}, {"ego": Station(0.5)}, hits, of)
        ready, replayed_plan = replayed(world)
        plan = experiment(
            configurations={"GT": {"units": "truth", "latency_s": 0.3}},
            units={},
            measure={"onset": {"kind": "appears"}, "confirm": {"hits": hits, "of": of}},
        ).model_copy(update={"units": replayed_plan.units})
        of, *others = compute_distributions(ready, plan, "GT")
        assert not others
        assert ms(of.time_s[0]) == 500
        assert [ms(t) for t, p in zip(of.time_s, of.probability, strict=True) if p > 0] == [known]
        assert of.probability.sum() == 1
        assert of.log_never == -math.inf


# -------------------------------------------------------------------------------------------------- by hand


def one_walker(there: Any = lambda t: True, **changes: Any) -> Recording:
    """A pedestrian 20 m ahead of the ego, which stands, 10 Hz, 1 s: eleven lists."""
    things = [Thing("ego", "car", standing(0, 0)), Thing("a", "pedestrian", standing(20, 0), there)]
    return recording(things, until_s=1.0, **changes)


def masts(count: int, probability: float = 0.5, **changes: Any) -> Experiment:
    """Masts that are all alike, and the exact times of what they see together."""
    standard: dict[str, Any] = {
        "pems": {"p": sure_to(probability)},
        "units": {f"m{k}": {"at": [20, 5 + k], "height_m": 5.0, "pem": "p"} for k in range(count)},
        "configurations": {"all": {"units": "all"}},
        "measure": {"onset": {"kind": "appears"}, "exact": True},
    }
    return experiment(**(standard | changes))


def exact(plan: Experiment, log: Recording) -> pd.DataFrame:
    return exact_table(prepare_log(log, plan), plan)


def near(values: list[float]) -> Any:
    """The same to rounding, be they ever so small."""
    return pytest.approx(values, rel=1e-13, abs=0)


class TestByHand:
    def test_heads_or_tails(self) -> None:
        rows = exact(masts(1), one_walker())
        assert rows["probability"].tolist() == near([0.5 ** (k + 1) for k in range(11)] + [0.5**11])
        assert rows["incidence"].tolist()[:-1] == near([1 - 0.5 ** (k + 1) for k in range(11)])
        assert rows["detection_s"].tolist()[:-1] == pytest.approx([0.1 * k for k in range(11)])
        assert rows["time_to_detection_s"].tolist()[:-1] == pytest.approx([0.1 * k for k in range(11)])
        assert rows["distance_at_detection_m"].tolist()[:-1] == [20] * 11
        assert rows["gap_at_detection_m"].tolist()[:-1] == pytest.approx([20 - 2 - 0.25] * 11)
        never = rows.iloc[-1]
        for name in (
            "detection_s", "incidence", "time_to_detection_s", "distance_at_detection_m", "gap_at_detection_m",
        ):  # fmt: skip
            assert math.isnan(never[name]), name
        assert set(zip(rows["log"], rows["configuration"], rows["object_id"], rows["object_class"], strict=True)) == {
            ("scene", "all", "a", "pedestrian")
        }
        assert set(zip(rows["onset_s"], rows["ended_s"], rows["ended_by"], strict=True)) == {(0, 1, "log_end")}

    def test_the_mean(self) -> None:
        """E min(T, 1 s) = Σ 0.1 s · P(T > 0.1 k s), k = 0 … 9: 0.1 · (1 − 2⁻¹⁰)."""
        row = run_experiment(masts(1), [one_walker()]).summary.iloc[0]
        assert row["ttd_rmst_s_exact"] == pytest.approx(0.1 * (1 - 2**-10), abs=1e-15)
        assert row["unknown_s_exact"] == pytest.approx(0.1 * (1 - 2**-10), abs=1e-15)  # its end is the horizon
        assert row["ttd_rmst_horizon_s"] == 1

    @pytest.mark.parametrize("count", [1, 2, 3, 7])
    def test_any_of_several(self, count: int) -> None:
        rows = exact(masts(count, 0.3), one_walker())
        one = 1 - 0.7**count
        assert rows["probability"].tolist()[:-1] == pytest.approx([one * (1 - one) ** k for k in range(11)], abs=1e-15)
        assert rows["probability"].tolist()[-1] == pytest.approx((1 - one) ** 11, abs=1e-15)

    @pytest.mark.parametrize("latency", [0.0, 0.1, 0.25, 0.95, 1.0, 1.05])
    def test_latency_moves_all(self, latency: float) -> None:
        """What would arrive after the end goes to never."""
        plan = masts(1, configurations={"late": {"units": "all", "latency_s": latency}})
        rows = exact(plan, one_walker())
        known = [k for k in range(11) if 0.1 * k + latency <= 1 + 1e-9]
        assert rows["detection_s"].tolist()[:-1] == pytest.approx([0.1 * k + latency for k in known])
        assert rows["probability"].tolist() == near([0.5 ** (k + 1) for k in known] + [0.5 ** len(known)])

    def test_latency_of_one_of_two(self) -> None:
        """One at once, the other 0.25 s late: it adds to none of the ego's instants, but comes in between."""
        plan = masts(2, configurations={"all": {"units": "all", "latency_s": {"m0": 0.0, "m1": 0.25}}})
        rows = exact(plan, one_walker())
        assert [round(t, 9) for t in rows["detection_s"][:6]] == [0, 0.1, 0.2, 0.25, 0.3, 0.35]
        assert rows["probability"].tolist()[:6] == near([2.0 ** -(k + 1) for k in range(6)])

    def test_two_heads_in_a_row(self) -> None:
        """Of 2ⁿ ways to toss n times Fibonacci's (n − 1)-th number end in the first two heads in a row."""
        plan = masts(1, measure={"onset": {"kind": "appears"}, "confirm": {"hits": 2, "of": 2}})
        rows = exact(plan, one_walker())
        fibonacci = [0, 1, 1, 2, 3, 5, 8, 13, 21, 34, 55]
        assert rows["probability"].tolist()[:-1] == near([f / 2 ** (n + 1) for n, f in enumerate(fibonacci)])
        assert rows["probability"].tolist()[-1] == pytest.approx(233 / 2**11)  # no two in a row: again Fibonacci's

    def test_two_of_three(self) -> None:
        """Of tosses, by their number: HH; HTH, THH; TTHH, THTH; HTTHH, TTTHH, TTHTH."""
        plan = masts(1, measure={"onset": {"kind": "appears"}, "confirm": {"hits": 2, "of": 3}})
        rows = exact(plan, one_walker())
        assert [p * 2 ** (n + 1) for n, p in enumerate(rows["probability"][:5])] == near([0, 1, 2, 2, 3])

    def test_what_was_captured_before_the_onset(self) -> None:
        """The onset is at 0.42 s; counted from the beginning the times are negative at first."""
        onset = {"onset": {"kind": "at", "time_s": 0.42}}
        rows = exact(masts(1, measure=onset), one_walker())
        assert rows["time_to_detection_s"].tolist()[:-1] == pytest.approx([0.08 + 0.1 * k for k in range(6)])
        rows = exact(masts(1, measure=onset | {"count_earlier": True}), one_walker())
        assert rows["time_to_detection_s"].tolist()[:-1] == pytest.approx([-0.42 + 0.1 * k for k in range(11)])
        assert rows["probability"].tolist()[-1] == pytest.approx(0.5**11, rel=1e-13)

    def test_who_leaves(self) -> None:
        rows = exact(masts(1), one_walker(lambda t: 0.25 < t < 0.55))
        assert rows["probability"].tolist() == near([0.5, 0.25, 0.125, 0.125])
        assert set(rows["ended_by"]) == {"object_left"}

    def test_nobody_lists(self) -> None:
        """The latency is longer than the log, or nobody can see it: one row, never."""
        for plan in (
            masts(2, configurations={"all": {"units": "all", "latency_s": 5.0}}),
            masts(1, units={"v2v": {"on": "a", "pem": "p"}}),  # who carries a unit does not list itself
        ):
            rows = exact(plan, one_walker())
            assert rows["probability"].tolist() == [1]
            assert rows["detection_s"].isna().all()
            row = run_experiment(plan, [one_walker()]).summary.iloc[0]
            assert (row["detected_share_exact"], row["ttd_rmst_s_exact"], row["unknown_s_exact"]) == (0, 1, 1)

    def test_nothing_to_look_at(self) -> None:
        plan = masts(1, measure={"onset": {"kind": "in_range", "range_m": 5}, "exact": True})
        result = run_experiment(plan, [one_walker()])
        assert result.exact is not None
        assert len(result.exact) == 0
        assert result.summary["detected_share_exact"].isna().all()
        # Beside a log that has something it adds nothing.
        nearer = recording([Thing("ego", "car", standing(0, 0)), Thing("a", "car", standing(4, 3))], until_s=1, log="b")
        both = run_experiment(plan, [one_walker(), nearer]).exact
        assert both is not None
        assert both["log"].unique().tolist() == ["b"]
        assert both["probability"].sum() == pytest.approx(1)

    def test_rows_of_several_configurations_and_objects(self) -> None:
        things = [Thing("ego", "car", standing(0, 0)), Thing("b", "pedestrian", standing(20, 0))]
        log = recording([*things, Thing("a", "car", standing(30, 5), lambda t: t > 0.75)], until_s=1.0)
        plan = masts(1, configurations={"all": {"units": "all"}, "GT": {"units": "truth"}})
        rows = exact(plan, log)
        groups = rows.groupby(["configuration", "object_id"], sort=False)
        assert groups.size().to_dict() == {("all", "b"): 12, ("all", "a"): 4, ("GT", "b"): 12, ("GT", "a"): 4}
        assert groups["probability"].sum().tolist() == pytest.approx([1] * 4)

    def test_asked_for_or_not(self) -> None:
        quiet = masts(1, measure={"onset": {"kind": "appears"}})
        result = run_experiment(quiet, [one_walker()])
        assert result.exact is None
        assert not [name for name in result.summary if name.endswith("_exact")]
        asked = run_experiment(masts(1), [one_walker()])
        pd.testing.assert_frame_equal(study_rows(asked), study_rows(result))
        pd.testing.assert_frame_equal(asked.summary[list(result.summary)], result.summary)


class TestTails:
    def test_never_where_one_minus_the_rest_is_nothing(self) -> None:
        """Two masts, eleven lists each, odds of 9 : 1: never with 10⁻²², at half the odds with (2/11)²²."""
        result = run_experiment(masts(2, 0.9), [one_walker()])
        assert result.exact is not None
        never, row = result.exact.iloc[-1], result.summary.iloc[0]
        assert never["probability"] == pytest.approx(1e-22, rel=1e-12, abs=0)
        for found in (never, row):
            assert found["miss_log10"] == pytest.approx(-22, rel=1e-13)
            assert found["miss_per_logit"] == pytest.approx(-22 * 0.9, rel=1e-13)
            assert found["miss_log10_half_odds"] == pytest.approx(22 * math.log10(2 / 11), rel=1e-13)

    def test_a_logarithm_where_there_is_no_double_any_more(self) -> None:
        row = run_experiment(masts(110, 0.999), [one_walker()]).summary.iloc[0]
        assert row["miss_log10"] == pytest.approx(-3 * 110 * 11, rel=1e-12)

    def test_when_two_of_two_are_asked_for(self) -> None:
        """Three lists: all miss but the middle one, or but one at an end, or all, or but both ends."""
        there = one_walker(lambda t: t < 0.25)
        plan = masts(1, 0.999, measure={"onset": {"kind": "appears"}, "confirm": {"hits": 2, "of": 2}, "exact": True})
        row = run_experiment(plan, [there]).summary.iloc[0]
        p, q = 0.999, 1 - 0.999
        assert row["miss_log10"] == pytest.approx(math.log10(q**3 + 3 * p * q**2 + p * p * q), rel=1e-13)

    def test_over_objects(self) -> None:
        """b has left after two lists, a after four; odds of 9 : 1: the mean of 10⁻⁴ and 10⁻² hangs on b's lists."""
        things = [
            Thing("ego", "car", standing(0, 0)),
            Thing("a", "pedestrian", standing(20, 0), lambda t: t < 0.35),
            Thing("b", "pedestrian", standing(30, 0), lambda t: t < 0.15),
        ]
        row = run_experiment(masts(1, 0.9), [recording(things, until_s=1.0)]).summary.iloc[0]
        assert row["miss_log10"] == pytest.approx(math.log10((1e-4 + 1e-2) / 2), rel=1e-13)
        assert row["miss_per_logit"] == pytest.approx(-(1e-4 * 3.6 + 1e-2 * 1.8) / (1e-4 + 1e-2), rel=1e-12)
        half = math.log10(((2 / 11) ** 4 + (2 / 11) ** 2) / 2)
        assert row["miss_log10_half_odds"] == pytest.approx(half, rel=1e-13)

    def test_in_a_sweep(self) -> None:
        """What is later than 0.25 s leaves eight lists of eleven."""
        sweep = run_experiment(
            masts(1, 0.9, sweep={"configurations": ["all"], "latency_s": [0.25]}), [one_walker()]
        ).sweep
        assert sweep is not None
        assert sweep["miss_log10"].tolist() == pytest.approx([-8], rel=1e-13)
        assert sweep["miss_per_logit"].tolist() == pytest.approx([-7.2], rel=1e-13)
        assert sweep["miss_log10_half_odds"].tolist() == pytest.approx([8 * math.log10(2 / 11)], rel=1e-13)

    def test_where_some_are_certain(self) -> None:
        """Over all looks, those that cannot miss included; where none can, there is no logarithm."""
        things = [Thing("ego", "car", standing(0, 0)), Thing("a", "pedestrian", standing(20, 0))]
        log = recording([*things, Thing("b", "car", standing(30, 0))], until_s=1.0)
        couples = [
            {"when": {"classes": ["car"]}, "detection": {"kind": "constant", "probability": 1.0}},
            {"detection": {"kind": "constant", "probability": 0.9}},
        ]
        both = {"all": {"units": "all"}, "GT": {"units": "truth"}}
        rows = run_experiment(masts(1, pems={"p": couples}, configurations=both), [log]).summary.set_index(
            "configuration"
        )
        assert rows.loc["all", "miss_log10"] == pytest.approx(math.log10(1e-11 / 2), rel=1e-13)
        assert rows.loc["all", "miss_per_logit"] == pytest.approx(-9.9, rel=1e-13)
        assert rows.loc["GT", ["miss_log10", "miss_per_logit", "miss_log10_half_odds"]].isna().all()

    def test_who_may_be_there(self) -> None:
        """A mast's lists miss with 10⁻¹¹; a car at 0.5 that is there misses with 10⁻¹¹ more, else with all of it."""
        things = [
            Thing("ego", "car", standing(0, 0)),
            Thing("v", "car", standing(0, 9)),
            Thing("a", "pedestrian", standing(20, 0)),
        ]
        units = {
            "mast": {"at": [20, 5], "height_m": 5.0, "pem": "p"},
            "fleet": {"on": {"classes": ["car"], "penetration_rate": 0.5}, "pem": "p"},
        }
        measure = {"onset": {"kind": "appears"}, "objects": {"classes": ["pedestrian"]}, "exact": True}
        row = run_experiment(
            masts(1, 0.9, units=units, measure=measure), [recording(things, until_s=1.0)]
        ).summary.iloc[0]
        assert row["miss_log10"] == pytest.approx(-11 + math.log10(0.5 + 0.5e-11), rel=1e-13)
        assert row["miss_per_logit"] == pytest.approx(-9.9 * (1 + 1e-11 / (1 + 1e-11)), rel=1e-13)


@SOME
@given(worlds())
def test_probabilities_sum_to_one_and_the_incidence_is_their_sum(world: World) -> None:
    ready, plan = replayed(world)
    rows = exact_table(ready, plan)
    assert (rows["probability"] >= 0).all()
    for _, part in rows.groupby("object_id"):
        assert part["probability"].sum() == pytest.approx(1, abs=1e-12)
        assert part["detection_s"].isna().tolist() == [False] * (len(part) - 1) + [True]
        known = part.iloc[:-1]
        np.testing.assert_allclose(known["incidence"], known["probability"].cumsum(), atol=1e-15)
        np.testing.assert_allclose(known["time_to_detection_s"], known["detection_s"] - known["onset_s"], atol=0)
        assert (known["detection_s"] <= known["ended_s"] + 1e-6).all()


# ------------------------------------------------------------------------------------ what has no closed form


def refused(plan: Experiment, log: Recording) -> str:
    """The line with which it is refused, before anything is run."""
    steps: list[tuple[int, int]] = []
    with pytest.raises(ExperimentError) as caught:
        run_experiment(plan, [log], progress=lambda done, total: steps.append((done, total)))
    assert steps == []
    (line,) = caught.value.problems
    assert "\n" not in line
    return line


TWO_OF_TWO = {"onset": {"kind": "appears"}, "confirm": {"hits": 2, "of": 2}, "exact": True}


class TestRefused:
    def test_units_that_do_not_share_the_instants(self) -> None:
        units = {
            "ego": {"on": "ego", "pem": "p"},
            "mast": {"at": [5, 5], "height_m": 4.0, "pem": "p", "rate_hz": 20},
        }
        both = {"PEM": {"units": ["ego"]}, "both": {"units": "all"}}
        line = refused(masts(1, units=units, configurations=both, measure=TWO_OF_TWO), one_walker())
        assert line.startswith("scene: exact: configuration both: unit ego does not list at every instant")
        alone = masts(1, units=units, configurations={"PEM": both["PEM"]}, measure=TWO_OF_TWO)
        assert run_experiment(alone, [one_walker()]).exact is not None
        once = masts(1, units=units, configurations=both)
        assert run_experiment(once, [one_walker()]).exact is not None

    def test_a_carrier_that_is_not_there_all_the_time(self) -> None:
        things = [
            Thing("ego", "car", standing(0, 0)),
            Thing("v", "car", standing(0, 9), lambda t: t < 0.55),
            Thing("a", "pedestrian", standing(20, 0)),
        ]
        units = {"ego": {"on": "ego", "pem": "p"}, "v2v": {"on": "v", "pem": "p"}}
        line = refused(masts(1, units=units, measure=TWO_OF_TWO), recording(things, until_s=1.0))
        assert "configuration all: unit v2v does not list at every instant" in line

    @pytest.mark.parametrize("latency", [{"m0": 0.1}, {"m0": 0.1, "default": 0.3}, {"m1": 1e-5}])
    def test_different_latencies(self, latency: dict[str, float]) -> None:
        late = {"late": {"units": "all", "latency_s": latency}}
        line = refused(masts(2, configurations=late, measure=TWO_OF_TWO), one_walker())
        assert line.startswith("scene: exact: configuration late: lists that count as one hit arrive up to ")
        assert run_experiment(masts(2, configurations=late), [one_walker()]).exact is not None
        alike = {"late": {"units": "all", "latency_s": {"m0": 0.1, "default": 0.1}}}
        assert run_experiment(masts(2, configurations=alike, measure=TWO_OF_TWO), [one_walker()]).exact is not None

    @pytest.mark.parametrize(
        ("confirm", "expected"),
        [
            ("hits: 2, of: 12", []),
            ("hits: 1, of: 1000", []),
            ("of: 1000", []),
            (
                "hits: 2, of: 13",
                ["17: measure.confirm.of: for `exact` expected at most 12 (2 to the power of `of` states), found 13"],
            ),
            (
                "hits: 13, of: 1000",
                ["17: measure.confirm.of: for `exact` expected at most 12 (2 to the power of `of` states), found 1000"],
            ),
        ],
    )
    def test_longer_chains(self, tmp_path: Path, confirm: str, expected: list[str]) -> None:
        assert checked(tmp_path, f"measure: {{confirm: {{{confirm}}}, exact: true}}") == expected
        assert checked(tmp_path, f"measure: {{confirm: {{{confirm}}}, exact: false}}") == []
        assert checked(tmp_path, f"measure: {{confirm: {{{confirm}}}}}") == []

    def test_braking_for_conflicts(self, tmp_path: Path) -> None:
        braking = "braking: {driver: {kind: constant_deceleration, a_max_mps2: 8}, brakes_for: %s}"
        measure = "measure: {conflict: {horizon_s: 3}, exact: true}"
        assert checked(tmp_path, measure, braking % "conflict") == [
            "17: measure.exact: perceived conflicts depend on sampled errors and have no closed form; "
            "use `brakes_for: object`"
        ]
        assert checked(tmp_path, measure, braking % "object") == []
        assert checked(tmp_path, measure.replace("true", "false"), braking % "conflict") == []

    def test_braking_for_conflicts_by_the_library(self) -> None:
        things = [Thing("ego", "car", driving(-30, 0, 10)), Thing("w", "pedestrian", driving(0, -3, 0, 1))]
        plan = masts(
            1,
            measure={"onset": {"kind": "appears"}, "conflict": {"horizon_s": 1.0}, "exact": True},
            braking={"driver": {"kind": "constant_deceleration", "a_max_mps2": 8.0}, "brakes_for": "conflict"},
        )
        assert "no closed form" in refused(plan, recording(things, until_s=4.0))

    @pytest.mark.parametrize(
        "configurations",
        [
            {"all": {"units": "all"}, "gnn": {"units": "all", "fusion": {"kind": "gnn"}}},
            {"union": {"units": "all", "fusion": {"kind": "union"}}},
        ],
    )
    @pytest.mark.parametrize("confirm", [{"hits": 1, "of": 1}, {"hits": 2, "of": 2}])
    def test_matches_by_the_library(self, configurations: dict[str, Any], confirm: dict[str, int]) -> None:
        """Which entry is about whom depends on sampled errors."""
        asked = {"onset": {"kind": "appears"}, "exact": True, "confirm": confirm}
        assert "exact" in refused(masts(1, measure=asked, configurations=configurations), one_walker())

    def test_by_the_command(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """One line, exit 2, and nothing is written."""
        drive(tmp_path / "drive.mcap")
        text = changed("  mast: {at: [1, 2], height_m: 5, pem: onboard, rate_hz: 7}",
                       "measure: {confirm: {hits: 2, of: 3}, exact: true}")  # fmt: skip
        (tmp_path / "e.yaml").write_text(text)
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr("sys.argv", ["copem-replay", "run", "e.yaml"])
        assert cli._run_to_exit_code() == 2
        assert capsys.readouterr().err.count("\n") == 1
        assert sorted(path.name for path in tmp_path.iterdir()) == ["drive.mcap", "e.yaml"]


def checked(folder: Path, *changes: str) -> list[str]:
    """`line: key: message` of what is wrong with the small experiment when lines of it are changed."""
    (folder / "drive.mcap").touch()
    source = source_of(folder, changed(*changes))
    return [line.removeprefix(f"{source.path}:") for line in find_problems(source)[1]]


# ------------------------------------------------------------------------------- the runs, and what they tend to


@cache
def replayed_file(name: str, **changes: Any) -> StudyTables:
    """An experiment of ours with its exact times and without accuracy; `confirm`: hits and of."""
    source = read_experiment_file(ROOT / "logs" / f"{name}.yaml")
    confirm = changes.get("confirm")
    source.data["measure"] |= {"exact": True, "accuracy": False}
    if confirm is not None:
        source.data["measure"]["confirm"] = {"hits": confirm[0], "of": confirm[1]}
    planned, found = find_problems(source)
    assert not found
    assert planned is not None
    recordings, refusals = read_logs(planned, log_paths(source)[0], source)
    assert not refusals
    return run_experiment(planned, recordings)


CASES = {"tc016d": (None, 6), "tc016d 3 of 5": ((3, 5), 6), "crossing_units": (None, 9 * 21)}
"""Files, how they confirm, and in how many pairs of configuration and object runs are compared."""
RISK = 1e-6 / (sum(count for _, count in CASES.values()) + 6)
"""That any of all bands is left by chance, shared by all, 6 for the shares that pass."""


def band(runs: int, risk: float) -> float:
    """How far the share of runs is from the distribution function anywhere, but for `risk` (Dvoretzky, Kiefer,
    Wolfowitz 1956, with the constant of Massart 1990)."""
    return math.sqrt(math.log(2 / risk) / (2 * runs))


def farthest(times_s: np.ndarray, part: pd.DataFrame) -> float:
    """Between the distribution function of some runs (NaN: never) and the exact one (its rows of one object).

    Both are compared after each instant at which either may step; never is one more.
    """
    known = part[part["detection_s"].notna()].sort_values("detection_s")
    at, probability = known["detection_s"].to_numpy(), known["probability"].to_numpy()
    happened = times_s[~np.isnan(times_s)]
    place = np.searchsorted(at, happened - 2e-6)
    assert (place < len(at)).all(), "detected later than can be"
    assert (np.abs(at[place] - happened) < 2e-6).all(), "detected when no list arrives"
    assert (probability[place] > 0).all(), "detected when it cannot be"
    steps = np.cumsum(np.bincount(place, minlength=len(at))) / len(times_s)
    return float(np.abs(steps - np.cumsum(probability)).max(initial=0.0))


def pairs(result: StudyTables) -> list[tuple[tuple[str, ...], pd.DataFrame, pd.DataFrame]]:
    """The runs and the exact rows of each log, configuration and object."""
    assert result.exact is not None
    keys = ["log", "configuration", "object_id"]
    by = dict(iter(result.exact.groupby(keys)))
    runs = dict(iter(study_rows(result).groupby(keys)))
    assert by.keys() == runs.keys()
    return [(key, runs[key], by[key]) for key in by]


@pytest.mark.parametrize("case", CASES)
def test_the_runs_are_within_the_band_of_the_exact_distribution(case: str) -> None:
    confirm, count = CASES[case]
    result = replayed_file(case.partition(" ")[0], confirm=confirm)
    compared_pairs = pairs(result)
    assert len(compared_pairs) == count
    for key, runs, rows in compared_pairs:
        far = farthest(runs["detection_s"].to_numpy(), rows)
        assert far <= band(len(runs), RISK), key
        # What is certain is so in every run.
        if rows["probability"].max() == 1:
            assert far == 0


def test_the_summary_is_what_the_runs_tend_to() -> None:
    """Over all 21 objects of the crossing, which leave and are censored: within the bands of all of them together."""
    result = replayed_file("crossing_units", confirm=None)
    for row in result.summary.itertuples():
        assert row.detected_share_exact == pytest.approx(row.detected_share, abs=0.02)
        assert row.ttd_rmst_s_exact == pytest.approx(row.ttd_rmst_s, abs=0.2)
        assert (row.ttd_p95_s_exact is None or math.isnan(row.ttd_p95_s_exact)) == math.isnan(row.ttd_p95_s)


class TestPassing:
    def test_the_runs_pass_as_often(self) -> None:
        """Numbers of passing runs, two-sided, by the binomial distribution."""
        result = replayed_file("tc016d", confirm=None)
        for row in result.summary.itertuples():
            passed = round(row.pass_share * row.n_conflict)
            assert row.pass_share == passed / row.n_conflict
            law = scipy.stats.binom(row.n_conflict, row.pass_share_exact)
            assert min(law.cdf(passed), law.sf(passed - 1)) >= RISK / 2, row.configuration

    def test_as_exact_rows_say(self) -> None:
        result = replayed_file("tc016d", confirm=None)
        assert result.exact is not None
        assert result.exact["conflict"].all()
        for row in result.summary.itertuples():
            part = result.exact[result.exact["configuration"] == row.configuration]
            assert row.pass_share_exact == pytest.approx((part["probability"] * part["pass_probability"]).sum())
        assert (result.exact.loc[result.exact["detection_s"].isna(), "pass_probability"] == 0).all(), "never brakes"

    def test_equal_times_pass_equally(self) -> None:
        """What is known at one instant is braked for alike, whoever knew; the masts know as soon as the truth does."""
        result = replayed_file("tc016d", confirm=None)
        assert result.exact is not None
        known = result.exact.dropna(subset="detection_s")
        spread = known.groupby(known["detection_s"].round(6))["pass_probability"].agg(["min", "max"])
        np.testing.assert_allclose(spread["min"], spread["max"], atol=1e-9)
        parts = dict(iter(result.exact.groupby("configuration")))
        truth, masts_too = parts["GT"], parts["coPEM:0s"]
        np.testing.assert_allclose(masts_too["probability"], truth["probability"], atol=1e-12)
        rows = result.summary.set_index("configuration")
        assert rows.loc["GT", "pass_share_exact"] == pytest.approx(rows.loc["coPEM:0s", "pass_share_exact"], abs=1e-12)
        assert rows.loc["GT", "pass_share"] == rows.loc["coPEM:0s", "pass_share"]

    def test_later_is_never_better_here(self) -> None:
        """Somebody crosses before it: the sooner it brakes the more probably it stays clear."""
        result = replayed_file("tc016d", confirm=None)
        assert result.exact is not None
        for _, part in result.exact.groupby("configuration"):
            assert (np.diff(part["pass_probability"]) <= 1e-12).all()

    def test_by_the_verdicts_of_many_reactions(self) -> None:
        """The mean verdict over 500 equally probable reactions, by the same judge as the runs."""
        result = replayed_file("tc016d", confirm=None)
        assert result.exact is not None
        (ready,) = (log.replay() for log in result.logs)
        (encounter,) = ready.encounters
        braking = ready.expanded.braking
        assert braking is not None
        shape, mean_s = (braking.driver.reaction.model_dump()[name] for name in ("shape", "mean_s"))
        delay_s = scipy.stats.gamma.ppf((np.arange(500) + 0.5) / 500, shape, scale=mean_s / shape)
        part = result.exact[result.exact["configuration"] == "PEM"]
        for row in part[part["detection_s"] < part["onset_s"] + 1.6].itertuples():
            verdicts = judge_braking(encounter, braking.driver, row.detection_s + delay_s)
            share = np.mean(verdicts.min_distance_m > braking.margin_m)
            assert row.pass_probability == pytest.approx(share, abs=1 / 500), row.detection_s

    @staticmethod
    def meeting(reaction: dict[str, Any] | None, probability: float = 0.25, **changes: Any) -> StudyTables:
        """The ego, 4 m long, drives at 10 m/s towards a pedestrian who stands on its way, his near side at 39.75 m.

        It stops in 6.25 m, 0.5 m are to be left: who begins to brake before 3.1 s stays clear.
        """
        driver: dict[str, Any] = {"kind": "constant_deceleration", "a_max_mps2": 8.0}
        things = [Thing("ego", "car", driving(0, 0, 10)), Thing("a", "pedestrian", standing(40, 0))]
        aside = Thing("b", "pedestrian", standing(20, 30))
        plan = masts(
            1,
            probability,
            runs=200,
            configurations={"all": {"units": "all"}, "GT": {"units": "truth"}},
            braking={"driver": driver if reaction is None else driver | {"reaction": reaction}},
            **changes,
        )
        return run_experiment(plan, [recording([*things, aside], until_s=5.0)])

    def test_by_hand(self) -> None:
        """After a reaction of 0.25 s he has to be known by 2.85 s: the first 29 lists are soon enough."""
        result = self.meeting({"kind": "constant", "delay_s": 0.25})
        rows = result.summary.set_index("configuration")
        assert rows.loc["all", "pass_share_exact"] == pytest.approx(1 - 0.75**29, abs=1e-12)
        assert rows.loc["GT", "pass_share_exact"] == pytest.approx(1, abs=1e-12)
        assert rows["n_conflict"].tolist() == [200, 200]
        assert result.exact is not None
        conflict = result.exact.groupby("object_id")["conflict"].unique()
        assert (conflict["a"].tolist(), conflict["b"].tolist()) == ([True], [False])
        assert result.exact.loc[~result.exact["conflict"], "pass_probability"].isna().all()
        part = result.exact[(result.exact["configuration"] == "all") & result.exact["conflict"]]
        assert part["pass_probability"].tolist() == pytest.approx([1] * 29 + [0] * (len(part) - 29), abs=1e-12)

    def test_failing_is_not_one_minus_passing(self) -> None:
        """With 0.9 instead: the first 29 lists miss him with 10⁻²⁹."""
        rows = self.meeting({"kind": "constant", "delay_s": 0.25}, 0.9).summary.set_index("configuration")
        assert rows.loc["all", "fail_share_exact"] == pytest.approx(1e-29, rel=1e-11, abs=0)
        assert rows.loc["GT", "fail_share_exact"] == 0
        assert rows.loc["all", "miss_log10"] == pytest.approx(-51, rel=1e-12)

    @pytest.mark.parametrize(
        "reaction",
        [
            {"kind": "gamma", "shape": 1.41, "mean_s": 0.05},
            {"kind": "gamma", "shape": 400.0, "mean_s": 1.0},
            {"kind": "lognormal", "median_s": 0.05, "sigma": 0.12},
        ],
    )
    def test_failing_by_the_reactions_far_tail(self, reaction: dict[str, Any]) -> None:
        """Known at 0 s, as by the truth, it fails when the reaction takes longer than the 3.1 s that are left.

        Who may miss him fails with the mean of that over the instants at which he may be known, in 60 digits.
        """
        result = self.meeting(reaction, 0.9)
        (between_s,) = result.logs[0].replay().passing_s.values()
        assert between_s[0, 1] == pytest.approx(3.1, abs=1e-4)
        rows = result.summary.set_index("configuration")
        with mp.workdps(60):
            last_s, never = mpf(between_s[0, 1]), mpf(1 - 0.9) ** 51
            chance = [(mpf(0.9) * mpf(1 - 0.9) ** k, longer(reaction, last_s - mpf(k) / 10)) for k in range(51)]
            expected = sum(p * fails for p, fails in chance) + never
            assert float(longer(reaction, last_s)) < 1e-20
            assert rows.loc["GT", "fail_share_exact"] == pytest.approx(float(longer(reaction, last_s)), rel=1e-9, abs=0)
            assert rows.loc["all", "fail_share_exact"] == pytest.approx(float(expected), rel=1e-9, abs=0)
        assert (rows["pass_share_exact"] == 1).all()

    def test_failing_with_a_reaction_that_gives_no_survival(self) -> None:
        """At 0.9 it fails with 10⁻²⁹, of which nothing is known; at ½ with 2⁻²⁹."""
        own = {"kind": "tests.pipeline.test_closed_form:Prompt"}
        result = self.meeting(own, 0.9)
        rows = result.summary.set_index("configuration")
        assert rows["fail_share_exact"].isna().all()
        assert result.exact is not None
        part = result.exact[result.exact["conflict"] & (result.exact["configuration"] == "all")]
        assert part["fail_probability"].isna().tolist() == [True] * 29 + [False] * 23
        rows = self.meeting(own, 0.5).summary.set_index("configuration")
        assert rows.loc["all", "fail_share_exact"] == pytest.approx(2.0**-29, rel=1e-6, abs=0)
        told = self.meeting({"kind": "tests.pipeline.test_closed_form:Told"}, 0.9).summary.set_index("configuration")
        assert told.loc["all", "fail_share_exact"] == pytest.approx(1e-29, rel=1e-11, abs=0)

    def test_by_hand_with_chance_in_the_reaction(self) -> None:
        """With median 0.6 s: known at t it passes with Φ(ln((3.1 − t) / 0.6) / σ)."""
        result = self.meeting({"kind": "lognormal", "median_s": 0.6, "sigma": 0.5})
        assert result.exact is not None
        part = result.exact[(result.exact["configuration"] == "all") & result.exact["conflict"]].iloc[:-1]
        left_s = np.maximum(3.1 - part["detection_s"], 1e-12)
        expected = scipy.stats.norm.cdf(np.log(left_s / 0.6) / 0.5)
        np.testing.assert_allclose(part["pass_probability"], expected, atol=1e-6)

    def test_who_reacts_at_once(self) -> None:
        """No reaction is given: it takes no time. The truth knows him at 0 s, and brakes 3 s before it must."""
        rows = self.meeting(None).summary.set_index("configuration")
        assert rows["pass_share"].tolist() == [1, 1]
        assert rows.loc["GT", "pass_share_exact"] == pytest.approx(1, abs=1e-12)
        assert rows.loc["all", "pass_share_exact"] == pytest.approx(1 - 0.75**31, abs=1e-4)  # 3.1 s is the very border

    def test_known_before_the_onset(self) -> None:
        """What is known before the onset is braked for from the onset on."""
        measure = {"onset": {"kind": "at", "time_s": 2.75}, "count_earlier": True, "exact": True}
        result = self.meeting({"kind": "constant", "delay_s": 0.25}, measure=measure)
        rows = result.summary.set_index("configuration")
        # Braking begins at 3.0 s at the earliest; lists of 0 … 2.8 s are soon enough.
        assert rows.loc["all", "pass_share_exact"] == pytest.approx(1 - 0.75**29, abs=1e-12)
        assert rows.loc["all", "pass_share"] == 1


class Prompt(Reaction):
    """A reaction of one's own: 0.25 s."""

    def delays(self, uniform: Float) -> Float:
        return np.full(len(uniform), 0.25)


class Told(Prompt):
    """It says how probably it takes longer, too."""

    def survival(self, delay_s: Float) -> Float:
        return np.where(delay_s < 0.25, 1.0, 0.0)


def longer(reaction: dict[str, Any], delay_s: Any) -> Any:
    """The probability that it takes longer, of mpmath."""
    if delay_s <= 0:
        return mpf(1)
    if reaction["kind"] == "gamma":
        shape = mpf(reaction["shape"])
        return mpmath.gammainc(shape, delay_s * shape / mpf(reaction["mean_s"]), mpmath.inf, regularized=True)
    return mpmath.ncdf(-mpmath.log(delay_s / mpf(reaction["median_s"])) / mpf(reaction["sigma"]))


@pytest.mark.parametrize("braking", [False, True])
def test_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], braking: bool
) -> None:
    """exact.parquet: a row per configuration, object and instant, and one for never, in which there is no instant."""
    drive(tmp_path / "drive.mcap")
    driver = "braking: {driver: {kind: constant_deceleration, a_max_mps2: 8}}"
    measure = "measure: {onset: {kind: in_range, range_m: 60}, exact: true}"
    (tmp_path / "e.yaml").write_text(changed(measure, *([driver] if braking else [])))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["copem-replay", "run", "e.yaml"])
    assert cli._run_to_exit_code() == 0, capsys.readouterr().err
    table = parquet.read_table(tmp_path / "out" / "e" / "exact.parquet")
    assert {*table.column_names} == {*TABLES["exact.parquet"].kinds(*["braking"] * braking)}
    rows = table.to_pylist()
    # From 1 s on, when the car is 60 m away, to 3 s; the lists of coPEM half a second later.
    assert [sum(r["configuration"] == name for r in rows) for name in ("GT", "PEM", "coPEM")] == [22, 22, 17]
    for row in rows:
        of_never = [row[name] for name in ("miss_log10", "miss_per_logit", "miss_log10_half_odds")]
        if row["detection_s"] is not None or row["configuration"] == "GT":
            assert of_never == [None] * 3, "of never alone, and null where detection is certain"
        else:  # lists that each hold it with ½, with half the odds 1 : 2
            count = {"PEM": 21, "coPEM": 32}[row["configuration"]]
            assert of_never == near([count * math.log10(1 / 2), -count / 2, count * math.log10(2 / 3)])
        if row["detection_s"] is None:
            lacking = ("incidence", "time_to_detection_s", "distance_at_detection_m", "gap_at_detection_m")
            assert [row[name] for name in lacking] == [None] * 4
        elif row["configuration"] == "PEM":
            k = round((row["detection_s"] - 1) * 10)
            assert row["probability"] == pytest.approx(0.5 ** (k + 1))
            assert row["distance_at_detection_m"] == pytest.approx(60 - k)
        elif row["configuration"] == "coPEM":  # two units
            k = round((row["detection_s"] - 1.5) * 10)
            assert row["probability"] == pytest.approx(0.75 * 0.25**k)
            assert row["distance_at_detection_m"] == pytest.approx(55 - k)
        if braking:
            assert [row[name] for name in ("conflict", "pass_probability", "fail_probability")] == [False, None, None]


# -------------------------------------------------------------------------------------- summaries of exact times


class TestSummary:
    def test_departure(self) -> None:
        """a is in the log at 0, 0.1 and 0.2 s, b all the time, 0 … 1 s; each list holds them with ¼.

        P(T > 0.1 k) = ¾ᵏ⁺¹. Never: a with ¾³, which has left, and b with ¾¹¹, which was still there.
        """
        things = [
            Thing("ego", "car", standing(0, 0)),
            Thing("a", "pedestrian", standing(20, 0), lambda t: t < 0.25),
            Thing("b", "pedestrian", standing(30, 0)),
        ]
        row = run_experiment(masts(1, 0.25, runs=50), [recording(things, until_s=1.0)]).summary.iloc[0]
        quarters = [Fraction(3, 4) ** (k + 1) for k in range(11)]
        assert row["detected_share_exact"] == pytest.approx(float(1 - (quarters[2] + quarters[10]) / 2))
        assert row["ttd_p5_s_exact"] == 0
        # F is ¼, 7/16, 37/64 at 0, 0.1, 0.2 s, and at the end the share detected, 0.77.
        assert row["ttd_median_s_exact"] == pytest.approx(0.2)
        assert row["ttd_p95_s_exact"] is None
        # ∫ P(T > t) dt over the second: a's stays at ¾³ from 0.2 s on.
        a = (quarters[0] + quarters[1] + 8 * quarters[2]) / 10
        b = sum(quarters[:10], Fraction(0)) / 10
        assert row["ttd_rmst_s_exact"] == pytest.approx(float((a + b) / 2))
        assert row["ttd_rmst_horizon_s"] == 1

    @pytest.mark.parametrize("rate_hz", [4.0, 10.0])  # 1 s − 0.8 s is less than 0.2 s − 0 s, but by rounding only
    def test_censoring(self, rate_hz: float) -> None:
        """b is there for eleven lists; c comes with the ninth, and is looked at for three, until the log's end.

        Their hazards are the same, so those censored would have gone on like b: F = 1 − ¾ᵏ⁺¹ with b's k-th list.
        """
        step = 1 / rate_hz
        things = [
            Thing("ego", "car", standing(0, 0)),
            Thing("b", "pedestrian", standing(30, 0)),
            Thing("c", "pedestrian", standing(20, 0), lambda t: t > 7.5 * step),
        ]
        log = recording(things, until_s=10 * step, rate_hz=rate_hz)
        row = run_experiment(masts(1, 0.25, runs=50), [log]).summary.iloc[0]
        assert row["detected_share_exact"] == pytest.approx(1 - (0.75**3 + 0.75**11) / 2), "of what was seen, no guess"
        assert row["ttd_p5_s_exact"] == 0
        assert row["ttd_median_s_exact"] == pytest.approx(2 * step)  # ¾³ = 0.42
        assert row["ttd_p95_s_exact"] == pytest.approx(10 * step)  # ¾¹⁰ = 0.056, ¾¹¹ = 0.042
        # ∫ P(T > t) dt over ten steps: step · (¾ + ¾² + … + ¾¹⁰)
        assert row["ttd_rmst_s_exact"] == pytest.approx(step * 3 * (1 - 0.75**10))

    def test_distances(self) -> None:
        """It comes from 100 m at 10 m/s: known at 0.1 k s it is 100 − k metres away, and farther with ¾ᵏ."""
        things = [Thing("ego", "car", standing(0, 0)), Thing("a", "car", driving(100, 0, -10))]
        row = run_experiment(masts(1, 0.25), [recording(things, until_s=2.0)]).summary.iloc[0]
        assert row["dad_median_m_exact"] == pytest.approx(100 - 2)  # ¾² = 0.56 of the rows rank at or below, ¾³ = 0.42
        assert row["dad_p5_m_exact"] == pytest.approx(100 - 10)  # ¾¹⁰ = 0.056, ¾¹¹ = 0.042
        shorter = run_experiment(masts(1, 0.25), [recording(things, until_s=0.9)]).summary.iloc[0]
        assert shorter["dad_p5_m_exact"] is None  # never with ¾¹⁰
        assert shorter["dad_median_m_exact"] == pytest.approx(100 - 2)

    def test_every_object_counts_the_same(self) -> None:
        """However long it is looked at, and in whichever log."""
        one = recording([Thing("ego", "car", standing(0, 0)), Thing("a", "car", standing(20, 0))], until_s=0.1)
        three = recording(
            [Thing("ego", "car", standing(0, 0)), *(Thing(n, "car", standing(20, 5)) for n in "abc")],
            until_s=2.0,
            log="other",
        )
        row = run_experiment(masts(1), [one, three]).summary.iloc[0]
        assert row["detected_share_exact"] == pytest.approx((3 / 4 + 3 * (1 - 0.5**21)) / 4)

    @settings(max_examples=40, suppress_health_check=[HealthCheck.too_slow])  # an example replays a log
    @given(st.data())
    def test_probabilities_are_shares_of_rows(self, data: st.DataObject) -> None:
        """Sixteenths of looks count like so many rows: exact columns are those of a table that repeats them."""
        episodes = data.draw(st.integers(1, 3))
        rows, table = [], []
        for k in range(episodes):
            ended_s = data.draw(st.sampled_from([0.5, 1.0, 2.0]))
            ended_by = data.draw(st.sampled_from(["object_left", "log_end", "ego_left"]))
            marks = st.one_of(st.none(), st.sampled_from([0.0, 0.25, 0.5]))
            times = data.draw(st.lists(marks, min_size=16, max_size=16))
            base = {"log": "x", "configuration": "c", "object_id": str(k), "episode": 0, "onset_s": 0.0,
                    "ended_s": ended_s, "ended_by": ended_by}  # fmt: skip
            # Of each episode there is a row for never, be it that it cannot be.
            for t, count in ({NEVER: 0} | Counter(times)).items():
                at = math.nan if t is None else t
                row = base | {
                    "detection_s": at,
                    "time_to_detection_s": at,
                    "distance_at_detection_m": math.nan if t == 0.25 and k == 0 else 10 - at,
                }
                of_never = dict.fromkeys(("miss_log10", "miss_per_logit", "miss_log10_half_odds"), math.nan)
                if t is None and count:
                    of_never |= {"miss_log10": math.log10(count / 16), "miss_per_logit": -k, "miss_log10_half_odds": 0}
                rows.append(row | {"probability": count / 16} | of_never)
                table += [row | {"detected": t is not None, "run": 0}] * count
        rates = {"c": None}
        frame = pd.DataFrame(table)
        (row,) = summarise_rows(frame, ["c"], rates, horizon_s=2.0, exact=pd.DataFrame(rows))[0].to_dict("records")
        for name in ("detected_share", "ttd_rmst_s"):
            assert row[f"{name}_exact"] == pytest.approx(row[name], abs=1e-12)
        missed = frame.loc[~frame["detected"], "object_id"].astype(float)
        if len(missed):
            assert row["miss_log10"] == pytest.approx(math.log10(len(missed) / (16 * episodes)), abs=1e-12)
            assert row["miss_per_logit"] == pytest.approx(-missed.mean(), abs=1e-12), "by how probable each is"
            assert row["miss_log10_half_odds"] == pytest.approx(math.log10(missed.nunique() / episodes), abs=1e-12)
        else:
            assert [row[n] for n in ("miss_log10", "miss_per_logit", "miss_log10_half_odds")] == [None] * 3
        for name in ("ttd_p5_s", "ttd_median_s", "ttd_p95_s", "dad_median_m", "dad_p5_m"):
            assert row[f"{name}_exact"] == row[name] or (row[f"{name}_exact"] is None and row[name] is None), name

    @pytest.mark.parametrize("runs", [1, 2, 50])
    def test_the_truth_needs_no_runs(self, runs: int) -> None:
        """Of two who are known after a second one is censored before: nothing is up to chance, both sides are equal."""
        things = [
            Thing("ego", "car", standing(0, 0)),
            Thing("a", "car", standing(20, 0)),
            Thing("b", "car", standing(20, 5), lambda t: t > 2.55),
        ]
        late = {"GT": {"units": "truth", "latency_s": 1.0}}
        row = run_experiment(masts(1, runs=runs, configurations=late), [recording(things, until_s=3.0)]).summary.iloc[0]
        for name in ("detected_share", "ttd_p5_s", "ttd_median_s", "ttd_p95_s", "ttd_rmst_s", "dad_median_m"):
            assert row[f"{name}_exact"] == row[name], name


# ---------------------------------------------------------------------------------------- rows that have a weight

PEOPLE = st.lists(
    st.tuples(st.integers(-4, 8), st.sampled_from([CENSORED, DETECTED, LEFT]), st.integers(0, 5)),
    min_size=1,
    max_size=12,
).filter(lambda group: any(count for *_, count in group))
"""Times in quarters of a second, endings, and how often each is there."""


def columns(people: list[tuple[int, int, int]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    time, ending, count = np.array(people).T
    return time / 4, ending, count.astype(float)


@given(PEOPLE)
def test_an_incidence_by_weight_is_that_of_repeated_rows(people: list[tuple[int, int, int]]) -> None:
    time_s, ending, count = columns(people)
    repeated = np.repeat(np.arange(len(time_s)), count.astype(int))
    expected = dict(zip(*cumulative_incidence(time_s[repeated], ending[repeated]), strict=True))
    times_s, incidence = cumulative_incidence(time_s, ending, count)
    found = dict(zip(times_s, incidence, strict=True))
    assert {t: found[t] for t in expected} == expected, "to the last bit"
    for scale in (0.5, 1 / 3, 1e-6):
        _, scaled = cumulative_incidence(time_s, ending, count * scale)
        np.testing.assert_allclose(scaled, incidence, atol=1e-12)
    _, alike = cumulative_incidence(time_s, ending, np.ones(len(time_s)))
    np.testing.assert_array_equal(alike, cumulative_incidence(time_s, ending)[1])


@given(PEOPLE, st.sampled_from([0.05, 0.25, 0.5, 0.95, 1.0]))
def test_a_quantile_by_weight_is_that_of_repeated_rows(people: list[tuple[int, int, int]], q: float) -> None:
    value, ending, count = columns(people)
    repeated = np.repeat(np.arange(len(value)), count.astype(int))
    detected = ending == DETECTED
    expected = quantile_with_never(value[repeated], detected[repeated], q)
    assert quantile_with_never(value, detected, q, count) == expected
    assert quantile_with_never(value, detected, q, np.ones(len(value))) == quantile_with_never(value, detected, q)


def test_how_little_is_nobody() -> None:
    """Censored at 1 s all but a billionth, which is detected at 2 s: it stands for all, or counts as nobody."""
    time_s, ending, weight = np.array([1.0, 2.0]), np.array([CENSORED, DETECTED]), np.array([1.0, 1e-9])
    assert cumulative_incidence(time_s, ending, weight)[1].tolist() == [pytest.approx(1)]
    for least, expected in ((1e-12, 1.0), (1e-8, 1e-9)):
        _, incidence = cumulative_incidence(time_s, ending, weight, least=least)
        assert incidence.tolist() == [pytest.approx(expected)]


def test_who_is_somebody_is_judged_at_each_censoring() -> None:
    """Four alike, censored, detected, censored, detected: the last is a quarter of all."""
    time_s, ending = np.arange(1.0, 5.0), np.array([CENSORED, DETECTED, CENSORED, DETECTED])
    assert cumulative_incidence(time_s, ending)[1].tolist() == pytest.approx([1 / 3, 1])
    # Of the one censored first three take a third each; of the one censored then nobody takes anything.
    _, incidence = cumulative_incidence(time_s, ending, least=0.3)
    assert incidence.tolist() == pytest.approx([1 / 3, 2 / 3])


@pytest.mark.parametrize("wrong", [[1.0, -0.1], [1.0, math.nan], [0.0, 0.0], [1.0]])
def test_weights_that_are_none(wrong: list[float]) -> None:
    with pytest.raises(ValueError, match="expected"):
        cumulative_incidence(np.array([1.0, 2.0]), np.array([DETECTED, LEFT]), np.array(wrong))
