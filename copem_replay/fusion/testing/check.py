"""Checks of your own fusions, for your tests.

    def test_mine():
        check_fusion(Mine(kind="mine:Mine", radius_m=2.0))

The scenes are small and made here: objects in a crowd, lists that come late, out of order, empty or never, one unit or
many. They do not ask how good a fusion is: that is what an experiment is for.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from copem_replay.core.interpolation import wrap
from copem_replay.core.object_list import COVARIANCES, ENTRY, Entries, Inputs, ObjectLists
from copem_replay.core.tracks import VALUES, Int
from copem_replay.fusion.base import ListFusion, StepFusion, content_problem, form_problem, inbox_at, pair_problem
from copem_replay.fusion.testing.chunks import chunk, one_after_another
from copem_replay.fusion.testing.scenes import SmallScene, small_scenes, with_columns

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

    def __init__(self, rule: str, kind: str, where: str, said: str) -> None:
        self.rule = rule
        super().__init__(f"{kind} breaks the rule {rule!r}: {FUSION_RULES[rule]}. {where}: {said}.")


def check_fusion(fusion: ListFusion, *, seed: int = 0, units_in_any_order: bool = True) -> None:
    """Raise NonconformingError for the first broken rule; return nothing where a fusion keeps all FUSION_RULES.

    `seed`: of the scenes, and of the orders tried. `units_in_any_order`: whether the order of units must not matter.

    >>> class Silent(cr.StepFusion):
    ...     def step(self, now_s, inbox, memory):
    ...         return cr.entries_of(0), memory
    >>> cr.check_fusion(Silent(kind="my_package.fusions:Silent"))
    Traceback (most recent call last):
    copem_replay.fusion.testing.check.NonconformingError: my_package.fusions:Silent breaks the rule 'silence': ...
    """
    trials = [_Trial(fusion, scene) for scene in small_scenes(seed)]
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
    if not any(len(first.entries) for first in firsts):
        raise NonconformingError("silence", fusion.kind, f"All scenes of seed {seed}", "expected entries, found none")


@dataclass(frozen=True)
class _Trial:
    fusion: ListFusion
    scene: SmallScene

    def broken(self, rule: str, scene: SmallScene, said: object, s: int = -1, now_s: float = 0.0) -> NonconformingError:
        when = f", run {scene.runs[s]}, instant {now_s:.3f} s" if s >= 0 else ""
        return NonconformingError(rule, self.fusion.kind, f"Scene {scene.name!r}{when}", str(said))

    def answer(self, scene: SmallScene) -> ObjectLists:
        """What the fusion gives of a scene, checked."""
        told = scene.inputs()
        before = _contents(told)
        try:
            found = self.fusion.fuse(told)
        except Exception as error:
            failed = _failed_step(self.fusion, scene.inputs()) if isinstance(self.fusion, StepFusion) else None
            failed = failed or (f"expected Lists, found {type(error).__name__}: {error}", -1, 0.0)
            raise self.broken("answer", scene, *failed) from error
        if changed := [name for name, now in _contents(told).items() if now != before[name]]:
            raise self.broken("inputs", scene, f"expected reports as before, found {', '.join(changed)} changed")
        if wrong := form_problem(found, told):
            raise self.broken("answer", scene, wrong)
        for s, k in np.ndindex(len(scene.said), len(told.issue_s)) if content_problem(found, told) else ():
            one = ObjectLists(np.array([[0, len(found.of(s, k))]]), found.of(s, k))
            if wrong := content_problem(one, replace(told, lists=one, issue_s=told.issue_s[k : k + 1])):
                raise self.broken("answer", scene, wrong, s, float(told.issue_s[k]))
        return found

    def same(
        self, rule: str, first: ObjectLists, scene: SmallScene, variation: str, *, until_s: float = np.inf
    ) -> None:
        """Whether a variation of the scene gives the lists of `first`: as sets, or to the last bit."""
        scene = replace(scene, name=f"{scene.name}; {variation}")
        self.compare(rule, first, self.answer(scene), scene, until_s)

    def resumed(self, first: ObjectLists, cuts: Int) -> None:
        """Whether the scene's instants, cut at these places, get the lists of `first`, to the last bit."""
        told, memory = self.scene.inputs(), None
        parts: list[ObjectLists] = []
        scene = replace(self.scene, name=f"{self.scene.name}; instants in time chunks")
        for a, b in pairwise([0, *cuts.tolist(), len(told.issue_s)]):
            one = chunk(told, a, b, self.fusion.looks_back_s)
            try:
                given = self.fusion.resume(one, memory)
            except Exception as error:
                said = f"expected ObjectLists and a memory of instants[{a}:{b}], found {type(error).__name__}: {error}"
                raise self.broken("chunks", scene, said) from error
            if wrong := pair_problem(given) or form_problem(given[0], one):
                raise self.broken("chunks", scene, wrong)
            found, memory = given
            parts.append(found)
        self.compare("chunks", first, one_after_another(parts), scene, np.inf)

    def compare(self, rule: str, first: ObjectLists, found: ObjectLists, scene: SmallScene, until_s: float) -> None:
        """Whether the lists found of a scene are those of `first`: as sets, or to the last bit."""
        issue_s = scene.inputs().issue_s
        exact = rule in ("again", "runs", "chunks")
        unit_number = np.array([*map((*self.scene.units, *scene.units).index, scene.units), -1])
        for s, run in enumerate(scene.runs):
            called: dict[tuple[str, int], int] = {}
            for k, now_s in enumerate(issue_s[issue_s <= until_s].tolist()):
                expected, one = first.of(run, k), found.of(s, k)
                if exact and one.tobytes() == expected.tobytes():
                    continue
                said = _difference(expected, with_columns(one, unit_ix=unit_number[one["unit_ix"]]), called)
                if said is None and exact:
                    said = "expected the bytes of the scene itself, found another order, other track ids or last digits"
                if said is not None:
                    raise self.broken(rule, scene, said, s, now_s)


def _contents(told: Inputs) -> dict[str, bytes]:
    columns = vars(told) | vars(told.lists)
    return {name: column.tobytes() for name, column in columns.items() if isinstance(column, np.ndarray)}


def _failed_step(fusion: StepFusion, told: Inputs) -> tuple[str, int, float] | None:
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
