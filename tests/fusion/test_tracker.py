"""The tracker against one written out plainly, numbers worked out by hand, and what no order of things may change."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from pydantic import ValidationError
from scipy.optimize import linear_sum_assignment

from copem_replay.core.object_list import (
    Entries,
    Inputs,
    ObjectLists,
    entries_of,
    most_probable_class,
    most_probable_classes,
)
from copem_replay.core.tracks import AGREE, CLASSES
from copem_replay.fusion.interface import ask_fusion
from copem_replay.fusion.tracker import Tracker
from copem_replay.fusion.tracker_kernel import track_run
from tests.helpers.reports import entry, inputs_of, joined, lists_of
from tests.oracles.gnn import largest_around

Array = npt.NDArray[Any]
LATE = ("stale", "predict", "replay")
AT_ONCE: dict[str, Any] = {"confirm_s": 0.0}


def fuse(inputs: Inputs, **settings: Any) -> list[list[Entries]]:
    """Fused lists [run][instant]; all that is asked of any fusion is checked."""
    lists = ask_fusion(Tracker(**settings), inputs, "fusion")
    return [[lists.of(s, k) for k in range(lists.start.shape[1] - 1)] for s in range(len(lists.start))]


def fuse_one(inputs: Inputs, **settings: Any) -> list[Entries]:
    return fuse(inputs, **settings)[0]


# ------------------------------------------------------------------------------------------- written out plainly


@dataclass
class Track:
    x: Array
    P: Array
    R: Array
    at_s: float
    first_s: float
    last_s: float
    ident: tuple[int, int]
    unit: int
    entries: list[Any] = field(default_factory=list)
    newest: Any = None
    claims: dict[int, tuple[float, float]] = field(default_factory=dict)  # by unit: existence, and when it said so
    lists: dict[int, float] = field(default_factory=dict)  # that held it, and when they were heard

    @property
    def kind(self) -> int:
        return int(np.argmax(np.sum([e["class_probability"] for e in self.entries], axis=0)))

    def existence(self, now_s: float, forget_s: float) -> float:
        return 1 - math.prod(1 - c * math.exp(-(now_s - t) / forget_s) for c, t in self.claims.values())


def in_order(entries: Entries) -> list[Any]:
    return sorted(entries, key=lambda e: (e["x_m"], e["y_m"]))


class Plain:
    """The tracker's rules, one after the other, with dictionaries and NumPy."""

    def __init__(self, inputs: Inputs, run: int, settings: Tracker) -> None:
        self.inputs, self.run, self.of = inputs, run, settings
        self.gate = -2 * math.log(1 - settings.gate)
        self.tracks: list[Track] = []

    def order(self, f: int) -> Any:
        entries = in_order(self.inputs.lists.of(self.run, f))
        places = [(float(e["x_m"]), float(e["y_m"])) for e in entries]
        return self.inputs.captured_s[f], -len(entries), places

    def outruns(self, g: int, f: int) -> bool:
        same_unit = self.inputs.unit_ix[g] == self.inputs.unit_ix[f]
        return bool(same_unit and self.inputs.captured_s[g] > self.inputs.captured_s[f])

    def hear(self, f: int, now_s: float) -> None:
        captured_s, unit = float(self.inputs.captured_s[f]), int(self.inputs.unit_ix[f])
        q = self.of.acceleration_psd_m2ps3
        for track in self.tracks:
            dt = now_s - track.at_s
            F = np.eye(4) + dt * np.eye(4, k=2)
            Q = q * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2))
            track.x, track.P, track.at_s = F @ track.x, F @ track.P @ F.T + Q, now_s
        age = now_s - captured_s if self.of.late == "predict" else 0.0
        entries = in_order(self.inputs.lists.of(self.run, f))
        z = [np.array([e["x_m"] + age * e["vx_mps"], e["y_m"] + age * e["vy_mps"]]) for e in entries]
        R = [
            np.array([[e["cov_ee_m2"], e["cov_en_m2"]], [e["cov_en_m2"], e["cov_nn_m2"]]]) + q * age**3 / 3 * np.eye(2)
            for e in entries
        ]
        pairs: dict[tuple[int, int], tuple[float, float]] = {}
        for i, e in enumerate(entries):
            for j, track in enumerate(self.tracks):
                S, difference = track.P[:2, :2] + R[i], z[i] - track.x[:2]
                d2 = float(difference @ np.linalg.inv(S) @ difference)
                if d2 <= self.gate and AGREE[np.argmax(e["class_probability"]), track.kind]:
                    pairs[i, j] = (d2, math.log(np.linalg.det(S)))
        allowed = np.zeros((len(entries), len(self.tracks)), dtype=bool)
        for pair in pairs:
            allowed[pair] = True
        around = largest_around(allowed, np.array([volume for _, volume in pairs.values()]))
        # Columns: the tracks, and for each entry a place of its own where it is alone.
        cost = np.full((len(entries), len(self.tracks) + len(entries)), 1e9)
        np.fill_diagonal(cost[:, len(self.tracks) :], 0.0)
        for ((i, j), (d2, volume)), most in zip(pairs.items(), around, strict=True):
            cost[i, j] = d2 + volume
            cost[i, len(self.tracks) + i] = self.gate + most + 1e-6
        partner = dict(zip(*(side.tolist() for side in linear_sum_assignment(cost)), strict=True))
        known = len(self.tracks)
        for i, e in enumerate(entries):
            if partner[i] < known:
                track = self.tracks[partner[i]]
                S = track.P[:2, :2] + R[i]
                K = track.P[:, :2] @ np.linalg.inv(S)
                track.x, track.P = track.x + K @ (z[i] - track.x[:2]), track.P - K @ S @ K.T
            else:
                P = np.zeros((4, 4))
                P[:2, :2], P[2, 2], P[3, 3] = R[i], self.of.speed_sigma_mps**2, self.of.speed_sigma_mps**2
                x = np.array([*z[i], e["vx_mps"], e["vy_mps"]])
                track = Track(x, P, R[i], now_s, captured_s, captured_s, (f, i), unit)
                self.tracks.append(track)
            track.R = R[i]
            track.entries.append(e)
            if captured_s >= track.last_s:
                track.newest = e
            track.first_s, track.last_s = min(track.first_s, captured_s), max(track.last_s, captured_s)
            said_s = now_s if self.of.late == "stale" else captured_s
            if unit not in track.claims or said_s >= track.claims[unit][1]:
                track.claims[unit] = float(e["existence"]), said_s
            track.lists[f] = now_s

    def settle(self, now_s: float) -> None:
        forget_s = self.of.forget_s
        left: list[Track | None] = [t if t.existence(now_s, forget_s) > self.of.drop else None for t in self.tracks]
        for i in range(len(left)):
            for j in range(i + 1, len(left)):
                a, b = left[i], left[j]
                if a is None or b is None or not AGREE[a.kind, b.kind]:
                    continue
                if any(a.lists[f] >= now_s - forget_s for f in a.lists if f in b.lists):
                    continue
                S, difference = a.P[:2, :2] + a.R + b.P[:2, :2] + b.R, (a.x - b.x)[:2]
                if difference @ np.linalg.inv(S) @ difference <= 1.386:
                    older = (a.first_s, -len(a.entries)) <= (b.first_s, -len(b.entries))
                    left[j if older else i] = None
        self.tracks = [t for t in left if t is not None]

    def published(self, now_s: float) -> list[tuple[Any, ...]]:
        rows = []
        for t in self.tracks:
            existence = t.existence(now_s, self.of.forget_s)
            if existence <= self.of.publish or t.last_s - t.first_s < self.of.confirm_s - 1e-6:
                continue
            dt = now_s - t.at_s
            F = np.eye(4) + dt * np.eye(4, k=2)
            x, P = F @ t.x, F @ t.P @ F.T
            P[:2, :2] += self.of.acceleration_psd_m2ps3 * dt**3 / 3 * np.eye(2)
            kinds = np.sum([e["class_probability"] for e in t.entries], axis=0)
            sizes = [np.mean([e[name] for e in t.entries]) for name in ("length_m", "width_m", "height_m")]
            rows.append(
                (t.ident[0] * 65536 + t.ident[1], t.unit, t.last_s, existence, *x, P[0, 0], P[0, 1], P[1, 1],
                 t.newest["yaw_rad"], t.newest["z_m"], *sizes, *(kinds / kinds.sum()))
            )  # fmt: skip
        return sorted(rows)

    def follow(self) -> list[list[tuple[Any, ...]]]:
        """Published rows, instant after instant. `replay`: everything anew each time, in order of capture."""
        found = []
        for k, now_s in enumerate(self.inputs.issue_s.tolist()):
            begin, end = self.inputs.arrived_start[k : k + 2]
            if self.of.late == "replay":
                self.tracks = []
                received = sorted(self.inputs.arrived[:end].tolist(), key=self.order)
                for n, f in enumerate(received):
                    captured_s = float(self.inputs.captured_s[f])
                    self.hear(f, captured_s)
                    if n + 1 == len(received) or self.inputs.captured_s[received[n + 1]] > captured_s:
                        self.settle(captured_s)
            else:
                there = self.inputs.arrived[:end].tolist()
                for f in sorted(there[begin:], key=self.order):
                    if self.of.late == "predict" or not any(self.outruns(g, f) for g in there):
                        self.hear(f, now_s)
                self.settle(now_s)
            found.append(self.published(now_s))
        return found


