"""Checks of your own fusions, for your tests; and time chunks of the input of a fusion.

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

from copem_replay.communication.arrivals import FusionSchedule
from copem_replay.core.interpolation import wrap_angles
from copem_replay.core.object_list import COVARIANCES, ENTRY, Entries, Inputs, ObjectLists, entries_of
from copem_replay.core.tracks import CLASSES, SAME_INSTANT_S, VALUES, Bool, Float, Int, Tracks
from copem_replay.fusion.inputs import make_inputs
from copem_replay.fusion.interface import (
    ListFusion,
    StepFusion,
    content_problem,
    form_problem,
    make_inbox,
    pair_problem,
)

# Time chunks of the receiver's instants: a long recording is fused chunk after chunk, with the results of one piece.
# List f is one list in all of them, but has its entries only in the time chunks that need it.


def needed_lists(
    captured_s: Float, instants: FusionSchedule | Inputs, first: int, after: int, looks_back_s: float
) -> Bool:
    """Mask (F,) of the lists that the instants `first` … `after` − 1 need; `captured_s (F,)`: their captures.

    The units' newest, those that arrive, and, where `ListFusion.looks_back_s` is not 0, those that have arrived before
    and were captured at most so long before the newest of them.
    """
    needed: Bool = np.zeros(len(captured_s), dtype=bool)
    if first == after:
        return needed
    newest = instants.newest[first:after]
    needed[newest[newest >= 0]] = True
    begin, end = instants.arrived_start[first], instants.arrived_start[after]
    needed[instants.arrived[begin:end]] = True
    before = instants.arrived[:begin]
    if looks_back_s > 0 and len(before):
        # Twice: a fusion that looks back has a tolerance of its own.
        oldest_s = captured_s[before].max() - looks_back_s - 2 * SAME_INSTANT_S
        needed[before[captured_s[before] >= oldest_s]] = True
    return needed


def cut_chunk(inputs: Inputs, first: int, after: int, looks_back_s: float) -> Inputs:
    """The input at the instants `first` … `after` − 1, with only the entries of needed lists."""
    needed = needed_lists(inputs.captured_s, inputs, first, after, looks_back_s)
    start, entries = inputs.lists.start, inputs.lists.entries
    lengths = np.where(needed, np.diff(start), 0)
    is_needed = np.repeat(np.tile(needed, len(start)), np.diff(start).ravel())
    begin = inputs.arrived_start[first]
    return replace(
        inputs,
        lists=ObjectLists(_list_starts(lengths), entries[is_needed]),
        issue_s=inputs.issue_s[first:after],
        newest=inputs.newest[first:after],
        arrived=inputs.arrived[begin : inputs.arrived_start[after]],
        arrived_start=inputs.arrived_start[first : after + 1] - begin,
    )


def join_chunks(chunks: Sequence[ObjectLists]) -> ObjectLists:
    """The lists of all time chunks, at least one, in the runs that they share."""
    parts = [
        chunk.entries[chunk.start[s, 0] : chunk.start[s, -1]] for s in range(len(chunks[0].start)) for chunk in chunks
    ]
    lengths = np.concatenate([np.diff(chunk.start) for chunk in chunks], axis=1)
    return ObjectLists(_list_starts(lengths), np.concatenate([entries_of(0), *parts]))


def _list_starts(lengths: Int) -> Int:
    """(S, K + 1) where lists of so many entries (S, K) begin."""
    ends = np.cumsum(lengths).reshape(lengths.shape)
    totals = lengths.sum(axis=1)
    return np.concatenate([(np.cumsum(totals) - totals)[:, None], ends], axis=1)


# Scenes: small, made here, and varied in ways that must not matter.

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
    """The lists of units: `said[s][f]` has the entries of list f in run `runs[s]`."""

    name: str
    units: tuple[str, ...]
    unit_ix: Int  # (F,)
    captured_s: Float  # (F,)
    arrives_s: Float  # (F,)
    runs: Sequence[int]
    said: tuple[tuple[Entries, ...], ...]

    def inputs(self) -> Inputs:
        """The scene as the input of a fusion: its lists in three runs, with arrivals and units."""
        runs, count = len(self.said), len(self.unit_ix)
        lists = [entries_of_list for run in self.said for entries_of_list in run]
        lengths = np.array([len(entries_of_list) for entries_of_list in lists], dtype=np.int64)
        start = np.append(0, np.cumsum(lengths))[np.arange(runs)[:, None] * count + np.arange(count + 1)]
        unit_ix, time_s = (np.repeat(np.tile(column, runs), lengths) for column in (self.unit_ix, self.captured_s))
        entries = replace_columns(
            np.concatenate([entries_of(0), *lists], dtype=ENTRY), unit_ix=unit_ix, captured_s=time_s
        )
        no_rows, no_values = np.empty(0, dtype=np.int64), np.empty((1, 0))
        stamp_ns = np.rint(self.captured_s * 1e9).astype(np.int64)
        received = Tracks(
            self.units, np.zeros(1, dtype=np.int64), no_rows, no_rows, no_rows, stamp_ns, self.captured_s, self.unit_ix,
            self.arrives_s[None], no_values.astype(bool), **dict.fromkeys(VALUES, no_values),
        )  # fmt: skip
        return make_inputs(received, ObjectLists(start, entries), max_age_s=1.0)

    def of_runs(self, runs: Sequence[int]) -> SmallScene:
        """The scene in the runs `runs`, in this order."""
        return replace(self, runs=runs, said=tuple(self.said[s] for s in runs))

    def of_lists(self, lists: Int) -> SmallScene:
        """The scene with the lists `lists`, in this order."""
        columns = {name: getattr(self, name)[lists] for name in ("unit_ix", "captured_s", "arrives_s")}
        return replace(self, said=tuple(tuple(run[f] for f in lists) for run in self.said), **columns)

    def of_units(self, order: Int) -> SmallScene:
        """The scene with its units in this order."""
        place = np.argsort(order)
        scene = self.of_lists(np.argsort(place[self.unit_ix], kind="stable"))
        return replace(scene, units=tuple(self.units[u] for u in order), unit_ix=place[scene.unit_ix])

    def beside(self, unit: str) -> SmallScene:
        """The scene with one more unit, from which no list arrives."""
        count = len(self.unit_ix)
        scene = self.of_lists(np.tile(np.arange(count), 2))
        scene.unit_ix[count:], scene.arrives_s[count:] = len(self.units), np.inf
        return replace(scene, units=(*self.units, unit))

    def spoiled(self, lists: Bool) -> SmallScene:
        """The scene with other entries in the lists (F,)."""
        return self._each(
            lambda f, one: replace_columns(np.tile(one, 2), x_m=np.arange(2.0 * len(one))) if lists[f] else one
        )

    def shuffled(self, rng: np.random.Generator) -> SmallScene:
        """The scene with entries in another order, and tracks of units with other numbers."""
        new = rng.permuted(np.tile(np.arange(100), (len(self.units), 1)), axis=1)
        return self._each(
            lambda f, one: rng.permutation(replace_columns(one, track_id=new[self.unit_ix[f], one["track_id"]]))
        )

    def _each(self, change: Callable[[int, Entries], Entries]) -> SmallScene:
        return replace(self, said=tuple(tuple(change(f, one) for f, one in enumerate(run)) for run in self.said))


def replace_columns(entries: Entries, **columns: ArrayLike) -> Entries:
    """A copy with some columns replaced."""
    changed = entries.copy()
    for name, column in columns.items():
        changed[name] = column
    return changed


def make_small_scenes(seed: int) -> list[SmallScene]:
    """A scene of each kind in `_SCENES`."""
    return [_make_scene(np.random.default_rng((seed, number, 0)), *what) for number, what in enumerate(_SCENES)]


def _make_scene(
    rng: np.random.Generator, name: str, units: int, n: int, width_m: float, lists: int, late_s: float, p_lost: float
) -> SmallScene:
    """A scene of n objects in a square of `width_m`, listed by units with delays up to `late_s` and lost lists."""
    unit_ix = np.repeat(np.arange(units), lists)
    # Every other unit captures at the same instants.
    phase_s = np.where(np.arange(units) % 2 == 0, 0.0, rng.uniform(0.0, 0.1, units)) * (late_s > 0)
    captured_s = np.tile(np.arange(lists) * 0.1, units) + phase_s[unit_ix]
    # Several at one instant, also of one unit; of two units never quite: the units' order must not matter.
    arrives_s = np.ceil((captured_s + rng.uniform(0.0, late_s, len(unit_ix))) / 0.05) * 0.05 + 5e-8 * unit_ix
    arrives_s[rng.random(len(unit_ix)) < p_lost] = np.inf
    place_m, speed_mps = rng.uniform(0.0, width_m, (2, n)), rng.normal(0.0, 3.0, (2, n))
    class_shares = 0.8 * np.eye(len(CLASSES))[rng.integers(0, 4, n)] + 0.2 / len(CLASSES)

    def listed(f: int) -> Entries:
        entries = entries_of(n)
        entries["x_m"], entries["y_m"] = place_m + speed_mps * captured_s[f] + rng.normal(0.0, 0.5, (2, n))
        entries["vx_mps"], entries["vy_mps"] = speed_mps + rng.normal(0.0, 0.3, (2, n))
        entries["length_m"], entries["width_m"], entries["height_m"] = rng.uniform(1.0, 4.0, (3, n))
        entries["z_m"], entries["yaw_rad"] = entries["height_m"] / 2, np.arctan2(entries["vy_mps"], entries["vx_mps"])
        entries["cov_ee_m2"], entries["cov_nn_m2"] = rng.uniform(0.1, 0.5, (2, n))
        entries["cov_en_m2"] = rng.uniform(-0.5, 0.5, n) * np.sqrt(entries["cov_ee_m2"] * entries["cov_nn_m2"])
        entries["existence"], entries["track_id"] = rng.uniform(0.5, 1.0, n), np.arange(n)
        entries["class_probability"] = class_shares
        return rng.permutation(entries[rng.random(n) < 0.8])

    run_lists = tuple(tuple(listed(f) for f in range(len(unit_ix))) for _ in range(3))
    return SmallScene(name, tuple("ABCDEFGHIJKL"[:units]), unit_ix, captured_s, arrives_s, range(3), run_lists)


FUSION_RULES = {
    "answer": "there is a list of ENTRY for each run and instant, and its numbers can be used",
    "inputs": "what is handed over belongs to others, too: copy what you change",
    "again": "the same reports give the same lists, to the last bit: draw nothing, keep nothing but `memory`",
    "runs": "a run gives the same lists, to the last bit, whichever others stand beside it: nothing passes between",
    "causality": "what is issued depends on nothing that arrives later, and is not changed afterwards",
    "chunks": "where it is `resumable`: handed over in time chunks, with `looks_back_s`, instants get the same lists",
    "unheard": "a unit of which nothing arrives makes no difference",
    "order of entries": "entries are in no order that means anything, and each unit numbers its tracks as it likes",
    "order of units": "units are in no order that means anything; if yours are, say units_in_any_order=False",
    "silence": "something is listed in some scene, or nothing has been checked",
}
"""The rules of `check_fusion`."""

_TOLERANCE = 1e-9  # absolute or relative: in another order sums are rounded otherwise


class NonconformingError(AssertionError):
    """A component breaks one of the FUSION_RULES, `rule`: what was expected, what was found, in which scene and when.

    >>> cr.NonconformingError("again", "mine", "Scene 'crowd'", "x_m differs").rule
    'again'
    """

    def __init__(self, rule: str, kind: str, where: str, text: str) -> None:
        self.rule = rule
        super().__init__(f"{kind} breaks the rule {rule!r}: {FUSION_RULES[rule]}. {where}: {text}.")


@dataclass(frozen=True, repr=False)
class KeptRules:
    """What was checked of a fusion that keeps the rules; in a shell it says so in one sentence.

    `kind`: of the fusion. `scenes`: the names of the scenes. `asked`: how often, by rule; 0: not at all, as `resumable`
    or `units_in_any_order` is False. `seed`: of scenes and orders.
    """

    kind: str
    scenes: tuple[str, ...]
    asked: dict[str, int]
    seed: int

    def __repr__(self) -> str:
        rules = [f"{rule} ({times})" for rule, times in self.asked.items() if times]
        unasked = [rule for rule, times in self.asked.items() if not times]
        text = (
            f"{self.kind} keeps {len(rules)} rules in {len(self.scenes)} scenes of seed {self.seed}: {', '.join(rules)}"
        )
        return text + (f"; not asked: {', '.join(unasked)}" if unasked else "")


def check_fusion(fusion: ListFusion, *, seed: int = 0, units_in_any_order: bool = True) -> KeptRules:
    """Raise NonconformingError for the first broken rule; return what was checked where a fusion keeps FUSION_RULES.

    `seed`: of the scenes, and of the orders tried. `units_in_any_order`: whether the order of units must not matter.
    What is returned has the names of the `scenes`, and by rule how often it was `asked`.


    >>> class Silent(cr.StepFusion):
    ...     def step(self, now_s, inbox, memory):
    ...         return cr.entries_of(0), memory
    >>> cr.check_fusion(Silent(kind="my_package.fusions:Silent"))
    Traceback (most recent call last):
    copem_replay.fusion.testing.NonconformingError: my_package.fusions:Silent breaks the rule 'silence': ...
    """
    counts = dict.fromkeys(FUSION_RULES, 0)
    trials = [_FusionTrial(fusion, scene, counts) for scene in make_small_scenes(seed)]
    firsts = [trial.answer(trial.scene) for trial in trials]
    for number, (trial, first) in enumerate(zip(trials, firsts, strict=True)):
        scene, rng = trial.scene, np.random.default_rng((seed, number, 1))
        trial.same("again", first, scene, "asked again")
        for runs in ([0], [1], [2], [2, 1, 0]):
            trial.same("runs", first, scene.of_runs(runs), f"runs {runs}")
        issue_s = scene.inputs().issue_s
        for k in sorted({len(issue_s) * fifth // 5 for fifth in range(5)} if len(issue_s) else ()):
            later, after = scene.arrives_s > issue_s[k], f"what arrives after {issue_s[k]:.3f} s"
            trial.same("causality", first, scene.of_lists(np.flatnonzero(~later)), f"without {after}")
            trial.same("causality", first, scene.spoiled(later), f"{after} spoiled", until_s=issue_s[k])
        trial.same("unheard", first, scene.beside("unheard"), "and a unit that is not heard")
        trial.same("order of entries", first, scene.shuffled(rng), "entries shuffled and tracks renumbered")
        if fusion.resumable:
            trial.resumed(first, np.arange(len(issue_s)))
            trial.resumed(first, np.sort(np.random.default_rng((seed, number, 2)).integers(0, len(issue_s) + 1, 4)))
        if units_in_any_order:
            other = scene.of_units(rng.permutation(len(scene.units)))
            trial.same("order of units", first, other, f"units in the order {', '.join(other.units)}")
    counts["silence"] = len(firsts)
    if not any(len(first.entries) for first in firsts):
        raise NonconformingError("silence", fusion.kind, f"All scenes of seed {seed}", "expected entries, found none")
    return KeptRules(fusion.kind, tuple(trial.scene.name for trial in trials), counts, seed)


@dataclass(frozen=True)
class _FusionTrial:
    """A fusion in one scene. Its checks raise NonconformingError, and are counted by rule in `asked`."""

    fusion: ListFusion
    scene: SmallScene
    asked: dict[str, int]

    def broken(self, rule: str, scene: SmallScene, text: object, s: int = -1, now_s: float = 0.0) -> NonconformingError:
        when = f", run {scene.runs[s]}, instant {now_s:.3f} s" if s >= 0 else ""
        return NonconformingError(rule, self.fusion.kind, f"Scene {scene.name!r}{when}", str(text))

    def answer(self, scene: SmallScene) -> ObjectLists:
        """The lists that the fusion gives for a scene. Raises the trial's error where it fails or they are no lists."""
        self.asked["answer"] += 1
        self.asked["inputs"] += 1
        inputs = scene.inputs()
        bytes_before = _content_bytes(inputs)
        try:
            lists = self.fusion.fuse(inputs)
        except Exception as error:
            failed = _failed_step(self.fusion, scene.inputs()) if isinstance(self.fusion, StepFusion) else None
            failed = failed or (f"expected Lists, found {type(error).__name__}: {error}", -1, 0.0)
            raise self.broken("answer", scene, *failed) from error
        if changed := [name for name, now in _content_bytes(inputs).items() if now != bytes_before[name]]:
            raise self.broken("inputs", scene, f"expected reports as before, found {', '.join(changed)} changed")
        if wrong := form_problem(lists, inputs):
            raise self.broken("answer", scene, wrong)
        for s, k in np.ndindex(len(scene.said), len(inputs.issue_s)) if content_problem(lists, inputs) else ():
            single_list = ObjectLists(np.array([[0, len(lists.of(s, k))]]), lists.of(s, k))
            if wrong := content_problem(single_list, replace(inputs, issue_s=inputs.issue_s[k : k + 1])):
                raise self.broken("answer", scene, wrong, s, float(inputs.issue_s[k]))
        return lists

    def same(
        self, rule: str, first: ObjectLists, scene: SmallScene, variation: str, *, until_s: float = np.inf
    ) -> None:
        """Check that a variation of the scene gives the lists of `first`: as sets, or to the last bit."""
        scene = replace(scene, name=f"{scene.name}; {variation}")
        self.compare(rule, first, self.answer(scene), scene, until_s)

    def resumed(self, first: ObjectLists, cuts: Int) -> None:
        """Check that the scene's instants, cut at `cuts`, get the lists of `first`, to the last bit."""
        inputs, memory = self.scene.inputs(), None
        parts: list[ObjectLists] = []
        scene = replace(self.scene, name=f"{self.scene.name}; instants in time chunks")
        for a, b in pairwise([0, *cuts.tolist(), len(inputs.issue_s)]):
            chunk = cut_chunk(inputs, a, b, self.fusion.looks_back_s)
            try:
                answer = self.fusion.resume(chunk, memory)
            except Exception as error:
                said = f"expected ObjectLists and a memory of instants[{a}:{b}], found {type(error).__name__}: {error}"
                raise self.broken("chunks", scene, said) from error
            if wrong := pair_problem(answer) or form_problem(answer[0], chunk):
                raise self.broken("chunks", scene, wrong)
            lists, memory = answer
            parts.append(lists)
        self.compare("chunks", first, join_chunks(parts), scene, np.inf)

    def compare(self, rule: str, first: ObjectLists, answer: ObjectLists, scene: SmallScene, until_s: float) -> None:
        """Check that the lists `answer` of a scene are those of `first`: as sets, or (some rules) to the last bit."""
        self.asked[rule] += 1
        issue_s = scene.inputs().issue_s
        exact = rule in ("again", "runs", "chunks")
        unit_number = np.array([*map((*self.scene.units, *scene.units).index, scene.units), -1])
        for s, run in enumerate(scene.runs):
            track_map: dict[tuple[str, int], int] = {}
            for k, now_s in enumerate(issue_s[issue_s <= until_s].tolist()):
                expected, listed = first.of(run, k), answer.of(s, k)
                if exact and listed.tobytes() == expected.tobytes():
                    continue
                text = _describe_difference(
                    expected, replace_columns(listed, unit_ix=unit_number[listed["unit_ix"]]), track_map
                )
                if text is None and exact:
                    text = "expected the bytes of the scene itself, found another order, other track ids or last digits"
                if text is not None:
                    raise self.broken(rule, scene, text, s, now_s)


