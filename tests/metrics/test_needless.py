"""Needless braking: scenes by hand, and the plain oracle of `tests/oracles/needless.py`.

The ego of the worked scenes is 4 m × 2 m and drives along y = 0; its driver reacts after .25 s and brakes with
8.32 m/s², so that `brakes_at` .6 is 4.992 m/s², and `needed_at` .3 is 2.496 m/s².
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy import stats

import copem_replay as cr
from copem_replay.cli import main as cli
from copem_replay.core.errors import ExperimentError
from copem_replay.core.object_list import Entries, ObjectLists, entries_of, join_entries
from copem_replay.experiment.schema import Experiment
from copem_replay.io.recording import Recording
from copem_replay.metrics.accuracy.statistics import AccuracySettings
from copem_replay.metrics.braking.demand import BrakingEgo
from copem_replay.metrics.braking.driver import ConstantDeceleration, ConstantReaction, Driver, GammaReaction
from copem_replay.metrics.braking.encounter import EgoPath
from copem_replay.metrics.braking.needless import (
    NeedlessBraking,
    NeedlessDetector,
    TruthDemand,
    find_truth_demand,
)
from copem_replay.metrics.config import Confirm, Needless
from copem_replay.metrics.episodes import Reference
from copem_replay.metrics.matching import DUPLICATE, GHOST, MATCH, Matches
from copem_replay.pipeline import prepare as chunking
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.replay import replay_outcomes
from copem_replay.pipeline.run import run_experiment
from copem_replay.pipeline.tables import build_parts
from tests.helpers.drawn import examples
from tests.helpers.experiments import changed
from tests.helpers.recordings import Obj, pedestrian, write_recording
from tests.helpers.replays import study_accuracy
from tests.helpers.scenes import Thing, driving, recording, standing
from tests.metrics.test_conflict import drives, heading_along
from tests.oracles import needless as oracle
from tests.oracles.needless import Box, Listed, Rules
from tests.pipeline.test_chunking import assert_same_tables

LOGS = Path(__file__).parents[2] / "logs"
BRAKES_8 = ConstantDeceleration(a_max_mps2=8.32, reaction=ConstantReaction(delay_s=0.25))
BRAKING_8 = {
    "driver": {"kind": "constant_deceleration", "a_max_mps2": 8.32, "reaction": {"kind": "constant", "delay_s": 0.25}}
}
NEEDLESS, ONE_OF_ONE = Needless(), Rules()
GAP_S = 0.5
MANY = settings(max_examples=examples(), deadline=None, suppress_health_check=[HealthCheck.too_slow])


class Gentle(Driver):
    """A driver of the user's own, whose deceleration depends on time and speed."""

    kind: str = "tests.metrics.test_needless:Gentle"

    def deceleration_mps2(self, elapsed_s: Any, speed_mps: Any) -> Any:
        return np.minimum(3.0 * elapsed_s, 3.0 + 0.2 * speed_mps)


def deceleration_of(driver: Driver) -> oracle.Deceleration:
    """The same in the oracle's words."""
    if isinstance(driver, ConstantDeceleration):
        a, build_up_s = driver.a_max_mps2, driver.build_up_s
        return lambda elapsed_s, _: a * np.minimum(elapsed_s / build_up_s, 1.0) if build_up_s else a + 0 * elapsed_s
    return lambda elapsed_s, speed: np.minimum(3.0 * elapsed_s, 3.0 + 0.2 * speed)


def reaction_of(driver: Driver) -> float:
    """The median."""
    reaction = driver.reaction
    if isinstance(reaction, GammaReaction):
        return float(stats.gamma.ppf(0.5, reaction.shape, scale=reaction.mean_s / reaction.shape))
    assert isinstance(reaction, ConstantReaction)
    return reaction.delay_s


@dataclass(frozen=True)
class Drive:
    """A log with its driver, for the package and for the oracle."""

    log: Recording
    driver: Driver = BRAKES_8
    asked: Needless = NEEDLESS

    @property
    def braking(self) -> BrakingEgo:
        return BrakingEgo(EgoPath(self.log.scene, self.log.truth, GAP_S), self.driver, self.asked.slower_mps)

    @property
    def truth(self) -> TruthDemand:
        return find_truth_demand(self.braking, self.asked, self.log.scene, self.log.truth, GAP_S)

    @property
    def plain(self) -> oracle.Ego:
        truth = self.log.truth
        rows = np.flatnonzero(truth.row_object_ix == self.log.scene.ego_ix)
        x, y, yaw, vx, vy, length, width = (
            getattr(truth, f"{name}")[0, rows]
            for name in ("x_m", "y_m", "yaw_rad", "vx_mps", "vy_mps", "length_m", "width_m")
        )
        return oracle.Ego(
            truth.row_captured_s[rows], x, y, yaw, np.hypot(vx, vy), float(length[0]), float(width[0]),
            deceleration_of(self.driver), reaction_of(self.driver), self.asked.slower_mps, GAP_S,
        )  # fmt: skip

    def must_brake(self, now_s: float, *entries: Box, margin_m: float = 0.0, share: float = 0.6) -> list[bool]:
        which = np.zeros(len(entries), dtype=np.int64)
        states = np.array([numbers(of) for of in entries])
        found = self.braking.must_brake(np.array([now_s]), which, states, margin_m=margin_m, share=share)
        return [bool(of) for of in found]


def numbers(of: Box) -> list[float]:
    """As columns of a list: x, y, z, yaw, velocity, length, width."""
    return [of.x_m, of.y_m, 0.0, of.yaw_rad, of.vx_mps, of.vy_mps, of.length_m, of.width_m]


def straight(speed_mps: float, *others: Thing, until_s: float = 3.0) -> Recording:
    """The ego drives from the origin along x."""
    return recording([Thing("ego", "car", driving(0, 0, speed_mps)), *others], until_s=until_s)