def rows_of(entries: Entries) -> list[tuple[Any, ...]]:
    """The same columns as `Plain.published`."""
    names = ("track_id", "unit_ix", "captured_s", "existence", "x_m", "y_m", "vx_mps", "vy_mps", "cov_ee_m2")
    names += ("cov_en_m2", "cov_nn_m2", "yaw_rad", "z_m", "length_m", "width_m", "height_m")
    return sorted((*(e[name] for name in names), *e["class_probability"]) for e in entries)


def street(
    seed: int, *, runs: int = 1, units: int = 3, steps: int = 12, delay_s: float = 0.4, together: bool = True
) -> Inputs:
    """A small crowd of all sorts as units see it, late and with ghosts: all that can happen does, somewhere.

    Times are multiples of 1/64 s, so that sums are exact. `together`: units look at the same instants.
    """
    rng = np.random.default_rng(seed)
    kinds = ["car", "car", "vehicle", "pedestrian", "pedestrian", "other"]
    place, velocity = rng.uniform(0.0, 14.0, (6, 2)), rng.uniform(-3.0, 3.0, (6, 2))
    captured, arrives, whose = [], [], []
    for k in range(steps):
        for u in range(units):
            captured.append(k / 8 + (0.0 if together else u / 64))
            arrives.append(captured[-1] + math.floor(rng.uniform(0.0, delay_s) * 64) / 64)
            whose.append(f"unit {u}")
    by_run = []
    for _ in range(runs):
        lists = []
        for f, at_s in enumerate(captured):
            sigma = 0.3 + 0.5 * (f % units)
            said = []
            for o, kind in enumerate(kinds):
                if rng.random() < 0.7:
                    x, y = place[o] + velocity[o] * at_s + rng.normal(0.0, sigma, 2)
                    vx, vy = velocity[o] + rng.normal(0.0, 0.5, 2)
                    more = {name: rng.uniform(1.0, 5.0) for name in ("length_m", "width_m", "height_m", "z_m")}
                    more |= {"existence": rng.uniform(0.4, 1.0), "yaw_rad": rng.uniform(-3.0, 3.0)}
                    cov = (sigma**2, 0.3 * sigma**2, sigma**2)
                    said.append(entry(x, y, of=kind, vx_mps=vx, vy_mps=vy, cov=cov, **more))
            if rng.random() < 0.2:
                said.append(entry(*rng.uniform(-5.0, 20.0, 2), of="pedestrian", existence=0.6))
            lists.append(joined(*(said[i] for i in rng.permutation(len(said)))))
        by_run.append(lists)
    return inputs_of(by_run, whose, captured, arrives)


