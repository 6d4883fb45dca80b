"""The scenes in which `fusion/testing/check.py` asks: small, made here, and varied in ways that must not matter."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from copem_replay.core.object_list import ENTRY, Entries, Inputs, ObjectLists, entries_of
from copem_replay.core.tracks import CLASSES, VALUES, Bool, Float, Int, Tracks
from copem_replay.fusion.inputs import inputs

_SCENES: tuple[tuple[str, int, int, float, int, float, float], ...] = (
    # units, objects in a square of … m, lists of each unit, up to … s late, share of lists that never arrive
    ("one object and one unit", 1, 1, 50.0, 12, 0.0, 0.0),
    ("two units at the same instants", 2, 3, 50.0, 10, 0.0, 0.0),
    ("a crowd", 3, 6, 4.0, 8, 0.1, 0.0),
    ("lists late, out of order and lost", 4, 4, 20.0, 10, 0.5, 0.2),
    ("lists older than is gone by", 3, 2, 30.0, 6, 2.5, 0.0),
    ("many units", 12, 4, 12.0, 4, 0.2, 0.1),
    ("empty lists", 2, 0, 50.0, 5, 0.1, 0.0),
    ("nothing arrives", 2, 2, 50.0, 3, 0.1, 1.0),
    ("no lists", 2, 2, 50.0, 0, 0.1, 0.0),
)


@dataclass(frozen=True)
class SmallScene:
    """The lists of units: `said[s][f]` are the entries of list f in run `runs[s]`."""

    name: str
    units: tuple[str, ...]
    unit_ix: Int  # (F,)
    captured_s: Float  # (F,)
    arrives_s: Float  # (F,)
    runs: Sequence[int]
    said: tuple[tuple[Entries, ...], ...]

    def inputs(self) -> Inputs:
        """What a fusion is told of it."""
        runs, count = len(self.said), len(self.unit_ix)
        lists = [one for run in self.said for one in run]
        lengths = np.array([len(one) for one in lists], dtype=np.int64)
        start = np.append(0, np.cumsum(lengths))[np.arange(runs)[:, None] * count + np.arange(count + 1)]
        unit_ix, time_s = (np.repeat(np.tile(column, runs), lengths) for column in (self.unit_ix, self.captured_s))
        entries = with_columns(np.concatenate([entries_of(0), *lists], dtype=ENTRY), unit_ix=unit_ix, captured_s=time_s)
        none, nothing = np.empty(0, dtype=np.int64), np.empty((1, 0))
        stamp_ns = np.rint(self.captured_s * 1e9).astype(np.int64)
        heard = Tracks(
            self.units, np.zeros(1, dtype=np.int64), none, none, none, stamp_ns, self.captured_s, self.unit_ix,
            self.arrives_s[None], nothing.astype(bool), **dict.fromkeys(VALUES, nothing),
        )  # fmt: skip
        return inputs(heard, ObjectLists(start, entries), max_age_s=1.0)

    def of_runs(self, runs: Sequence[int]) -> SmallScene:
        """Some of its runs, in this order."""
        return replace(self, runs=runs, said=tuple(self.said[s] for s in runs))

    def of_lists(self, lists: Int) -> SmallScene:
        """Some of its lists, in this order."""
        columns = {name: getattr(self, name)[lists] for name in ("unit_ix", "captured_s", "arrives_s")}
        return replace(self, said=tuple(tuple(run[f] for f in lists) for run in self.said), **columns)

    def of_units(self, order: Int) -> SmallScene:
        """Its units in this order."""
        place = np.argsort(order)
        scene = self.of_lists(np.argsort(place[self.unit_ix], kind="stable"))
        return replace(scene, units=tuple(self.units[u] for u in order), unit_ix=place[scene.unit_ix])

    def beside(self, unit: str) -> SmallScene:
        """One unit more, of which nothing arrives."""
        count = len(self.unit_ix)
        scene = self.of_lists(np.tile(np.arange(count), 2))
        scene.unit_ix[count:], scene.arrives_s[count:] = len(self.units), np.inf
        return replace(scene, units=(*self.units, unit))

    def spoiled(self, lists: Bool) -> SmallScene:
        """With other entries in some of its lists (F,)."""
        return self._each(
            lambda f, one: with_columns(np.tile(one, 2), x_m=np.arange(2.0 * len(one))) if lists[f] else one
        )

    def shuffled(self, rng: np.random.Generator) -> SmallScene:
        """With entries in another order, and tracks of units by other numbers."""
        new = rng.permuted(np.tile(np.arange(100), (len(self.units), 1)), axis=1)
        return self._each(
            lambda f, one: rng.permutation(with_columns(one, track_id=new[self.unit_ix[f], one["track_id"]]))
        )

    def _each(self, change: Callable[[int, Entries], Entries]) -> SmallScene:
        return replace(self, said=tuple(tuple(change(f, one) for f, one in enumerate(run)) for run in self.said))


def with_columns(entries: Entries, **columns: ArrayLike) -> Entries:
    """A copy in which some columns are others."""
    changed = entries.copy()
    for name, column in columns.items():
        changed[name] = column
    return changed


def small_scenes(seed: int) -> list[SmallScene]:
    """One of each kind."""
    return [_scene(np.random.default_rng((seed, number, 0)), *what) for number, what in enumerate(_SCENES)]


def _scene(
    rng: np.random.Generator, name: str, units: int, n: int, width_m: float, lists: int, late_s: float, lost: float
) -> SmallScene:
    unit_ix = np.repeat(np.arange(units), lists)
    # Every other unit captures at the same instants.
    phase_s = np.where(np.arange(units) % 2 == 0, 0.0, rng.uniform(0.0, 0.1, units)) * (late_s > 0)
    captured_s = np.tile(np.arange(lists) * 0.1, units) + phase_s[unit_ix]
    # Several at one instant, also of one unit; of two units never quite: the units' order must not matter.
    arrives_s = np.ceil((captured_s + rng.uniform(0.0, late_s, len(unit_ix))) / 0.05) * 0.05 + 5e-8 * unit_ix
    arrives_s[rng.random(len(unit_ix)) < lost] = np.inf
    place_m, speed_mps = rng.uniform(0.0, width_m, (2, n)), rng.normal(0.0, 3.0, (2, n))
    likely = 0.8 * np.eye(len(CLASSES))[rng.integers(0, 4, n)] + 0.2 / len(CLASSES)

    def listed(f: int) -> Entries:
        one = entries_of(n)
        one["x_m"], one["y_m"] = place_m + speed_mps * captured_s[f] + rng.normal(0.0, 0.5, (2, n))
        one["vx_mps"], one["vy_mps"] = speed_mps + rng.normal(0.0, 0.3, (2, n))
        one["length_m"], one["width_m"], one["height_m"] = rng.uniform(1.0, 4.0, (3, n))
        one["z_m"], one["yaw_rad"] = one["height_m"] / 2, np.arctan2(one["vy_mps"], one["vx_mps"])
        one["cov_ee_m2"], one["cov_nn_m2"] = rng.uniform(0.1, 0.5, (2, n))
        one["cov_en_m2"] = rng.uniform(-0.5, 0.5, n) * np.sqrt(one["cov_ee_m2"] * one["cov_nn_m2"])
        one["existence"], one["track_id"] = rng.uniform(0.5, 1.0, n), np.arange(n)
        one["class_probability"] = likely
        return rng.permutation(one[rng.random(n) < 0.8])

    said = tuple(tuple(listed(f) for f in range(len(unit_ix))) for _ in range(3))
    return SmallScene(name, tuple("ABCDEFGHIJKL"[:units]), unit_ix, captured_s, arrives_s, range(3), said)