def _content_bytes(inputs: Inputs) -> dict[str, bytes]:
    columns = vars(inputs) | vars(inputs.lists)
    return {name: column.tobytes() for name, column in columns.items() if isinstance(column, np.ndarray)}


def _failed_step(fusion: StepFusion, inputs: Inputs) -> tuple[str, int, float] | None:
    """What a step gives instead of entries and memory, the run and the instant (s); None: no step fails."""
    memory = None
    for s, k in np.ndindex(len(inputs.lists.start), len(inputs.issue_s)):
        try:
            entries, memory = fusion.step(float(inputs.issue_s[k]), make_inbox(inputs, s, k), memory if k else None)
            outcome = f"{type(entries).__name__} of {np.asarray(entries).dtype.name}"
        except Exception as error:
            entries, outcome = None, f"{type(error).__name__}: {error}"
        if not isinstance(entries, np.ndarray) or entries.dtype != ENTRY:
            return f"expected entries of ENTRY and memory from step, found {outcome}", s, float(inputs.issue_s[k])
    return None


def _describe_difference(expected: Entries, actual: Entries, track_map: dict[tuple[str, int], int]) -> str | None:
    """How two lists differ as sets; None: not at all. Track ids may differ: `track_map` maps those seen so far."""
    if len(actual) != len(expected):
        return f"expected {len(expected)} entries as in the scene itself, found {len(actual)}"
    a, b = (
        entries[np.lexsort((entries["unit_ix"], entries["y_m"].round(6), entries["x_m"].round(6)))]
        for entries in (expected, actual)
    )
    for name in (*VALUES, *COVARIANCES, "existence", "class_probability", "captured_s", "unit_ix"):
        difference = wrap_angles(a[name] - b[name]) if name == "yaw_rad" else a[name] - b[name]
        if (other := np.abs(difference) > _TOLERANCE * np.maximum(1.0, np.abs(a[name]))).any():
            i = np.argmax(other)
            return f"{name}: expected {a[name].flat[i]:.12g} as in the scene itself, found {b[name].flat[i]:.12g}"
    for was, now in zip(a["track_id"].tolist(), b["track_id"].tolist(), strict=True):
        one_to_one = track_map.setdefault(("was", was), now) == now and track_map.setdefault(("now", now), was) == was
        if not one_to_one or (was < 0) != (now < 0):
            return f"track_id: expected what was {was} to be one track, and no other to be called so, found {now}"
    return None