@pytest.mark.parametrize("late", LATE)
@pytest.mark.parametrize("together", [True, False])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_it_is_the_one_written_out_plainly(late: str, together: bool, seed: int):
    inputs = street(seed, runs=2, together=together)
    settings = Tracker(late=late, forget_s=0.5, gate=0.99, drop=0.3, buffer_s=10.0)
    for run, lists in enumerate(fuse(inputs, **settings.model_dump())):
        expected = Plain(inputs, run, settings).follow()
        assert sum(map(len, expected)) > 20
        for found, rows in zip(lists, expected, strict=True):
            assert [row[:3] for row in rows_of(found)] == [row[:3] for row in rows]
            for one, other in zip(rows_of(found), rows, strict=True):
                assert one[3:] == pytest.approx(other[3:], rel=1e-8, abs=1e-9)


# --------------------------------------------------------------------------------- a list that comes out of sequence


def late_measurement(apart_s: float = 2e-6) -> Inputs:
    """What was measured at 0.1 s arrives just after what was measured at 0.2 s."""
    lists = [entry(0.0, vx_mps=10.0), entry(1.2, vx_mps=10.0, cov=(0.25, 0, 0.25)), entry(2.1, cov=(0.25, 0, 0.25))]
    return inputs_of([lists], ["a", "b", "a"], [0.0, 0.1, 0.2], [0.0, 0.2 + apart_s, 0.2])


PRIOR: dict[str, Any] = {"speed_sigma_mps": 2.0, "acceleration_psd_m2ps3": 1.0, "confirm_s": 0.0}


@pytest.mark.parametrize(
    ("settings", "x_m", "vx_mps"),
    [
        ({"late": "replay"}, 2.133277, 9.998782),  # exact
        ({"late": "replay", "buffer_s": 0.05}, 2.082303, 10.058046),  # ignored
        ({"late": "stale"}, 1.683976, 9.777116),  # taken for a current one
    ],
)
def test_a_late_measurement_by_numbers(settings: dict[str, Any], x_m: float, vx_mps: float):
    last = fuse_one(late_measurement(), **PRIOR, **settings)[-1]
    # The two microseconds in between are 20 µm of way.
    assert last["x_m"] == pytest.approx([x_m], abs=3e-5)
    assert last["vx_mps"] == pytest.approx([vx_mps], abs=3e-5)
    assert last["captured_s"] == [0.2]


def test_the_exact_covariance_and_what_it_grows_to_until_now():
    assert fuse_one(late_measurement(), **PRIOR, late="replay")[-1]["cov_ee_m2"] == pytest.approx([0.126803], abs=3e-6)
    later = fuse_one(late_measurement(0.1), **PRIOR, late="replay")[-1]
    assert later["x_m"] == pytest.approx([2.133277 + 0.1 * 9.998782], abs=1e-6)
    assert later["cov_ee_m2"] == pytest.approx([0.126803 + 0.2 * 0.23691 + 0.01 * 3.617297 + 0.001 / 3], abs=1e-6)


def test_a_late_entry_is_moved_to_now_by_its_own_velocity():
    # Alone, so that the filter has nothing to add: 0.5 s at (4, −2) m/s, R grows by q · 0.5³ / 3.
    inputs = inputs_of([[entry(1.0, 2.0, vx_mps=4.0, vy_mps=-2.0, cov=(0.5, 0.1, 0.25))]], ["a"], [1.0], [1.5])
    (one,) = fuse_one(inputs, late="predict", acceleration_psd_m2ps3=0.6, **AT_ONCE)[0]
    assert (one["x_m"], one["y_m"], one["vx_mps"], one["vy_mps"]) == pytest.approx((3.0, 1.0, 4.0, -2.0))
    assert (one["cov_ee_m2"], one["cov_en_m2"], one["cov_nn_m2"]) == pytest.approx((0.525, 0.1, 0.275))
    assert one["captured_s"] == 1.0
    assert one["existence"] == pytest.approx(math.exp(-0.5))
    (stale,) = fuse_one(inputs, late="stale", **AT_ONCE)[0]
    assert (stale["x_m"], stale["y_m"], stale["cov_ee_m2"], stale["existence"]) == pytest.approx((1.0, 2.0, 0.5, 1.0))
    # Heard at its capture: the track itself is what moves on, its speed unsure by 3 m/s, and the claim is 0.5 s old.
    (replayed,) = fuse_one(inputs, late="replay", acceleration_psd_m2ps3=0.6, publish=0.1, **AT_ONCE)[0]
    assert (replayed["x_m"], replayed["y_m"]) == pytest.approx((3.0, 1.0))
    assert replayed["cov_ee_m2"] == pytest.approx(0.5 + 0.25 * 9.0 + 0.025)
    assert replayed["existence"] == pytest.approx(math.exp(-0.5))


