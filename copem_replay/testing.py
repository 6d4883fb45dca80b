"""Does a component of your own keep the rules? Ask in a test of yours.

    def test_mine():
        check_fusion(Mine(kind="mine:Mine", radius_m=2.0))

The scenes are small and made here: objects in a crowd, lists that come late, out of order, empty or never, one unit or
many. They do not ask how good a fusion is: that is what an experiment is for.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from copem_replay.fusion.component import (
    ListFusion,
    StepFusion,
    content_problem,
    form_problem,
    inbox_at,
    pair_problem,
)
from copem_replay.fusion.object_list import COVARIANCES, ENTRY, Entries, Lists, Reports, entries_of
from copem_replay.fusion.reports import reports
from copem_replay.fusion.stretch import one_after_another, stretch
from copem_replay.resample import wrap
from copem_replay.tracks import CLASSES, VALUES, Bool, Float, Int, Tracks

RULES = {
    "answer": "there is a list of ENTRY for each run and instant, and its numbers can be used",
    "inputs": "what is handed over belongs to others, too: copy what you change",
    "again": "the same reports give the same lists, to the last bit: draw nothing, keep nothing but `memory`",
    "runs": "a run gives the same lists, to the last bit, whichever others stand beside it: nothing passes between",
    "causality": "what is issued depends on nothing that arrives later, and is not changed afterwards",
    "stretches": "where it is `resumable`: handed over in stretches, with `looks_back_s`, instants get the same lists",
    "unheard": "a unit of which nothing arrives makes no difference",
    "order of entries": "entries are in no order that means anything, and each unit numbers its tracks as it likes",
    "order of units": "units are in no order that means anything; if yours are, say units_in_any_order=False",
    "silence": "something is listed in some scene, or nothing has been checked",
}
"""What `check_fusion` demands."""

_TOLERANCE = 1e-9  # absolute or relative: in another order sums are rounded otherwise

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


class NonconformingError(AssertionError):
    """A component breaks one of the RULES, `rule`: what was expected, what was found, in which scene and when."""

    def __init__(self, rule: str, kind: str, where: str, said: str) -> None:
        self.rule = rule
        super().__init__(f"{kind} breaks the rule {rule!r}: {RULES[rule]}. {where}: {said}.")


def check_fusion(fusion: ListFusion, *, seed: int = 0, units_in_any_order: bool = True) -> None:
    """Raise NonconformingError for the first rule found broken; say nothing where a fusion keeps all RULES.

    `seed`: of the scenes, and of the orders tried. `units_in_any_order`: whether the order of units must not matter.
    """
    scenes = [_scene(np.random.default_rng((seed, number, 0)), *what) for number, what in enumerate(_SCENES)]
    trials = [_Trial(fusion, scene) for scene in scenes]
    firsts = [trial.answer(trial.scene) for trial in trials]
    for number, (trial, first) in enumerate(zip(trials, firsts, strict=True)):
        scene, dice = trial.scene, np.random.default_rng((seed, number, 1))
        trial.same("again", first, scene, "asked again")
        for runs in ([0], [1], [2], [2, 1, 0]):
            trial.same("runs", first, scene.of_runs(runs), f"runs {runs}")
        issue_s = scene.reports().issue_s
        for k in sorted({len(issue_s) * fifth // 5 for fifth in range(5)} if len(issue_s) else ()):
            later, after = scene.arrives_s > issue_s[k], f"what arrives after {issue_s[k]:.3f} s"
            trial.same("causality", first, scene.of_lists(np.flatnonzero(~later)), f"without {after}")
            trial.same("causality", first, scene.spoiled(later), f"{after} spoiled", until_s=issue_s[k])
        trial.same("unheard", first, scene.beside("unheard"), "and a unit that is not heard")
        trial.same("order of entries", first, scene.shuffled(dice), "entries shuffled and tracks renumbered")
        if fusion.resumable:
            trial.resumed(first, np.arange(len(issue_s)))
            trial.resumed(first, np.sort(np.random.default_rng((seed, number, 2)).integers(0, len(issue_s) + 1, 4)))
        if units_in_any_order:
            other = scene.of_units(dice.permutation(len(scene.units)))
            trial.same("order of units", first, other, f"units in the order {', '.join(other.units)}")
    if not any(len(first.entries) for first in firsts):
        raise NonconformingError("silence", fusion.kind, f"All scenes of seed {seed}", "expected entries, found none")


@dataclass(frozen=True)
class _Scene:
    """Who says what and when: `said[s][f]` are the entries of list f in run `runs[s]`."""

    name: str
    units: tuple[str, ...]
    unit_ix: Int  # (F,)
    captured_s: Float  # (F,)
    arrives_s: Float  # (F,)
    runs: Sequence[int]
    said: tuple[tuple[Entries, ...], ...]

    def reports(self) -> Reports:
        runs, count = len(self.said), len(self.unit_ix)
        lists = [one for run in self.said for one in run]
        lengths = np.array([len(one) for one in lists], dtype=np.int64)
        start = np.append(0, np.cumsum(lengths))[np.arange(runs)[:, None] * count + np.arange(count + 1)]
        whose, when = (np.repeat(np.tile(column, runs), lengths) for column in (self.unit_ix, self.captured_s))
        entries = _with(np.concatenate([entries_of(0), *lists], dtype=ENTRY), unit_ix=whose, captured_s=when)
        none, nothing = np.empty(0, dtype=np.int64), np.empty((1, 0))
        stamp_ns = np.rint(self.captured_s * 1e9).astype(np.int64)
        heard = Tracks(
            self.units, np.zeros(1, dtype=np.int64), none, none, none, stamp_ns, self.captured_s, self.unit_ix,
            self.arrives_s[None], nothing.astype(bool), **dict.fromkeys(VALUES, nothing),
        )  # fmt: skip
        return reports(heard, Lists(start, entries), max_age_s=1.0)

    def of_runs(self, runs: Sequence[int]) -> _Scene:
        return replace(self, runs=runs, said=tuple(self.said[s] for s in runs))

    def of_lists(self, lists: Int) -> _Scene:
        columns = {name: getattr(self, name)[lists] for name in ("unit_ix", "captured_s", "arrives_s")}
        return replace(self, said=tuple(tuple(run[f] for f in lists) for run in self.said), **columns)

    def of_units(self, order: Int) -> _Scene:
        place = np.argsort(order)
        scene = self.of_lists(np.argsort(place[self.unit_ix], kind="stable"))
        return replace(scene, units=tuple(self.units[u] for u in order), unit_ix=place[scene.unit_ix])

    def beside(self, unit: str) -> _Scene:
        count = len(self.unit_ix)
        scene = self.of_lists(np.tile(np.arange(count), 2))
        scene.unit_ix[count:], scene.arrives_s[count:] = len(self.units), np.inf
        return replace(scene, units=(*self.units, unit))

    def spoiled(self, lists: Bool) -> _Scene:
        return self._each(lambda f, one: _with(np.tile(one, 2), x_m=np.arange(2.0 * len(one))) if lists[f] else one)

    def shuffled(self, dice: np.random.Generator) -> _Scene:
        new = dice.permuted(np.tile(np.arange(100), (len(self.units), 1)), axis=1)
        return self._each(lambda f, one: dice.permutation(_with(one, track_id=new[self.unit_ix[f], one["track_id"]])))

    def _each(self, change: Callable[[int, Entries], Entries]) -> _Scene:
        return replace(self, said=tuple(tuple(change(f, one) for f, one in enumerate(run)) for run in self.said))


def _with(entries: Entries, **columns: ArrayLike) -> Entries:
    changed = entries.copy()
    for name, column in columns.items():
        changed[name] = column
    return changed


def _scene(
    dice: np.random.Generator, name: str, units: int, n: int, width_m: float, lists: int, late_s: float, lost: float
) -> _Scene:
    unit_ix = np.repeat(np.arange(units), lists)
    # Every other unit captures at the same instants.
    phase_s = np.where(np.arange(units) % 2 == 0, 0.0, dice.uniform(0.0, 0.1, units)) * (late_s > 0)
    captured_s = np.tile(np.arange(lists) * 0.1, units) + phase_s[unit_ix]
    # Several at one instant, also of one unit; of two units never quite: the order of units is not to say who is first.
    arrives_s = np.ceil((captured_s + dice.uniform(0.0, late_s, len(unit_ix))) / 0.05) * 0.05 + 5e-8 * unit_ix
    arrives_s[dice.random(len(unit_ix)) < lost] = np.inf
    place_m, speed_mps = dice.uniform(0.0, width_m, (2, n)), dice.normal(0.0, 3.0, (2, n))
    likely = 0.8 * np.eye(len(CLASSES))[dice.integers(0, 4, n)] + 0.2 / len(CLASSES)

    def listed(f: int) -> Entries:
        one = entries_of(n)
        one["x_m"], one["y_m"] = place_m + speed_mps * captured_s[f] + dice.normal(0.0, 0.5, (2, n))
        one["vx_mps"], one["vy_mps"] = speed_mps + dice.normal(0.0, 0.3, (2, n))
        one["length_m"], one["width_m"], one["height_m"] = dice.uniform(1.0, 4.0, (3, n))
        one["z_m"], one["yaw_rad"] = one["height_m"] / 2, np.arctan2(one["vy_mps"], one["vx_mps"])
        one["cov_ee_m2"], one["cov_nn_m2"] = dice.uniform(0.1, 0.5, (2, n))
        one["cov_en_m2"] = dice.uniform(-0.5, 0.5, n) * np.sqrt(one["cov_ee_m2"] * one["cov_nn_m2"])
        one["existence"], one["track_id"] = dice.uniform(0.5, 1.0, n), np.arange(n)
        one["class_probability"] = likely
        return dice.permutation(one[dice.random(n) < 0.8])

    said = tuple(tuple(listed(f) for f in range(len(unit_ix))) for _ in range(3))
    return _Scene(name, tuple("ABCDEFGHIJKL"[:units]), unit_ix, captured_s, arrives_s, range(3), said)


@dataclass(frozen=True)
class _Trial:
    fusion: ListFusion
    scene: _Scene

    def broken(self, rule: str, scene: _Scene, said: object, s: int = -1, now_s: float = 0.0) -> NonconformingError:
        when = f", run {scene.runs[s]}, instant {now_s:.3f} s" if s >= 0 else ""
        return NonconformingError(rule, self.fusion.kind, f"Scene {scene.name!r}{when}", str(said))

    def answer(self, scene: _Scene) -> Lists:
        """What the fusion gives of a scene, checked."""
        told = scene.reports()
        before = _contents(told)
        try:
            found = self.fusion.fuse(told)
        except Exception as error:
            failed = _failed_step(self.fusion, scene.reports()) if isinstance(self.fusion, StepFusion) else None
            failed = failed or (f"expected Lists, found {type(error).__name__}: {error}", -1, 0.0)
            raise self.broken("answer", scene, *failed) from error
        if changed := [name for name, now in _contents(told).items() if now != before[name]]:
            raise self.broken("inputs", scene, f"expected reports as before, found {', '.join(changed)} changed")
        if wrong := form_problem(found, told):
            raise self.broken("answer", scene, wrong)
        for s, k in np.ndindex(len(scene.said), len(told.issue_s)) if content_problem(found, told) else ():
            one = Lists(np.array([[0, len(found.of(s, k))]]), found.of(s, k))
            if wrong := content_problem(one, replace(told, lists=one, issue_s=told.issue_s[k : k + 1])):
                raise self.broken("answer", scene, wrong, s, float(told.issue_s[k]))
        return found

    def same(self, rule: str, first: Lists, scene: _Scene, variation: str, *, until_s: float = np.inf) -> None:
        """Whether a variation of the scene gives the lists of `first`: as sets, or to the last bit."""
        scene = replace(scene, name=f"{scene.name}; {variation}")
        self.compare(rule, first, self.answer(scene), scene, until_s)

    def resumed(self, first: Lists, cuts: Int) -> None:
        """Whether the scene's instants, cut at these places, get the lists of `first`, to the last bit."""
        told, memory = self.scene.reports(), None
        parts: list[Lists] = []
        scene = replace(self.scene, name=f"{self.scene.name}; instants in stretches")
        for a, b in pairwise([0, *cuts.tolist(), len(told.issue_s)]):
            one = stretch(told, a, b, self.fusion.looks_back_s)
            try:
                given = self.fusion.resume(one, memory)
            except Exception as error:
                said = f"expected Lists and a memory of instants[{a}:{b}], found {type(error).__name__}: {error}"
                raise self.broken("stretches", scene, said) from error
            if wrong := pair_problem(given) or form_problem(given[0], one):
                raise self.broken("stretches", scene, wrong)
            found, memory = given
            parts.append(found)
        self.compare("stretches", first, one_after_another(parts), scene, np.inf)

    def compare(self, rule: str, first: Lists, found: Lists, scene: _Scene, until_s: float) -> None:
        """Whether the lists found of a scene are those of `first`: as sets, or to the last bit."""
        issue_s = scene.reports().issue_s
        exact = rule in ("again", "runs", "stretches")
        whose = np.array([*map((*self.scene.units, *scene.units).index, scene.units), -1])
        for s, run in enumerate(scene.runs):
            called: dict[tuple[str, int], int] = {}
            for k, now_s in enumerate(issue_s[issue_s <= until_s].tolist()):
                expected, one = first.of(run, k), found.of(s, k)
                if exact and one.tobytes() == expected.tobytes():
                    continue
                said = _difference(expected, _with(one, unit_ix=whose[one["unit_ix"]]), called)
                if said is None and exact:
                    said = "expected the bytes of the scene itself, found another order, other track ids or last digits"
                if said is not None:
                    raise self.broken(rule, scene, said, s, now_s)