class TestByHand:
    """Whether the driver must brake for an entry, at the start of a log in which he drives straight on."""

    def asked(self, speed_mps: float, entry: Box, *, margin_m: float = 0.0, share: float = 0.6) -> bool:
        drive = Drive(straight(speed_mps))
        (found,) = drive.must_brake(0.0, entry, margin_m=margin_m, share=share)
        expected = oracle.must_brake(drive.plain, 0.0, entry, margin_m=margin_m, share=share)
        assert expected in (found, None)
        return found

    @pytest.mark.parametrize(("ahead_m", "expected"), [(14.80, True), (14.83, False), (4.0, True), (2.29, False)])
    def test_something_stands_ahead(self, ahead_m: float, expected: bool) -> None:
        """At 10 m/s to 2 + .3 + 10 · .25 + 10² / (2 · 4.992) = 14.816 m; at 2.3 m it touches already."""
        assert self.asked(10.0, Box(ahead_m, 0.0)) == expected

    @pytest.mark.parametrize(("ahead_m", "expected"), [(25.32, True), (25.35, False)])
    def test_with_tolerance(self, ahead_m: float, expected: bool) -> None:
        """To 2 + .3 + .5 + 2.5 + 10² / (2 · 2.496) = 25.332 m."""
        assert self.asked(10.0, Box(ahead_m, 0.0), margin_m=0.5, share=0.3) == expected

    @pytest.mark.parametrize(("y_m", "expected"), [(1.29, True), (1.31, False), (-1.29, True), (-1.31, False)])
    def test_beside_the_way(self, y_m: float, expected: bool) -> None:
        assert self.asked(10.0, Box(10.0, y_m)) == expected

    @pytest.mark.parametrize(
        ("listed_mps", "expected"),
        [(15.0, False), (12.0, False), (8.0, False), (2.08, False), (2.04, True), (0.0, True)],
    )
    def test_a_lead_whose_speed_is_wrong(self, listed_mps: float, expected: bool) -> None:
        """20 m behind a car at 15 m/s, w faster, takes w²/2 / (20 − .25 w): .23 at 12 m/s, 1.34 at 8, 6.92 at 0;
        4.992 at 2.062.
        """
        lead = Box(2 + 20 + 2.25, 0.0, 0.0, listed_mps, 0.0, 4.5, 1.9)
        assert self.asked(15.0, lead) == expected

    @pytest.mark.parametrize(
        ("walks_mps", "share", "expected"),
        [(1.5, 0.6, False), (2.2, 0.6, False), (2.5, 0.6, False), (2.5, 0.40, False), (2.5, 0.37, True)],
    )
    def test_a_pedestrian_from_the_right(self, walks_mps: float, share: float, expected: bool) -> None:
        """20 m ahead, 6 m to the right. At 1.5 m/s he enters after 3.13 s; the ego has passed after 2.23 s. At 2.2 m/s
        after 2.14 s, beside its rear half. At 2.5 m/s after 1.88 s, and 3.226 m/s² let him pass: .388 of 8.32.
        """
        assert self.asked(10.0, Box(20.0, -6.0, 0.0, 0.0, walks_mps), share=share) == expected

    def test_who_runs_into_its_back(self) -> None:
        assert not self.asked(10.0, Box(-9.5, 0.0, 0.0, 15.0, 0.0, 4.5, 1.9))

    def test_side_by_side(self) -> None:
        assert not self.asked(10.0, Box(0.5, 2.35, 0.0, 10.0, 0.0, 4.5, 1.9))

    @pytest.mark.parametrize(("ahead_m", "expected"), [(30.0, True), (39.2, True), (39.4, False)])
    def test_oncoming(self, ahead_m: float, expected: bool) -> None:
        """At 10 m/s; the ego stands after 2.253 s and 12.516 m, the other has come 22.532 m: who is farther than
        2 + 2.25 + 35.048 = 39.298 m runs into an ego that stands.
        """
        assert self.asked(10.0, Box(ahead_m, 0.0, math.pi, -10.0, 0.0, 4.5, 1.9)) == expected

    @pytest.mark.parametrize(("speed_mps", "expected"), [(0.99, False), (1.0, True)])
    def test_who_creeps_does_not_drive(self, speed_mps: float, expected: bool) -> None:
        assert self.asked(speed_mps, Box(2.5, 0.0)) == expected

    @pytest.mark.parametrize(("y_m", "expected"), [(1.9, False), (1.31, False), (1.29, True)])
    def test_nearer_than_the_margin_is_judged_by_touching(self, y_m: float, expected: bool) -> None:
        """Beside the ego's front half already, .3 m away, or a car's length ahead of it."""
        assert not self.asked(10.0, Box(0.0, y_m if y_m > 1.3 else 1.6), margin_m=0.8)
        assert self.asked(10.0, Box(2.8, y_m), margin_m=0.8) == expected

    @pytest.mark.parametrize("stands_s", [1.18, 3.12, 3.18, 3.22, 6.38, 12.79])
    def test_to_the_very_instant_at_which_it_stands(self, stands_s: float) -> None:
        """A hair nearer than where it stops, and a hair farther, however long that takes."""
        speed = (stands_s - 0.25) * 4.992
        border_m = 2 + 0.3 + 0.25 * speed + speed**2 / (2 * 4.992)
        drive = Drive(straight(speed))
        assert drive.must_brake(0.0, Box(border_m - 2e-4, 0.0), Box(border_m + 2e-4, 0.0)) == [True, False]

    def test_an_entry_whose_place_is_not_known(self) -> None:
        drive = Drive(straight(10.0))
        assert drive.must_brake(0.0, Box(math.nan, 0.0), Box(10.0, 0.0, 0.0, math.nan), Box(10.0, 0.0)) == [
            False, False, True,
        ]  # fmt: skip

    def test_a_list_that_is_never_available_and_an_ego_that_is_gone(self) -> None:
        drive = Drive(straight(10.0))
        ahead = [numbers(Box(x, 0.0)) for x in (10.0, 40.0, 10.0)]
        time_s, which = np.array([0.0, 3.01]), np.array([0, 1, -1])
        found = drive.braking.must_brake(time_s, which, np.array(ahead), margin_m=0.0, share=0.6)
        assert found.tolist() == [True, False, False]


# Drawn: egos, drivers, and entries near where the ego will be.


@st.composite
def drivers(draw: st.DrawFn) -> Driver:
    reaction: Any = draw(
        st.one_of(
            st.builds(ConstantReaction, delay_s=st.sampled_from([0.0, 0.25, 0.333, 0.75, 1.2])),
            st.builds(GammaReaction, shape=st.just(1.57), mean_s=st.sampled_from([0.302, 0.8])),
        )
    )
    if draw(st.integers(0, 4)) == 0:
        return Gentle(reaction=reaction)
    build_up_s = draw(st.sampled_from([0.0, 0.0, 0.05, 0.6, 1.5]))
    return ConstantDeceleration(a_max_mps2=draw(st.floats(2, 10)), build_up_s=build_up_s, reaction=reaction)


@st.composite
def egos(draw: st.DrawFn) -> Drive:
    """An ego that drives for 3 s: straight on, in a bend, stopping, setting off."""
    at, heading, _, _ = draw(drives())
    log = heading_along(recording([Thing("ego", "car", at, yaw_rad=heading)], until_s=3.0))
    return Drive(log, draw(drivers()))


@st.composite
def entries_around(draw: st.DrawFn, ego: oracle.Ego, now_s: float) -> Box:
    """An entry that is near the ego's way after some time, whatever it does until then."""
    after_s = draw(st.floats(0.1, 3.5))
    x, y, yaw = (float(of[0]) for of in ego.poses(now_s, np.array([ego.speed(now_s) * after_s])))
    course = yaw + draw(st.sampled_from([0.0, 0.0, math.pi, math.pi / 2, -math.pi / 2, 0.5]))
    speed = draw(st.sampled_from([0.0, 0.0, 1.5, 5.0, 12.0]))
    ahead, aside = draw(st.floats(-3, 3)), draw(st.floats(-2, 2))
    x += math.cos(yaw) * ahead - math.sin(yaw) * aside
    y += math.sin(yaw) * ahead + math.cos(yaw) * aside
    vx, vy = speed * math.cos(course), speed * math.sin(course)
    length, width = draw(st.sampled_from([(0.6, 0.6), (4.5, 1.9), (12.0, 2.5)]))
    return Box(x - vx * after_s, y - vy * after_s, course, vx, vy, length, width)


@MANY
@given(st.data())
def test_whether_he_must_brake_is_what_the_oracle_says(data: st.DataObject) -> None:
    drive, now_s = data.draw(egos()), data.draw(st.sampled_from([0.0, 0.25, 0.7, 1.0, 1.73, 2.9]))
    plain = drive.plain
    entries = [data.draw(entries_around(plain, now_s)) for _ in range(4)]
    margin_m, share = data.draw(st.sampled_from([(0.0, 0.6), (0.5, 0.3), (0.3, 1.0)]))
    found = drive.must_brake(now_s, *entries, margin_m=margin_m, share=share)
    for entry, answer in zip(entries, found, strict=True):
        expected = oracle.must_brake(plain, now_s, entry, margin_m=margin_m, share=share)
        assert expected is None or answer == expected, entry