@pytest.mark.parametrize("seed", range(8))
def test_replayed_it_does_not_matter_in_which_order_lists_came(seed: int):
    out_of_order = street(seed, delay_s=1.2, together=seed % 2 == 0)
    count = len(out_of_order.captured_s)
    lists = [[out_of_order.lists.of(0, f) for f in range(count)] + [entries_of(0)]]
    units = [out_of_order.units[u] for u in out_of_order.unit_ix] + ["last"]
    captured_s = [*out_of_order.captured_s.tolist(), 3.0]
    settings = {"late": "replay", "buffer_s": 4.0, "publish": 0.05}
    late = fuse_one(inputs_of(lists, units, captured_s, [*out_of_order.arrives_s, 3.0]), **settings)
    timely = fuse_one(inputs_of(lists, units, captured_s, captured_s), **settings)
    assert (np.diff(out_of_order.captured_s[out_of_order.arrived]) < 0).any()
    assert len(timely[-1]) > 0
    assert late[-1].tobytes() == timely[-1].tobytes()


def test_replayed_what_was_only_listed_later_is_not_known_yet():
    # Two tracks meet at 0.875 s and are one; had they been listed side by side at 1 s before, they would not be.
    lists = [[entry(0.0, vx_mps=8.0), entry(7.0), joined(entry(8.0), entry(7.0)), entries_of(0), entries_of(0)]]
    captured_s = [0.0, 0.0, 1.0, 0.875, 1.25]
    settings = {"late": "replay", "publish": 0.2, **AT_ONCE}
    late = fuse_one(inputs_of(lists, list("abcde"), captured_s, [0.0, 0.0, 1.0, 1.125, 1.25]), **settings)
    timely = fuse_one(inputs_of(lists, list("abcde"), captured_s, captured_s), **settings)
    assert sorted(late[1]["track_id"] // 65536) == [0, 1]
    assert sorted(late[-1]["track_id"] // 65536) == [0, 2]
    assert late[-1].tobytes() == timely[-1].tobytes()


@pytest.mark.parametrize("seed", range(4))
def test_replayed_lists_that_are_too_old_are_as_if_they_were_empty(seed: int):
    inputs = street(seed, delay_s=0.8)
    newest_s, too_old = -math.inf, []
    for k in range(len(inputs.issue_s)):
        came = inputs.arrived[inputs.arrived_start[k] : inputs.arrived_start[k + 1]]
        too_old += [int(f) for f in came if inputs.captured_s[f] < newest_s - 0.25 - 1e-6]
        newest_s = max(newest_s, *inputs.captured_s[came].tolist())
    assert len(too_old) > 3
    lists = [entries_of(0) if f in too_old else inputs.lists.of(0, f) for f in range(len(inputs.captured_s))]
    without = replace(inputs, lists=lists_of([lists]))
    found = fuse_one(inputs, late="replay", buffer_s=0.25)
    expected = fuse_one(without, late="replay", buffer_s=0.25)
    assert [one.tobytes() for one in found] == [one.tobytes() for one in expected]
    assert sum(map(len, found)) > 20
    kept = fuse_one(inputs, late="replay", buffer_s=4.0)
    assert [one.tobytes() for one in found] != [one.tobytes() for one in kept]


# --------------------------------------------------------------------------------------- what may not change anything


def shuffled(inputs: Inputs, seed: int) -> tuple[Inputs, list[int]]:
    """Units numbered otherwise, their lists too, and the entries of each in another order; new number of each unit."""
    rng = np.random.default_rng(seed)
    number = rng.permutation(len(inputs.units)).tolist()
    names = [inputs.units[number.index(u)] for u in range(len(inputs.units))]
    order = rng.permutation(len(inputs.captured_s)).tolist()
    by_run = []
    for s in range(len(inputs.lists.start)):
        lists = [inputs.lists.of(s, f) for f in order]
        by_run.append([one[rng.permutation(len(one))] for one in lists])
    whose = [inputs.units[inputs.unit_ix[f]] for f in order]
    other = inputs_of(by_run, whose, inputs.captured_s[order].tolist(), inputs.arrives_s[order].tolist(), names=names)
    return other, number


@pytest.mark.parametrize("late", LATE)
def test_neither_the_order_of_units_nor_of_entries_matters(late: str):
    inputs = street(5, runs=2)
    other, number = shuffled(inputs, 6)
    renamed: dict[tuple[int, int], int] = {}
    for s, (lists, others) in enumerate(zip(fuse(inputs, late=late), fuse(other, late=late), strict=True)):
        assert sum(map(len, lists)) > 20
        for one, two in zip(lists, others, strict=True):
            two = two.copy()
            for e in two:
                e["unit_ix"] = number.index(e["unit_ix"])
            by_place = one[np.argsort(one["x_m"])], two[np.argsort(two["x_m"])]
            for a, b in zip(*by_place, strict=True):
                # Ids name the founding list, and so follow the numbers of lists; who is who stays.
                assert renamed.setdefault((s, int(b["track_id"])), int(a["track_id"])) == a["track_id"]
                b["track_id"] = a["track_id"]
            assert by_place[0].tobytes() == by_place[1].tobytes()
    assert len(set(renamed.values())) > 5


@pytest.mark.parametrize("late", LATE)
def test_units_that_say_exactly_the_same_can_be_exchanged(late: str):
    twins = [joined(entry(3.0, 1.0), entry(3.0, 1.0, vx_mps=2.0)), joined(entry(3.0, 1.0, vx_mps=2.0), entry(3.0, 1.0))]
    times = [0.0, 0.0, 0.125, 0.125]
    found = fuse_one(inputs_of([twins * 2], ["a", "b"] * 2, times, times), late=late)
    other = fuse_one(inputs_of([twins[::-1] * 2], ["b", "a"] * 2, times, times), late=late)
    for one, two in zip(found, other, strict=True):
        for name in ("x_m", "y_m", "vx_mps", "vy_mps", "existence"):
            assert one[name].tolist() == two[name].tolist()
    assert len(found[-1]) == 2


@pytest.mark.parametrize("late", LATE)
def test_a_run_alone_is_the_run_in_a_batch(late: str):
    inputs = street(7, runs=3)
    batch = fuse(inputs, late=late)
    for s in range(3):
        count = len(inputs.captured_s)
        alone = replace(inputs, lists=lists_of([[inputs.lists.of(s, f) for f in range(count)]]))
        assert [one.tobytes() for one in fuse_one(alone, late=late)] == [one.tobytes() for one in batch[s]]


@pytest.mark.parametrize("late", LATE)
def test_nothing_depends_on_what_arrives_later(late: str):
    inputs = street(8)
    cut = len(inputs.issue_s) // 2
    entries = inputs.lists.entries.copy()
    for f in inputs.arrived[inputs.arrived_start[cut] :]:
        mine = entries[inputs.lists.start[0, f] : inputs.lists.start[0, f + 1]]
        mine["x_m"], mine["y_m"], mine["existence"] = -mine["x_m"], 1e3, 0.3
    spoilt = replace(inputs, lists=ObjectLists(inputs.lists.start, entries))
    found, other = fuse_one(inputs, late=late), fuse_one(spoilt, late=late)
    assert [one.tobytes() for one in found[:cut]] == [one.tobytes() for one in other[:cut]]
    assert sum(map(len, found[:cut])) > 10
    assert found[-1].tobytes() != other[-1].tobytes()


def test_what_goes_in_is_left_as_it_is():
    inputs = street(9)
    before = inputs.lists.entries.copy()
    fuse(inputs, late="replay")
    assert inputs.lists.entries.tobytes() == before.tobytes()


# ------------------------------------------------------------------------------------------------ existence, in time


def seen_at(times_s: Sequence[float], looks_s: Sequence[float], **more: Any) -> list[Entries]:
    """A unit lists a standing object at some times; at others another unit's empty list makes the receiver issue."""
    lists = [entry(5.0, 5.0, **more) for _ in times_s] + [entries_of(0) for _ in looks_s]
    units = ["seer"] * len(times_s) + ["blind"] * len(looks_s)
    times = [*times_s, *looks_s]
    return fuse_one(inputs_of([lists], units, times, times, names=["seer", "blind"]), publish=0.0, drop=0.0)


def test_existence_does_not_depend_on_the_rate_of_lists():
    look_s = 1.3
    for rate_hz in (50, 10, 5):
        times = (np.arange(rate_hz + 1) / rate_hz).tolist()
        (one,) = seen_at(times, [look_s], existence=0.8)[-1]
        assert one["existence"] == pytest.approx(0.8 * math.exp(-0.3), abs=1e-12)


@pytest.mark.parametrize("late", LATE)
def test_units_claim_independently_each_with_its_own_age(late: str):
    lists = [[entry(0.0, existence=0.2), entry(0.1, existence=0.6), entry(0.0, existence=0.5), entries_of(0)]]
    times = [0.0, 0.5, 0.75, 1.0]
    inputs = inputs_of(lists, ["a", "a", "b", "b"], times, times)
    (one,) = fuse_one(inputs, late=late, forget_s=0.5, publish=0.2)[-1]
    expected = 1 - (1 - 0.6 * math.exp(-1.0)) * (1 - 0.5 * math.exp(-0.5))
    assert one["existence"] == pytest.approx(expected, abs=1e-12)


def test_existence_fades_from_capture_and_stale_from_arrival():
    # Captured at 0, there at 1.5 s, looked at again at 2 s. Taken for the present it is of 1.5 s.
    inputs = inputs_of([[entry(0.0, existence=0.9), entries_of(0)]], ["a", "b"], [0.0, 2.0], [1.5, 2.0])
    for late, ages_s in (("stale", (0.0, 0.5)), ("predict", (1.5, 2.0)), ("replay", (1.5, 2.0))):
        found = fuse_one(inputs, late=late, publish=0.05, **AT_ONCE)
        claimed = [one["existence"][0] for one in found]
        assert claimed == pytest.approx(
            [0.9 * math.exp(-age_of_information_s) for age_of_information_s in ages_s], abs=1e-12
        ), late


@pytest.mark.parametrize("late", LATE)
def test_an_older_list_does_not_override_what_its_unit_said_later(late: str):
    # What a captured at 0.2 s is there at once; what it captured at 0.1 s comes at 0.3 s.
    lists = [[entry(0.0, existence=0.9, yaw_rad=1.0), entry(1.0, existence=0.3, yaw_rad=2.0)]]
    (one,) = fuse_one(inputs_of(lists, ["a", "a"], [0.2, 0.1], [0.2, 0.3]), late=late, publish=0.1, **AT_ONCE)[-1]
    assert one["existence"] == pytest.approx(0.9 * math.exp(-0.1), abs=1e-12)
    assert (one["yaw_rad"], one["captured_s"]) == (1.0, 0.2)
    # Its place is of use where it is not taken for a present one.
    assert (one["x_m"] == 0.0) == (late == "stale")


@pytest.mark.parametrize("late", LATE)
def test_another_units_older_list_counts(late: str):
    lists = [[entry(0.0, existence=0.9), entry(1.0, existence=0.3)]]
    (one,) = fuse_one(inputs_of(lists, ["a", "b"], [0.2, 0.1], [0.2, 0.3]), late=late, publish=0.1, **AT_ONCE)[-1]
    age_of_information_s = 0.0 if late == "stale" else 0.2
    expected = 1 - (1 - 0.9 * math.exp(-0.1)) * (1 - 0.3 * math.exp(-age_of_information_s))
    assert one["existence"] == pytest.approx(expected, abs=1e-12)
    assert one["x_m"] > 0.1


def test_what_only_the_older_list_holds_is_known_from_its_capture_and_not_to_stale():
    lists = [[entry(0.0, existence=0.9), entry(50.0, existence=0.8)]]
    inputs = inputs_of(lists, ["a", "a"], [0.2, 0.1], [0.2, 0.3])
    assert fuse_one(inputs, late="stale", **AT_ONCE)[-1]["x_m"].tolist() == [0.0]
    for late in ("predict", "replay"):
        found = np.sort(fuse_one(inputs, late=late, **AT_ONCE)[-1], order="x_m")
        assert found["x_m"].tolist() == [0.0, 50.0]
        assert found["existence"] == pytest.approx([0.9 * math.exp(-0.1), 0.8 * math.exp(-0.2)], abs=1e-12)


def test_of_two_lists_of_a_unit_that_come_together_stale_takes_the_newer():
    lists = [[entry(4.0, existence=0.3), entry(0.0, existence=0.9)]]
    (one,) = fuse_one(inputs_of(lists, ["a", "a"], [0.1, 0.2], [0.3, 0.3]), late="stale", **AT_ONCE)[-1]
    assert (one["x_m"], one["existence"], one["captured_s"]) == (0.0, 0.9, 0.2)


def test_a_track_is_confirmed_by_the_time_between_its_lists_not_by_their_number():
    times = [0.0, 0.02, 0.04, 0.06, 0.08, 0.1, 0.12]
    lists = [[entry(0.0) for _ in times]]
    held = [len(one) for one in fuse_one(inputs_of(lists, ["a"] * 7, times, times), confirm_s=0.1)]
    assert held == [0, 0, 0, 0, 0, 1, 1]
    assert [len(one) for one in fuse_one(inputs_of(lists, ["a"] * 7, times, times), **AT_ONCE)] == [1] * 7
    # Two units at the same instant are one look.
    both = inputs_of([[entry(0.0), entry(0.0)]], ["a", "b"], [0.0, 0.0], [0.0, 0.0])
    assert len(fuse_one(both, confirm_s=0.1)[0]) == 0


def test_captures_confirm_not_arrivals():
    inputs = inputs_of([[entry(0.0), entry(0.0)]], ["a", "b"], [0.0, 0.05], [0.5, 1.0])
    assert [len(one) for one in fuse_one(inputs, late="stale", confirm_s=0.1)] == [0, 0]
    assert [len(one) for one in fuse_one(inputs, late="stale", confirm_s=0.05)] == [0, 1]


def test_a_claim_of_exactly_the_threshold_is_not_published():
    inputs = inputs_of([[entry(0.0, existence=0.5)]], ["a"], [0.0], [0.0])
    found = [len(fuse_one(inputs, publish=at, **AT_ONCE)[-1]) for at in (0.5, math.nextafter(0.5, 0.0))]
    assert found == [0, 1]


def test_a_track_fades_out_of_the_list_and_then_out_of_memory():
    def held(*looks_s: float) -> list[Entries]:
        lists = [[entry(0.0, existence=0.8), *(entries_of(0) for _ in looks_s), entry(0.0, existence=0.8)]]
        times = [0.0, *looks_s, looks_s[-1] + 1e-3]
        return fuse_one(inputs_of(lists, ["a"] * len(times), times, times), **AT_ONCE)

    # Published above a half, which 0.8 is down to at ln 1.6; forgotten at 0.05, at ln 16.
    published_s, forgotten_s = math.log(1.6), math.log(16.0)
    found = held(published_s - 1e-3, published_s + 1e-3, forgotten_s - 1e-3)
    assert [len(one) for one in found] == [1, 1, 0, 0, 1]
    assert found[4]["track_id"] == found[0]["track_id"]
    found = held(published_s, forgotten_s + 1e-3)
    assert found[-1]["track_id"] != found[0]["track_id"]


# --------------------------------------------------------------------------------------------------- which are one


def test_two_close_objects_are_kept_apart_where_a_unit_lists_both():
    rng = np.random.default_rng(1)
    times = (np.arange(40) / 8).tolist()
    lists = []
    for _ in times:
        both = [entry(*rng.normal((0.0, place), 0.4), cov=(0.16, 0.0, 0.16)) for place in (0.0, 1.0)]
        lists.append(joined(*(one for one in both if rng.random() < 0.7)))
    found = fuse_one(inputs_of([lists], ["a"] * 40, times, times), publish=0.1)
    assert {len(one) for one in found[8:]} == {2}
    assert len({i for one in found[8:] for i in one["track_id"].tolist()}) == 2


def converging(units: Sequence[str]) -> list[Entries]:
    """Two objects out of each other's gate, never heard of again: a little later both would be in one place."""
    apart = [entry(0.0, vx_mps=7.0 / 0.875), entry(7.0)]
    lists = [joined(*apart)] if len(units) == 1 else apart
    times = [0.0] * len(units) + [0.25, 0.875, 1.25]
    inputs = inputs_of([[*lists, *[entries_of(0)] * 3]], [*units, *["blind"] * 3], times, times)
    return fuse_one(inputs, publish=0.2, **AT_ONCE)


@pytest.mark.parametrize("sigma_m", [None, 0.5, 2.0, 10.0, 100.0])
def test_who_is_who_here_does_not_depend_on_what_is_far_away(sigma_m: float | None):
    # The second list says 0.2 and −3.9 of tracks at 0 and 4: 0.2 is far more likely the first, though −3.9 is then new.
    far = [] if sigma_m is None else [entry(500.0, of="truck", cov=(sigma_m**2, 0.0, sigma_m**2))]
    lists = [[joined(*(entry(x, of="pedestrian") for x in xs), *far) for xs in ((0.0, 4.0), (0.2, -3.9))]]
    found = fuse_one(inputs_of(lists, ["a", "b"], [0.0, 0.01], [0.0, 0.01]), gate=0.99, **AT_ONCE)[-1]
    here = np.sort(found["x_m"][found["x_m"] < 100.0])
    assert here == pytest.approx([-3.9, 0.1, 4.0], abs=1e-3)


def test_of_two_tracks_that_come_together_the_one_founded_later_ends():
    found = converging(["a", "b"])
    assert [len(one) for one in found] == [2, 2, 1, 1]
    (left,) = found[-1]
    # Both founded at the same instant: by place, the first is at 0.
    assert (left["track_id"] // 65536, left["vx_mps"]) == (0, 8.0)


def test_of_two_tracks_of_one_list_none_ends_before_that_is_forgotten():
    found = converging(["a"])
    assert [len(one) for one in found] == [2, 2, 2, 1]


def test_the_track_first_seen_later_ends_whoever_arrived_first():
    lists = [[entry(7.0), entry(0.0, vx_mps=8.0), entries_of(0)]]
    inputs = inputs_of(lists, ["a", "b", "c"], [0.125, 0.0, 1.0], [0.125, 0.25, 1.0])
    (left,) = fuse_one(inputs, late="stale", publish=0.2, **AT_ONCE)[-1]
    assert left["unit_ix"] == 1


def test_tracks_of_classes_that_do_not_agree_are_never_one():
    lists = [[entry(0.0, of="car"), entry(0.0, of="pedestrian"), entry(0.0, of="vehicle"), entry(0.0, of="other")]]
    found = fuse_one(inputs_of(lists, list("abcd"), [0.0] * 4, [0.0] * 4), **AT_ONCE)
    # The vehicle is the car; the other is one of both.
    assert len(found[0]) == 2
    assert sorted(np.round(found[0]["cov_ee_m2"], 6).tolist()) in ([0.333333, 1.0], [0.5, 0.5])


def test_many_units_do_not_split_an_object_in_two():
    rng = np.random.default_rng(2)
    times = np.repeat(np.arange(80) / 8, 10).tolist()
    lists = [[entry(*rng.normal(0.0, 1.0, 2)) for _ in times]]
    found = fuse_one(inputs_of(lists, [f"u{k}" for k in range(10)] * 80, times, times))
    counts = [len(one) for one in found[1:]]
    assert counts.count(1) > 0.8 * len(counts)
    assert max(counts) <= 2
    first = found[1]["track_id"][0]
    assert all(first in one["track_id"] for one in found[1:])


def test_the_most_probable_class_is_the_first_of_equals_and_other_where_nothing_is_said():
    other = CLASSES.index("other")
    said = np.zeros((5, len(CLASSES)))
    said[1, [3, other]] = 0.5
    said[2, [3, 4]] = 0.4, 0.6
    said[3, other] = 1e-3
    said[4, [0, 4]] = 0.5
    assert [most_probable_class(one) for one in said] == [other, 3, 4, other, 0]
    assert most_probable_classes(said).tolist() == [other, 3, 4, other, 0]


def test_classes_that_agree():
    def agree(one: str, other: str) -> bool:
        return bool(AGREE[CLASSES.index(one), CLASSES.index(other)])

    assert AGREE.shape == (len(CLASSES), len(CLASSES))
    assert (AGREE == AGREE.T).all()
    assert all(agree(name, name) and agree(name, "other") for name in CLASSES)
    vehicles = {"motorcycle", "car", "van", "truck", "bus", "trailer", "vehicle"}
    assert {name for name in CLASSES if agree(name, "vehicle")} == vehicles | {"other"}
    assert not agree("car", "truck")
    assert not agree("pedestrian", "bicycle")
    assert AGREE.sum() == 11 + 2 * 10 + 2 * 6


# ------------------------------------------------------------------------------------------------- what is published


def test_yaw_is_the_newest_captured_and_wrapped():
    turns = [3.5, 0.2, -9.0]
    lists = [[entry(0.0, yaw_rad=yaw, z_m=yaw) for yaw in turns]]
    found = fuse_one(inputs_of(lists, ["a"] * 3, [0.0, 0.2, 0.1], [0.0, 0.2, 0.3]), late="stale", **AT_ONCE)
    assert [one["yaw_rad"][0] for one in found] == pytest.approx([3.5 - 2 * math.pi, 0.2, 0.2])
    assert found[-1]["z_m"] == [0.2]
    assert found[-1]["captured_s"] == [0.2]
    (one,) = fuse_one(inputs_of([[entry(0.0, yaw_rad=-9.0)]], ["a"], [0.0], [0.0]), **AT_ONCE)
    assert one["yaw_rad"] == pytest.approx(-9.0 + 2 * math.pi)


def test_sizes_and_classes_are_means_and_the_founder_is_named():
    kinds = np.zeros((2, len(CLASSES)))
    kinds[0, [3, 4]], kinds[1, [3, 10]] = (0.6, 0.4), (0.8, 0.2)
    lists = [
        [entry(0.0, length_m=4.0, class_probability=kinds[0]), entry(0.0, length_m=5.0, class_probability=kinds[1])]
    ]
    (one,) = fuse_one(inputs_of(lists, ["a", "b"], [0.1, 0.0], [0.1, 0.0], names=["z", "a", "b"]))[-1]
    assert (one["length_m"], one["width_m"], one["height_m"]) == pytest.approx((4.5, 2.0, 1.5))
    assert one["class_probability"] == pytest.approx(kinds.mean(axis=0))
    assert (one["unit_ix"], one["track_id"]) == (2, 65536)


def test_nothing_said_of_the_class_agrees_with_all():
    lists = [[entry(0.0, of="pedestrian"), entry(0.0, class_probability=np.zeros(len(CLASSES)))]]
    (one,) = fuse_one(inputs_of(lists, ["a", "b"], [0.0, 0.0], [0.0, 0.0]), **AT_ONCE)[0]
    assert one["class_probability"][CLASSES.index("pedestrian")] == 1.0
    (one,) = fuse_one(inputs_of([lists[0][1:]], ["b"], [0.0], [0.0]), **AT_ONCE)[0]
    assert one["class_probability"].tolist() == [0.0] * len(CLASSES)


def test_exact_lists_are_taken_as_exact_as_the_smallest_variance_allows():
    lists = [[entry(3.0 + 0.1 * k, cov=(0.0, 0.0, 0.0)) for k in range(5)]]
    times = [0.1 * k for k in range(5)]
    (one,) = fuse_one(inputs_of(lists, ["a"] * 5, times, times))[-1]
    assert one["x_m"] == pytest.approx(3.4, abs=1e-6)
    assert 0 < one["cov_ee_m2"] <= 1e-9


def test_nothing_heard_nothing_said():
    nothing = inputs_of([[], []], [], [], [], names=["a"])
    lists = ask_fusion(Tracker(), nothing, "fusion")
    assert lists.start.tolist() == [[0], [0]]
    assert len(lists.entries) == 0
    for late in LATE:
        empty = inputs_of([[entries_of(0)] * 3] * 2, ["a"] * 3, [0.0, 0.1, 0.2], [0.0, 0.3, 0.2])
        assert [[len(one) for one in run] for run in fuse(empty, late=late)] == [[0, 0, 0]] * 2


# ----------------------------------------------------------------------------------------------- how good it is


def walks(runs: int, q: float, sigma: float) -> tuple[Inputs, Array]:
    """One object per run that moves as the filter assumes, listed at 10 Hz; where it is in the end (runs, 2)."""
    rng = np.random.default_rng(4)
    step, steps = 0.1, 50
    root = np.linalg.cholesky(q * np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]]))
    place, speed = np.zeros((runs, 2)), rng.normal(0.0, 5.0, (runs, 2))
    told = speed + rng.normal(0.0, 3.0, (runs, 2))
    by_run: list[list[Entries]] = [[] for _ in range(runs)]
    for _ in range(steps):
        noise = root @ rng.normal(size=(2, runs, 2)).reshape(2, -1)
        place = place + step * speed + noise[0].reshape(runs, 2)
        speed = speed + noise[1].reshape(runs, 2)
        listed = place + rng.normal(0.0, sigma, (runs, 2))
        for s in range(runs):
            by_run[s].append(entry(*listed[s], vx_mps=told[s, 0], vy_mps=told[s, 1], cov=(sigma**2, 0.0, sigma**2)))
    times = [step * k for k in range(steps)]
    return inputs_of(by_run, ["a"] * steps, times, times), place