def _contents(told: Reports) -> dict[str, bytes]:
    columns = vars(told) | vars(told.lists)
    return {name: column.tobytes() for name, column in columns.items() if isinstance(column, np.ndarray)}


def _failed_step(fusion: StepFusion, told: Reports) -> tuple[str, int, float] | None:
    """What a step gives instead of entries and memory, in which run, at which instant."""
    memory = None
    for s, k in np.ndindex(len(told.lists.start), len(told.issue_s)):
        try:
            entries, memory = fusion.step(float(told.issue_s[k]), inbox_at(told, s, k), memory if k else None)
            found = f"{type(entries).__name__} of {np.asarray(entries).dtype.name}"
        except Exception as error:
            entries, found = None, f"{type(error).__name__}: {error}"
        if not isinstance(entries, np.ndarray) or entries.dtype != ENTRY:
            return f"expected entries of ENTRY and memory from step, found {found}", s, float(told.issue_s[k])
    return None


def _difference(expected: Entries, found: Entries, called: dict[tuple[str, int], int]) -> str | None:
    """How two lists differ as sets. What a track is called does not matter: `called` keeps what it has been so far."""
    if len(found) != len(expected):
        return f"expected {len(expected)} entries as in the scene itself, found {len(found)}"
    a, b = (one[np.lexsort((one["unit_ix"], one["y_m"].round(6), one["x_m"].round(6)))] for one in (expected, found))
    for name in (*VALUES, *COVARIANCES, "existence", "class_probability", "captured_s", "unit_ix"):
        off = wrap(a[name] - b[name]) if name == "yaw_rad" else a[name] - b[name]
        if (other := np.abs(off) > _TOLERANCE * np.maximum(1.0, np.abs(a[name]))).any():
            i = np.argmax(other)
            return f"{name}: expected {a[name].flat[i]:.12g} as in the scene itself, found {b[name].flat[i]:.12g}"
    for was, now in zip(a["track_id"].tolist(), b["track_id"].tolist(), strict=True):
        one_to_one = called.setdefault(("was", was), now) == now and called.setdefault(("now", now), was) == was
        if not one_to_one or (was < 0) != (now < 0):
            return f"track_id: expected what was {was} to be one track, and no other to be called so, found {now}"
    return None