# The truth's reasons, and lists made by hand.


class TestTruth:
    @settings(MANY, max_examples=examples(60) // 3)
    @given(st.data())
    def test_reasons_are_what_the_oracle_says(self, data: st.DataObject) -> None:
        """At three tenths of a second of a log with a car and a pedestrian, one of them in the log for a while only."""
        drive = data.draw(egos())
        begins_s, course = data.draw(st.sampled_from([0.0, 0.7])), data.draw(st.floats(-math.pi, math.pi))
        cars = [data.draw(entries_around(drive.plain, 0.0)) for _ in range(2)]
        others = [
            Thing(f"other {k}", "car", driving(of.x_m, of.y_m, of.vx_mps, of.vy_mps),
                  there=lambda t, k=k: k == 0 or t > begins_s - 1e-9, yaw_rad=course, size_m=(0.8, 0.8, 1.8))  # type: ignore[misc]
            for k, of in enumerate(cars)
        ]  # fmt: skip
        track = drive.log.truth
        ego = Thing("ego", "car", lambda t: (float(np.interp(t, track.captured_s, track.x_m[0])),
                                             float(np.interp(t, track.captured_s, track.y_m[0]))))  # fmt: skip
        both = recording([ego, *others], until_s=3.0)
        columns = {}
        for name in ("x_m", "y_m", "yaw_rad", "vx_mps", "vy_mps"):
            columns[name] = getattr(both.truth, name).copy()
            columns[name][0, : len(track.captured_s)] = getattr(track, name)[0]
        drive = replace(drive, log=replace(both, truth=replace(both.truth, **columns)))
        truth, plain = drive.truth, drive.plain
        assert truth.time_s == pytest.approx(np.arange(31) / 10)
        assert truth.driving_s == pytest.approx(plain.driving_s())
        for place in data.draw(st.lists(st.integers(0, 30), min_size=3, max_size=3, unique=True)):
            now_s = place / 10
            there = [of for k, of in enumerate(cars) if k == 0 or now_s > begins_s - 1e-9]
            boxes = [
                replace(of, x_m=of.x_m + of.vx_mps * now_s, y_m=of.y_m + of.vy_mps * now_s, yaw_rad=course,
                        length_m=0.8, width_m=0.8)
                for of in there
            ]  # fmt: skip
            for found, margin_m, share in ((truth.must, 0.0, 0.6), (truth.needed, 0.5, 0.3)):
                answers = {oracle.must_brake(plain, now_s, of, margin_m=margin_m, share=share) for of in boxes}
                if True in answers or None not in answers:
                    assert found[place] == (True in answers)

    def test_standing_ones_count_and_the_ego_does_not(self) -> None:
        """At 10 m/s towards a wall 30 m ahead, .6 m thick and not measured: with tolerance 25.332 m and nearer, in
        front of it from .5 s on; 14.816 m and nearer from 1.6 s on, until it touches at 2.77 s.
        """
        wall = Thing("wall", "other", standing(30, 0), size_m=(0.6, 0.6, 2.0), moving=False)
        truth = Drive(straight(10.0, wall)).truth
        assert np.flatnonzero(truth.needed).tolist() == list(range(5, 28))
        assert np.flatnonzero(truth.must).tolist() == list(range(16, 28))

    @pytest.mark.parametrize(("now_s", "expected"), [(0.04, False), (0.06, True), (3.34, True), (3.36, False)])
    def test_within_half_a_second(self, now_s: float, expected: bool) -> None:
        """Reasons at .6 … 2.8 s; half a tenth more, as they are looked for every tenth of a second."""
        wall = Thing("wall", "other", standing(30.8, 0), size_m=(0.6, 0.6, 2.0), moving=False)
        truth = Drive(straight(10.0, wall)).truth
        assert np.flatnonzero(truth.needed)[[0, -1]].tolist() == [6, 28]
        assert truth.is_needed(np.array([now_s])).tolist() == [expected]

    def test_the_ego_that_stands_does_not_drive(self) -> None:
        log = recording([Thing("ego", "car", standing(0, 0)), Thing("car", "car", driving(30, 0, -10))], until_s=3.0)
        truth = Drive(log).truth
        assert (truth.driving_s, truth.must.any(), truth.needed.any()) == (0.0, False, False)

    def test_gaps_of_the_ego_are_no_driving(self) -> None:
        """Of 4 s it is missing for .8 s, and for .4 s that are bridged."""
        there = lambda t: not (1.01 < t < 1.79 or 3.01 < t < 3.39)  # noqa: E731
        log = recording([Thing("ego", "car", driving(0, 0, 10), there=there)], until_s=4.0)
        assert Drive(log).truth.driving_s == pytest.approx(3.2)


@dataclass(frozen=True)
class Entry:
    """An entry of a list, and what it is about; `object_ix` −1: a ghost."""

    box: Box
    existence: float = 0.9
    object_ix: int = -1
    role: int = GHOST
    captured_s: float = 0.0
    track_id: int = -1


NOTHING = AccuracySettings(cutoff_m=3.0, gate_m=3.0, existence_thresholds=(0.0, 0.3, 0.5, 0.85, 0.9, 1.0))
Lists = Sequence[Sequence[Sequence[Entry]]]
"""By run, by list."""


def detect(
    drive: Drive, issue_s: np.ndarray, lists: Lists, rules: Rules = ONE_OF_ONE, *, cuts: Sequence[int] = (),
    settings: AccuracySettings = NOTHING, tells_of: Any = "now",
) -> NeedlessBraking:  # fmt: skip
    """What the package says of these lists, added in pieces that are cut before the lists `cuts`."""
    course = drive.braking.path.course(issue_s)
    x_m, y_m = drive.braking.path.locate(course.bound_m)
    reference = Reference(x_m, y_m, x_m, x_m, x_m, ~np.isnan(course.along_m))
    detector = NeedlessDetector(
        drive.truth, issue_s, reference, settings, confirm=Confirm(hits=rules.hits, of=rules.of),
        max_age_s=rules.max_age_s, runs=len(lists),
    )  # fmt: skip
    for begin, end in pairwise([0, *cuts, len(issue_s)]):
        piece = [entry for run in lists for one in run[begin:end] for entry in one]
        counts = [[len(one) for one in run[begin:end]] for run in lists]
        ends = np.cumsum(np.concatenate([[0], np.concatenate(counts)])).astype(np.int64)
        count = end - begin
        start = np.stack([ends[s * count : (s + 1) * count + 1] for s in range(len(lists))])
        detector.add(ObjectLists(start, listed(piece)), matches_of(piece), tells_of)
    return detector.result()


def listed(entries: Sequence[Entry]) -> Entries:
    made = entries_of(len(entries))
    for k, entry in enumerate(entries):
        names = ("x_m", "y_m", "z_m", "yaw_rad", "vx_mps", "vy_mps", "length_m", "width_m")
        for name, value in zip(names, numbers(entry.box), strict=True):
            made[name][k] = value
        made["existence"][k], made["captured_s"][k], made["track_id"][k] = (
            entry.existence, entry.captured_s, entry.track_id,
        )  # fmt: skip
    return join_entries([made])


def matches_of(entries: Sequence[Entry]) -> Matches:
    zeros = np.zeros(len(entries))
    objects = np.array([entry.object_ix for entry in entries], dtype=np.int64)
    roles = np.array([entry.role for entry in entries], dtype=np.int8)
    return Matches(objects, roles, zeros, zeros, zeros.astype(np.int8))


def ahead_of(drive: Drive, now_s: float, ahead_m: float = 12.0, **more: Any) -> Entry:
    """Something that stands so far ahead of the ego at an instant."""
    x, y, yaw = (float(of[0]) for of in drive.plain.poses(now_s, np.array([ahead_m])))
    return Entry(Box(x, y, yaw), **more)


class TestCounting:
    """`logs/tc016d.mcap`: a straight road at 10 m/s, lists at its 81 frames; a standing entry ahead in some of them."""

    @pytest.fixture
    def drive(self) -> Drive:
        return Drive(cr.read_recording(LOGS / "tc016d.mcap"))

    def lists(self, drive: Drive, *places: int, ahead_m: float = 12.0) -> NeedlessBraking:
        issue_s = drive.log.truth.captured_s
        run = [[ahead_of(drive, now_s, ahead_m)] if k in places else [] for k, now_s in enumerate(issue_s)]
        return detect(drive, issue_s, [run])

    def test_the_truth_gives_a_reason(self, drive: Drive) -> None:
        truth = drive.truth
        assert truth.driving_s == pytest.approx(8.0)
        assert truth.time_s[truth.must][[0, -1]] == pytest.approx([3.8, 4.9])
        assert self.lists(drive).must_brake_s == pytest.approx(1.2)

    def test_five_lists_in_a_row(self, drive: Drive) -> None:
        found = self.lists(drive, 3, 4, 5, 6, 7)
        assert found.brakes.tolist() == [1]
        assert found.needless_s == pytest.approx([0.5])
        assert (found.begins_s, found.lasts_s, found.lost_mps) == (
            pytest.approx([0.3]), pytest.approx([0.5]), pytest.approx([4.16]),
        )  # fmt: skip
        assert found.speed_lost_mps == pytest.approx([4.16])
        assert found.cause.tolist() == ["ghost"]

    def test_a_pause_of_nine_tenths(self, drive: Drive) -> None:
        found = self.lists(drive, 3, 13)
        assert found.brakes.tolist() == [1]
        assert found.needless_s == pytest.approx([0.2])
        assert found.lasts_s == pytest.approx([1.1])
        assert found.lost_mps == pytest.approx([1.664])

    def test_a_pause_of_eleven_tenths(self, drive: Drive) -> None:
        found = self.lists(drive, 3, 15)
        assert found.brakes.tolist() == [2]
        assert found.needless_s == pytest.approx([0.2])
        assert found.lost_mps == pytest.approx([0.832, 0.832])
        assert found.begins_s == pytest.approx([0.3, 1.5])
        assert found.speed_lost_mps == pytest.approx([0.832])

    def test_too_far_away(self, drive: Drive) -> None:
        found = self.lists(drive, 3, 4, 5, 6, 7, ahead_m=40.0)
        assert (found.brakes.tolist(), found.needless_s.tolist(), len(found.begins_s)) == ([0], [0.0], 0)

    def test_while_the_truth_demands_it(self, drive: Drive) -> None:
        found = self.lists(drive, 40)
        assert found.brakes.tolist() == [0]
        assert self.lists(drive).missed_s == pytest.approx([1.2])
        assert found.missed_s == pytest.approx([1.1]), "for a tenth of a second he brakes, for whatever"

    def test_an_event_takes_the_speed_there_is(self, drive: Drive) -> None:
        """Longer than 10 / 8.32 s: all of it, once."""
        found = self.lists(drive, *range(3, 20))
        assert found.needless_s == pytest.approx([1.7])
        assert found.lost_mps == pytest.approx([10.0])


@st.composite
def lists_of(draw: st.DrawFn) -> tuple[Drive, np.ndarray, list[list[list[Entry]]], Rules]:
    """A drive, when lists are available, and entries in three runs: ahead of the ego, or far off."""
    gap = draw(st.sampled_from([(9.0, 9.0), (0.6, 0.9), (0.6, 1.4)]))
    ends_s, speed = draw(st.sampled_from([3.0, 4.0])), draw(st.sampled_from([0.9, 6.0, 10.0]))
    slows = draw(st.booleans())
    there = lambda t: not gap[0] < t < gap[1] and t < ends_s + 0.01  # noqa: E731
    at = lambda t: (speed * t - (speed * t * t / 8 if slows else 0.0), 0.0)  # noqa: E731
    truck = Thing("truck", "truck", standing(draw(st.sampled_from([19.0, 300.0])), draw(st.sampled_from([0.0, 40.0]))))
    log = recording([Thing("ego", "car", at, there=there), truck], until_s=4.0)
    asked = Needless(merge_s=draw(st.sampled_from([0.0, 0.3, 1.0])), around_s=draw(st.sampled_from([0.0, 0.5])))
    drive = Drive(log, draw(drivers()), asked)
    steps = draw(st.lists(st.sampled_from([0.05, 0.1, 0.1, 0.15, 0.7]), min_size=1, max_size=24))
    issue_s = 0.05 + np.concatenate([[0.0], np.cumsum(steps)])
    rules = Rules(asked.around_s, asked.merge_s, *draw(st.sampled_from([(1, 1), (2, 2), (2, 3), (1, 3), (3, 5)])),
                  draw(st.sampled_from([0.2, 0.5])))  # fmt: skip

    def entry(now_s: float) -> Entry:
        ahead_m, what = (
            draw(st.sampled_from([5.0, 7.0, 90.0])),
            draw(st.sampled_from(["ghost", "twin", "truck", "ego"])),
        )
        about: dict[str, Any] = {
            "ghost": {}, "twin": {"object_ix": 1, "role": DUPLICATE}, "truck": {"object_ix": 1, "role": MATCH},
            "ego": {"object_ix": 0, "role": MATCH},
        }[what]  # fmt: skip
        return ahead_of(drive, now_s, ahead_m, existence=draw(st.sampled_from([0.1, 0.3, 0.85, 0.9, 1.0])), **about)

    few = st.sampled_from([0, 0, 1, 1, 2])
    lists = [[[entry(float(now_s)) for _ in range(draw(few))] for now_s in issue_s] for _ in range(3)]
    return drive, issue_s, lists, rules


CAUSE = {(-1, GHOST): "ghost", (1, DUPLICATE): "duplicate", (1, MATCH): "misplaced"}


def demands_of(drive: Drive, issue_s: np.ndarray, run: Sequence[Sequence[Entry]]) -> list[list[Listed]]:
    """By list the entries that the driver must brake for, for the oracle."""
    out = []
    for now_s, entries in zip(issue_s, run, strict=True):
        asked = [entry for entry in entries if entry.object_ix != 0]
        must = drive.must_brake(float(now_s), *(of.box for of in asked)) if asked else []
        x, y, _ = (float(of[0]) for of in drive.plain.poses(float(now_s), np.zeros(1)))
        out.append([
            Listed(of.existence, math.hypot(of.box.x_m - x, of.box.y_m - y), CAUSE[of.object_ix, of.role])
            for of, yes in zip(asked, must, strict=True)
            if yes
        ])  # fmt: skip
    return out


class TestLists:
    @MANY
    @given(lists_of(), st.data())
    def test_what_is_needless_is_what_the_oracle_says(self, drawn: Any, data: st.DataObject) -> None:
        drive, issue_s, lists, rules = drawn
        cuts = sorted(data.draw(st.sets(st.integers(1, len(issue_s)), max_size=3)) - {len(issue_s)})
        found, truth, plain = detect(drive, issue_s, lists, rules, cuts=cuts), drive.truth, drive.plain
        must_s, reasons_s = truth.time_s[truth.must].tolist(), truth.time_s[truth.needed].tolist()
        for s, run in enumerate(lists):
            demands = demands_of(drive, issue_s, run)
            expected = oracle.find_needless(plain, issue_s, demands, must_s, reasons_s, rules)
            mine = found.run_ix == s
            assert found.brakes[s] == len(expected.events) == mine.sum()
            assert found.begins_s[mine] == pytest.approx([of.begins_s for of in expected.events])
            assert found.lasts_s[mine] == pytest.approx([of.lasts_s for of in expected.events])
            assert found.lost_mps[mine] == pytest.approx([of.lost_mps for of in expected.events], abs=0.02)
            assert found.cause[mine].tolist() == [of.cause for of in expected.events]
            assert found.needless_s[s] == pytest.approx(expected.needless_s)
            assert found.speed_lost_mps[s] == pytest.approx(expected.speed_lost_mps, abs=0.02)
            assert found.missed_s[s] == pytest.approx(expected.missed_s)
            assert found.driving_s == pytest.approx(plain.driving_s())
            assert found.needless_s[s] <= found.driving_s + 1e-9
            for t, existence in enumerate(NOTHING.existence_thresholds):
                above = oracle.find_needless(plain, issue_s, demands, must_s, reasons_s, rules, existence)
                assert found.needless_s_at[s, t] == pytest.approx(above.needless_s)

    @settings(MANY, max_examples=15)
    @given(lists_of(), st.data())
    def test_runs_and_pieces_do_not_disturb_one_another(self, drawn: Any, data: st.DataObject) -> None:
        drive, issue_s, lists, rules = drawn
        whole = detect(drive, issue_s, lists, rules)
        cuts = sorted(data.draw(st.sets(st.integers(1, len(issue_s)), max_size=6)) - {len(issue_s)})
        assert_equal(detect(drive, issue_s, lists, rules, cuts=cuts), whole)
        for s, run in enumerate(lists):
            alone = detect(drive, issue_s, [run], rules)
            for name in ("brakes", "needless_s", "speed_lost_mps", "missed_s", "needless_s_at"):
                assert (getattr(alone, name)[0] == getattr(whole, name)[s]).all()
            assert alone.lost_mps.tolist() == whole.lost_mps[whole.run_ix == s].tolist()


def assert_equal(found: NeedlessBraking, expected: NeedlessBraking) -> None:
    for name, value in vars(expected).items():
        assert np.array_equal(getattr(found, name), value), name


class TestEvents:
    """The ego drives at 10 m/s for 3 s, with lists ten times a second; a pedestrian is far off, or was in its way."""

    ISSUE_S = np.arange(31) / 10

    def drive(self, *others: Thing, **asked: Any) -> Drive:
        return Drive(straight(10.0, *others), asked=Needless(**asked))

    def found(self, drive: Drive, entries: dict[int, list[Entry]], **more: Any) -> NeedlessBraking:
        return detect(drive, self.ISSUE_S, [[entries.get(k, []) for k in range(31)]], **more)

    def test_whose_entry_it_is(self) -> None:
        """He stands 30 m ahead until .9 s, then 60 m to the left: captured at .9 s he is in the way, at 1.5 s not."""
        walker = Thing("walker", "pedestrian", lambda t: (30.0, 0.0 if t < 0.95 else 60.0))
        drive = self.drive(walker, around_s=0.0)
        assert np.flatnonzero(drive.truth.needed).tolist() == list(range(5, 10))
        box = Box(30.0, 0.0)
        about = {
            "ghost": Entry(box), "duplicate": Entry(box, 0.9, 1, DUPLICATE, 0.9),
            "late": Entry(box, 0.9, 1, MATCH, 0.9), "misplaced": Entry(box, 0.9, 1, MATCH, 1.5),
        }  # fmt: skip
        for cause, entry in about.items():
            found = self.found(drive, {20: [entry]}, tells_of="capture")
            assert found.cause.tolist() == [cause]
            assert found.object_id.tolist() == [None if cause == "ghost" else "walker"]
        now = self.found(drive, {20: [about["late"]]}, tells_of="now")
        assert now.cause.tolist() == ["misplaced"], "an entry that tells of now is not late"

    def test_it_is_the_surest_that_begins_it(self) -> None:
        drive = self.drive()
        first = [
            ahead_of(drive, 0.5, ahead_m, existence=existence, track_id=k)
            for k, (ahead_m, existence) in enumerate([(12.0, 0.5), (7.0, 0.5), (9.0, 0.8), (8.0, 0.8), (50.0, 1.0)])
        ]
        found = self.found(drive, {5: first, 6: [ahead_of(drive, 0.6, existence=1.0, track_id=4)]})
        assert found.entries["track_id"].tolist() == [3]
        assert found.entries["x_m"] == pytest.approx([13.0])
        assert found.class_ix.tolist() == [0]

    @pytest.mark.parametrize(
        ("hits", "of", "begins_s", "needless_s"),
        [(1, 1, [0.5], 0.4), (2, 2, [0.6], 0.2), (2, 3, [0.6], 0.5), (3, 3, [], 0.0), (1, 2, [0.5], 0.6)],
    )
    def test_hits_of_the_last_lists(self, hits: int, of: int, begins_s: list[float], needless_s: float) -> None:
        """Lists 5, 6, 8, 9 have an entry ahead, each another."""
        drive = self.drive()
        entries = {k: [ahead_of(drive, k / 10)] for k in (5, 6, 8, 9)}
        found = self.found(drive, entries, rules=Rules(hits=hits, of=of))
        assert found.begins_s == pytest.approx(begins_s)
        assert found.needless_s == pytest.approx([needless_s])

    @pytest.mark.parametrize(("merge_s", "brakes"), [(0.0, 3), (0.19, 3), (0.2, 2), (0.5, 1)])
    def test_pauses(self, merge_s: float, brakes: int) -> None:
        """Lists 5, 6, then 9, then 15: pauses of .2 and .5 s."""
        drive = self.drive(merge_s=merge_s)
        found = self.found(drive, {k: [ahead_of(drive, k / 10)] for k in (5, 6, 9, 15)})
        assert found.brakes.tolist() == [brakes]
        assert found.needless_s == pytest.approx([0.4])

    @pytest.mark.parametrize(("ahead_m", "brakes"), [(12.0, 0), (10.0, 1), (8.0, 1)])
    def test_the_annotated_area(self, ahead_m: float, brakes: int) -> None:
        drive = self.drive()
        near = replace(NOTHING, annotated_range_m=10.0)
        assert self.found(drive, {5: [ahead_of(drive, 0.5, ahead_m)]}, settings=near).brakes.tolist() == [brakes]
        there = replace(NOTHING, annotated_m=((0.0, -5.0), (15.5, -5.0), (15.5, 5.0), (0.0, 5.0)))
        found = self.found(drive, {5: [ahead_of(drive, 0.5, ahead_m)]}, settings=there)
        assert found.brakes.tolist() == [brakes]

    def test_the_ego_itself_is_not_asked(self) -> None:
        drive = self.drive()
        entry = ahead_of(drive, 0.5, 4.0, object_ix=0, role=MATCH)
        assert self.found(drive, {5: [entry]}).brakes.tolist() == [0]

    def test_an_old_list_is_none(self) -> None:
        """One list at .5 s, and no other: for .5 s; at 2.8 s: to the ego's last frame."""
        drive = self.drive()
        for at_s, needless_s in ((0.5, 0.5), (2.8, 0.2)):
            found = detect(drive, np.array([at_s]), [[[ahead_of(drive, at_s)]]])
            assert found.needless_s == pytest.approx([needless_s])
            assert found.lasts_s == pytest.approx([needless_s])

    def test_who_stands_does_not_brake(self) -> None:
        """The ego drives for .3 s, then stands, and the one list is in use for .5 s; at its last frame for no time."""
        log = recording([Thing("ego", "car", lambda t: (10.0 * min(t, 0.25), 0.0))], until_s=3.0)
        drive = Drive(log)
        assert drive.truth.driving_s == pytest.approx(0.3)
        found = detect(drive, np.array([0.1]), [[[ahead_of(drive, 0.1)]]])
        assert found.needless_s == pytest.approx([0.2])
        assert found.lost_mps == pytest.approx([0.2 * 8.32])
        drive = self.drive()
        assert detect(drive, np.array([3.0]), [[[ahead_of(drive, 3.0)]]]).brakes.tolist() == [0]

    def test_for_every_run_as_for_the_one_that_stands_for_all(self) -> None:
        drive = self.drive()
        found = self.found(drive, {k: [ahead_of(drive, k / 10)] for k in (5, 20)}).repeated(3)
        assert found.run_ix.tolist() == [0, 0, 1, 1, 2, 2]
        assert found.begins_s == pytest.approx([0.5, 2.0] * 3)
        assert found.brakes.tolist() == [2, 2, 2]
        assert found.needless_s_at.shape == (3, len(NOTHING.existence_thresholds))


# Whole studies.


NOISE = {"kind": "gaussian", "covariance_m2": [[0.1, 0.0], [0.0, 0.1]]}
SEES = {"detection": {"kind": "visible_share"}, "error": NOISE}
NEAR = {"kind": "field", "range_m": [4, 15], "azimuth_deg": [-3, 3]}
LASTING = {"in_list": 3, "lasts_s": 20, "where": NEAR, "classes": {"pedestrian": 1}}
BLINKING = {"in_list": 0.2, "lasts_s": 0.1, "where": NEAR, "classes": {"pedestrian": 1}}


def study(pems: dict[str, Any], *, runs: int = 4, **changes: Any) -> Experiment:
    """An experiment on `tc016d.mcap` with a unit on the ego for each PEM, and its lists tracked (gnn)."""
    on_ego = {"on": "ego", "height_m": 1.8}
    data: dict[str, Any] = {
        "version": 1, "logs": ["tc016d.mcap"], "runs": runs, "pems": pems,
        "units": {f"u_{name}": on_ego | {"pem": name} for name in pems},
        "configurations": {name: {"units": [f"u_{name}"], "fusion": {"kind": "gnn"}} for name in pems},
        "measure": {
            "objects": {"classes": ["pedestrian"]}, "conflict": {"horizon_s": 3, "margin_m": 0.5},
            "onset": {"kind": "starts_moving", "speed_mps": 0.3, "within_m": 20, "from": "front"},
        },
        "braking": BRAKING_8, "show": {"run": None},
    }  # fmt: skip
    return Experiment.model_validate(data | changes)


SAMPLE = cr.read_recording(LOGS / "tc016d.mcap")
GHOSTS = {"clean": [SEES], "ghosts": {"couples": [SEES], "ghosts": [LASTING]},
          "blinking": {"couples": [SEES], "ghosts": [BLINKING]}}  # fmt: skip


class TestStudies:
    @pytest.mark.parametrize("name", ["tc016d", "crossing"])
    def test_the_truth_and_exact_lists_are_never_needless(self, name: str) -> None:
        """Nor those that arrive .3 s late, tracked or not."""
        exact = {"sees": [{"detection": {"kind": "constant", "probability": 1.0}}]}
        plan = study(
            exact, runs=1, logs=[f"{name}.mcap"],
            configurations={
                "GT": {"units": "truth"}, "exact": {"units": ["u_sees"]},
                "late": {"units": ["u_sees"], "latency_s": 0.3},
                "tracked": {"units": ["u_sees"], "fusion": {"kind": "gnn"}},
                "tracked late": {"units": ["u_sees"], "fusion": {"kind": "gnn"}, "latency_s": 0.3},
            },
            measure={"onset": {"kind": "in_range", "range_m": 80}},
        )  # fmt: skip
        found = run_experiment(plan, [cr.read_recording(LOGS / f"{name}.mcap")])
        lists = study_accuracy(found)["lists.parquet"].to_pandas()
        assert len(lists) == 5
        assert (lists["driving_s"] > 5).all()
        assert (lists["needless_brakes"] == 0).all()
        assert (lists["needless_s"] == 0).all()
        assert study_accuracy(found)["needless.parquet"].num_rows == 0
        missed = lists.set_index("configuration")["must_brake_missed_s"]
        assert missed["GT"] <= missed["exact"] <= missed["late"]

    def test_false_alarms(self) -> None:
        """Three ghosts that last, always some metres ahead: for most of the time; blinking ones more often."""
        found = run_experiment(study(GHOSTS, runs=12), [SAMPLE])
        summary = found.summary.set_index("configuration")
        share, rate = summary["needless_brake_share"], summary["needless_brakes_per_h"]
        assert share["clean"] == rate["clean"] == 0.0
        assert 0.5 < share["ghosts"] < 0.75
        assert 0 < share["blinking"] < share["ghosts"] / 4
        assert rate["blinking"] > 0
        assert 700 < rate["ghosts"] < 1050, "852 by the page, [703, 1023]"
        assert summary["needless_speed_lost_max_mps"]["ghosts"] == pytest.approx(10.0)
        assert (summary["driving_h"] * 3600).tolist() == pytest.approx([8.0] * 3)
        assert (summary["needless_interval_over"] == "runs").all()
        assert summary["needless_brakes_per_h_high"]["clean"] == pytest.approx(3.689 / (12 * 8 / 3600), rel=1e-3)
        events = study_accuracy(found)["needless.parquet"].to_pandas()
        assert set(events.loc[events["configuration"] == "ghosts", "cause"]) == {"ghost"}
        assert events.loc[events["cause"] == "ghost", "object_id"].isna().all()
        lists = study_accuracy(found)["lists.parquet"].to_pandas().set_index(["configuration", "run"])
        counted = events.groupby(["configuration", "run"]).size().reindex(lists.index, fill_value=0)
        assert (counted == lists["needless_brakes"]).all()
        most = events.groupby(["configuration", "run"])["speed_lost_mps"].max().reindex(lists.index, fill_value=0.0)
        assert (most == lists["speed_lost_mps"]).all()

    def test_thresholds_of_existence(self) -> None:
        """What is needless from an existence on falls as it is raised, beginning with all."""
        found = run_experiment(study(GHOSTS, runs=3), [SAMPLE])
        for row in study_accuracy(found)["lists.parquet"].to_pylist():
            by = np.array(row["needless_s_at"])
            assert len(by) == len(row["existence"])
            assert by[0] == pytest.approx(row["needless_s"])
            assert (by <= row["driving_s"] + 1e-9).all()

    def test_an_ego_that_stands(self) -> None:
        """Null, not 0; so are files."""
        log = recording([Thing("ego", "car", standing(0, 0)), Thing("car", "car", driving(60, 0, -10))], until_s=3.0)
        plan = study({"clean": [SEES]}, logs=["scene.mcap"], measure={"onset": {"kind": "in_range", "range_m": 80}})
        summary = run_experiment(plan, [log]).summary.iloc[0]
        assert summary["driving_h"] == 0
        for name in ("brakes_per_h", "brakes_per_h_low", "brakes_per_h_high", "brake_share", "speed_lost_max_mps"):
            assert pd.isna(summary[f"needless_{name}"]), name
        assert pd.isna(summary["must_brake_missed_s"])

    def test_who_never_has_a_list_misses_all(self) -> None:
        late = {"units": ["u_clean"], "latency_s": 100.0}
        plan = study(
            {"clean": [SEES]}, runs=1, configurations={"late": late, "gnn": late | {"fusion": {"kind": "gnn"}}}
        )
        for row in study_accuracy(run_experiment(plan, [SAMPLE]))["lists.parquet"].to_pylist():
            assert (row["lists"], row["needless_brakes"], row["needless_s"], row["driving_s"]) == (0, 0, 0, 8)
            assert row["must_brake_missed_s"] == row["must_brake_s"] == pytest.approx(1.2)

    @pytest.mark.parametrize("changes", [{"braking": None}, {"braking": BRAKING_8 | {"needless": None}}])
    def test_not_asked_for(self, changes: dict[str, Any]) -> None:
        found = run_experiment(study({"clean": [SEES]}, runs=1, **changes), [SAMPLE])
        assert "needless.parquet" not in study_accuracy(found)
        assert not {"driving_s", "needless_s"} & set(study_accuracy(found)["lists.parquet"].column_names)
        assert not [name for name in found.summary if "needless" in name or name == "driving_h"]

    def test_nor_without_accuracy(self) -> None:
        plan = study({"clean": [SEES]}, runs=1)
        plan = plan.model_copy(update={"measure": plan.measure.model_copy(update={"accuracy": False})})
        assert plan.needless is None
        assert not [name for name in run_experiment(plan, [SAMPLE]).summary if "needless" in name]


def drive_of(log: str, speed_mps: float, *, car: bool = True) -> Recording:
    """The ego drives for 4 s; a car comes by in the next lane but one."""
    things = [Thing("ego", "car", driving(0, 0, speed_mps))]
    things += [Thing("car", "car", driving(60, 8, -10), yaw_rad=math.pi)] * car
    return recording(things, until_s=4.0, log=log)


class TestDecisions:
    """Ghosts ahead of the ego, held against none, over several drives."""

    MEASURE: ClassVar = {"onset": {"kind": "in_range", "range_m": 80}, "began": ["log_start", "crossed", "appeared"]}
    CRITERIA: ClassVar = {
        "rate": {"metric": "needless_brakes_per_h", "at_most": 1},
        "share": {"metric": "needless_brake_share", "at_most": 0.5},
        "of these": {"metric": "needless_brake_share", "at_most": 0.5, "population": "these_logs"},
        "against": {"metric": "needless_brake_share", "against": "clean", "at_most": 0.1},
    }

    def made(self, *logs: Recording) -> Any:
        pems = {name: GHOSTS[name] for name in ("clean", "ghosts")}
        plan = study(pems, runs=6, logs=[f"{log.scene.log}.mcap" for log in logs], measure=self.MEASURE)
        return cr.run(plan, list(logs))

    def compared(self, made: Any) -> tuple[pd.Series, pd.Series]:
        """Of ghosts: the row of the summary, and that of the comparison."""
        overall = cr.compare(made, baseline="clean").overall.set_index("metric")
        assert "needless_brakes_per_h" not in overall.index, "the share decides"
        return made.study.summary.set_index("configuration").loc["ghosts"], overall.loc["needless_brake_share"]

    def test_over_drives(self) -> None:
        """One has no measured object, and is a drive all the same; one stands, and is none."""
        made = self.made(drive_of("a", 10), drive_of("b", 8), drive_of("c", 6, car=False), drive_of("d", 0))
        summary, share = self.compared(made)
        assert summary["driving_h"] == pytest.approx(12 / 3600)
        assert share["value"] == pytest.approx(summary["needless_brake_share"])
        assert share["baseline_value"] == 0
        assert (share["interval_over"], share["clusters"]) == ("logs", 3)
        found = {(of.criterion, of.configuration): of for of in cr.judge(made, self.CRITERIA).all}
        rate_of = found["rate", "ghosts"]
        assert (rate_of.verdict, rate_of.over, rate_of.clusters) == ("not met", "logs", 3)
        assert (rate_of.low, rate_of.high) == pytest.approx(
            (summary["needless_brakes_per_h_low"], summary["needless_brakes_per_h_high"])
        )
        assert found["share", "ghosts"].estimate == pytest.approx(summary["needless_brake_share"])
        assert found["rate", "clean"].verdict == "undecided", "none in 12 s tells little"
        assert (found["of these", "clean"].verdict, found["of these", "clean"].over) == ("met", "runs")
        assert found["of these", "ghosts"].estimate == pytest.approx(summary["needless_brake_share"])
        against = found["against", "ghosts"]
        assert (against.estimate, against.over) == (pytest.approx(share["difference"]), "logs")

    @pytest.mark.parametrize(("logs", "over"), [((10, 8, 0), None), ((10, 0), "runs"), ((10,), "runs")])
    def test_of_two_drives_there_is_no_interval(self, logs: Sequence[float], over: str | None) -> None:
        """Over two drives none; of one over its runs."""
        made = self.made(*(drive_of("abc"[k], speed) for k, speed in enumerate(logs)))
        summary, share = self.compared(made)
        assert (summary["needless_interval_over"] or None) == over
        assert share["value"] == pytest.approx(summary["needless_brake_share"])
        assert pd.isna(share["low"]) == (over is None)
        assert share["interval_over"] == over or over is None
        for of in cr.judge(made, {"rate": self.CRITERIA["rate"]}).all:
            assert of.verdict == "not measured"
            assert of.why is not None
            assert f"{len([speed for speed in logs if speed])}" in of.why or "one drive" in of.why

    @pytest.mark.parametrize(
        ("changes", "said"),
        [({"braking": None}, "braking: {driver: …"), ({"braking": BRAKING_8 | {"needless": None}}, "needless: {}")],
    )
    def test_what_is_not_measured_is_no_criterion(self, changes: dict[str, Any], said: str) -> None:
        made = cr.run(study({"clean": [SEES]}, runs=1, **changes), [SAMPLE])
        with pytest.raises(ExperimentError, match="expected a metric that the experiment measures") as raised:
            cr.judge(made, {"rate": self.CRITERIA["rate"]})
        assert said in str(raised.value)


class TestSame:
    PLAN = study(
        GHOSTS, runs=6,
        measure={"onset": {"kind": "in_range", "range_m": 60}, "confirm": {"hits": 2, "of": 3},
                 "annotated": {"range_m": 40}},
    )  # fmt: skip

    def tables(self, **more: Any) -> dict[str, pa.Table]:
        found = run_experiment(self.PLAN, [SAMPLE], **more)
        return {name: study_accuracy(found)[name] for name in ("lists.parquet", "needless.parquet")}

    def test_whatever_the_jobs_and_time_chunks(self, monkeypatch: pytest.MonkeyPatch) -> None:
        whole = self.tables()
        assert whole["needless.parquet"].num_rows > 10
        assert_same_tables(whole, self.tables(jobs=2))
        monkeypatch.setattr(chunking, "ROWS_AT_ONCE", 1)
        for rows_a_chunk in (300, 1000):
            monkeypatch.setattr(chunking, "ROWS_A_CHUNK", rows_a_chunk)
            assert len(prepare_log(SAMPLE, self.PLAN).chunks) > 2
            assert_same_tables(whole, self.tables())

    def test_whatever_the_blocks_of_runs(self) -> None:
        log = prepare_log(SAMPLE, self.PLAN)
        for blocks in ([[0, 1, 2, 3, 4, 5]], [[0], [1, 2], [3, 4, 5]], [[k] for k in range(6)]):
            outcomes = [one for runs in blocks for one in replay_outcomes(log, self.PLAN, np.array(runs))]
            parts = build_parts("tc016d", outcomes, self.PLAN)
            names = [part.configuration for part in parts]
            tables = [table for part in parts for table in (part.runs, part.needless)]
            if len(blocks) == 1:
                expected = names, tables
            assert names == expected[0]
            for found, of in zip(tables, expected[1], strict=True):
                assert found.equals(of)

    def test_runs_that_differ_in_their_units(self) -> None:
        """Their lists come at other instants. Fewer runs are the first of many."""
        on_cars = {"on": {"classes": ["car"], "penetration_rate": 0.4}, "pem": "clean"}
        units = {"u_ghosts": {"on": "ego", "height_m": 1.8, "pem": "ghosts"}, "others": on_cars}
        log, tables = cr.read_recording(LOGS / "crossing.mcap"), []
        for runs, jobs in ((3, 1), (2, 2)):
            plan = study(
                {name: GHOSTS[name] for name in ("clean", "ghosts")}, runs=runs, logs=["crossing.mcap"], units=units,
                configurations={"all": {"units": ["u_ghosts", "others"], "fusion": {"kind": "gnn"}}},
                measure={"onset": {"kind": "in_range", "range_m": 60}},
            )  # fmt: skip
            found = study_accuracy(run_experiment(plan, [log], jobs=jobs))
            tables.append([found[name].to_pandas() for name in ("lists.parquet", "needless.parquet")])
        for many, few in zip(*tables, strict=True):
            pd.testing.assert_frame_equal(many[many["run"] < 2].reset_index(drop=True), few, check_exact=True)
        assert (tables[0][0]["needless_brakes"] > 0).all()

    def test_kept_parts(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.chdir(tmp_path)
        for runs in (4, 6, 6):
            results = cr.run(self.PLAN.model_copy(update={"runs": runs}), [SAMPLE], pieces="kept")
            found = study_accuracy(results.study)
        for name, table in self.tables().items():
            assert found[name].equals(table), name


class TestWords:
    """The ego (1) drives at 10 m/s; a pedestrian (2) stands aside."""

    BRAKES = "driver: {kind: constant_deceleration, a_max_mps2: 8}"

    def refused(
        self, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *changes: str,
        command: str = "check", option: Sequence[str] = (), **ego: Any,
    ) -> str:  # fmt: skip
        """The one line that is said, with exit code 2, and no results."""
        frames = [
            (0.1 * k, [Obj(id=1, x=float(k), vx=10.0, **ego), pedestrian(2, 45.0, -6.0, vx=0.0)]) for k in range(31)
        ]
        write_recording(folder / "drive.mcap", frames, host=1)
        monkeypatch.chdir(folder)
        (folder / "e.yaml").write_text(changed(*changes), encoding="utf-8")
        out = ["--out", "out"] if command == "run" else []
        monkeypatch.setattr(sys, "argv", ["copem-replay", command, "e.yaml", *option, *out])
        assert cli._run_to_exit_code() == 2
        assert not (folder / "out").exists()
        (said,) = capsys.readouterr().err.splitlines()
        return said

    @pytest.mark.parametrize("command", ["check", "run"])
    @pytest.mark.parametrize(
        ("needless", "key", "expected"),
        [
            ("{needed_at: 0.7}", "", "expected needed_at ≤ brakes_at, found 0.7 and 0.6"),
            ("{brakes_at: 0.2}", "", "expected needed_at ≤ brakes_at, found 0.3 and 0.2"),
            ("{margin_m: 0.6}", "", "expected wider_m ≥ margin_m, found 0.5 and 0.6"),
            ("{margin_m: 0.3, wider_m: 0.2}", "", "expected wider_m ≥ margin_m, found 0.2 and 0.3"),
            ("{needed_at: 0.0}", ".needed_at", "0"),
            ("{brakes_at: 1.1}", ".brakes_at", "1"),
            ("{around_s: -0.1}", ".around_s", "0"),
            ("{slower_mps: 0.0}", ".slower_mps", "0"),
            ("{merge: 1}", ".merge", "merge_s"),
        ],
    )
    def test_what_is_wrong_is_one_line(
        self, command: str, needless: str, key: str, expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
    ) -> None:  # fmt: skip
        braking = f"braking: {{{self.BRAKES}, needless: {needless}}}"
        said = self.refused(tmp_path, monkeypatch, capsys, braking, command=command)
        assert said.startswith(f"e.yaml:19: braking.needless{key}: ")
        assert expected in said

    def test_without_ego(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        changes = ["  ego: {on: ego, height_m: 1.8, pem: onboard}", "  PEM: {units: [mast]}",
                   "measure: {onset: {kind: appears}, distance_to: mast}", f"braking: {{{self.BRAKES}}}"]  # fmt: skip
        text = changed(*changes).replace(changes[0] + "\n", "")
        monkeypatch.setattr("tests.metrics.test_needless.changed", lambda *_: text)
        said = self.refused(tmp_path, monkeypatch, capsys, command="run", option=["--ego", "none"])
        assert said.startswith("e.yaml:18: braking: there is no ego in this study")

    def test_an_ego_of_unknown_size(self, tmp_path: Path) -> None:
        """It is as large as others of its class, which reading says."""
        frames = [(0.1 * k, [Obj(id=1, x=float(k), vx=10.0, length=0.0, width=0.0)]) for k in range(31)]
        log = cr.read_recording(write_recording(tmp_path / "drive.mcap", frames, host=1))
        assert any("without a size" in note and "that of its class taken" in note for note in log.notes)
        assert (Drive(log).braking.path.size_m > 1).all()

    def test_the_defaults(self) -> None:
        assert study({"clean": [SEES]}).needless == NEEDLESS
        assert NEEDLESS.model_dump() == {
            "brakes_at": 0.6, "needed_at": 0.3, "margin_m": 0.0, "wider_m": 0.5, "around_s": 0.5, "slower_mps": 1.0,
            "merge_s": 1.0,
        }  # fmt: skip