def test_its_errors_are_as_large_as_it_says():
    inputs, place = walks(100, 1.0, 0.5)
    found = [run[-1] for run in fuse(inputs, gate=0.999999)]
    assert {len(one) for one in found} == {1}
    squares = []
    for (one,), truth in zip(found, place, strict=True):
        error = np.array([one["x_m"], one["y_m"]]) - truth
        P = np.array([[one["cov_ee_m2"], one["cov_en_m2"]], [one["cov_en_m2"], one["cov_nn_m2"]]])
        squares.append(error @ np.linalg.solve(P, error))
    # 95 % band of the mean of 100 squares of two degrees of freedom.
    assert 1.627 < np.mean(squares) < 2.411


def test_what_moves_at_constant_velocity_is_tracked_better_than_it_is_measured():
    inputs, place = walks(60, 1e-3, 0.5)
    found = [run[-1] for run in fuse(inputs, acceleration_psd_m2ps3=0.01)]
    errors = [[one["x_m"][0], one["y_m"][0]] - truth for one, truth in zip(found, place, strict=True)]
    assert np.sqrt(np.mean(np.square(errors))) < 0.25


# ------------------------------------------------------------------------------------------------------- settings


def test_settings_by_default():
    assert Tracker().model_dump() == {
        "kind": "tracker", "late": "predict", "acceleration_psd_m2ps3": 1.0, "speed_sigma_mps": 3.0, "gate": 0.999,
        "forget_s": 1.0, "publish": 0.5, "drop": 0.05, "confirm_s": 0.1, "buffer_s": 2.0,
    }  # fmt: skip


@pytest.mark.parametrize(
    "settings",
    [
        {"gate": 0.0}, {"gate": 1.0}, {"late": "later"}, {"forget_s": 0.0}, {"publish": 0.1, "drop": 0.2},
        {"confirm_s": -0.1}, {"buffer_s": 0.0}, {"speed_sigma_mps": 0.0}, {"drop": 1.5}, {"gate_m": 3.0},
    ],
)  # fmt: skip
def test_settings_that_make_no_sense_are_refused(settings: dict[str, Any]):
    with pytest.raises(ValidationError):
        Tracker(**settings)


@pytest.mark.parametrize("late", LATE)
def test_published_is_what_is_claimed_above_the_threshold(late: str):
    # Looked at when it was said, nothing has faded: 1 − (1 − 0.5) is exactly a half.
    for claimed, count in ((0.5, 0), (0.5 + 1e-12, 1)):
        inputs = inputs_of([[entry(0.0, existence=claimed)]], ["a"], [0.0], [0.0])
        assert len(fuse_one(inputs, late=late, publish=0.5, **AT_ONCE)[0]) == count


def test_lists_of_one_entry_need_no_other_code():
    """A part of the columns of one row is contiguous, of more rows it is not: Numba compiles for each."""
    two = joined(*(entry(x_m=30.0 * k) for k in range(2)))
    for count in (2, 1, 0):
        fuse(inputs_of([[two[:count]]], ["a"], [0.0], [0.1]))
    assert len(track_run.signatures) == 1
