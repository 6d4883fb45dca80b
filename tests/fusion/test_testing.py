"""The conformance kit: our own fusions keep its rules, and each way to break one is found and named."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import pytest

from copem_replay.core.object_list import Entries, Inputs, ObjectLists, entries_of
from copem_replay.fusion.gnn import Gnn
from copem_replay.fusion.interface import Inbox, ListFusion, StepFusion
from copem_replay.fusion.nms import Nms
from copem_replay.fusion.testing import FUSION_RULES, NonconformingError, check_fusion
from copem_replay.fusion.tracker import Tracker
from copem_replay.fusion.union import Union

OURS = [
    Union(),
    Union(min_existence=0.7),
    Nms(),
    Nms(by="centre"),
    Gnn(),
    Gnn(combine="covariance_intersection"),
    Gnn(combine="covariance_intersection", minimise="determinant"),
    Gnn(combine="fast_covariance_intersection"),
    Gnn(combine="inverse_covariance_intersection"),
    Gnn(combine="split_covariance_intersection"),
    Gnn(combine="split_covariance_intersection", dependent_m2=0.1, minimise="determinant"),
    Gnn(combine="cross_covariance"),
    Gnn(combine="covariance_union", conflict_gate=0.9),
    Tracker(late="stale"),
    Tracker(late="predict"),
    Tracker(late="replay"),
    Tracker(late="stale", errors_last_s=0.5),
    Tracker(late="predict", errors_last_s=0.5, common_share=0.3),
    Tracker(late="replay", common_share=0.3),
]


@pytest.mark.parametrize("fusion", OURS, ids=lambda fusion: "-".join(map(str, fusion.model_dump().values())))
def test_ours_keep_the_rules(fusion: ListFusion) -> None:
    check_fusion(fusion)


# ------------------------------------------------------------------------------------------- one that keeps them all


class Plain(StepFusion):
    """Every unit's newest list side by side, in an order of their own; the others break it in one way each."""

    kind: str = "tests.fusion.test_testing:Plain"

    def step(self, now_s: float, inbox: Inbox, memory: Any) -> tuple[Entries, Any]:
        entries = np.concatenate([entries_of(0), *(one.entries for one in inbox.newest)])
        entries["track_id"] = -1
        return self.changed(np.sort(entries, order=["x_m", "y_m"]), now_s), memory

    def changed(self, entries: Entries, now_s: float) -> Entries:
        return entries


class Counts(StepFusion):
    """Remembers how many lists have arrived, and changes what it was handed: it is its own."""

    kind: str = "tests.fusion.test_testing:Counts"

    def step(self, now_s: float, inbox: Inbox, memory: Any) -> tuple[Entries, Any]:
        memory = memory or {"count": 0}
        memory["count"] += len(inbox.arrived)
        for one in (*inbox.newest, *inbox.arrived):
            one.entries["x_m"] = math.nan
        entries = entries_of(1)
        entries["cov_ee_m2"] = entries["cov_nn_m2"] = 1.0
        entries["x_m"], entries["track_id"] = memory["count"], 0
        entries["captured_s"] = inbox.arrived[-1].captured_s
        return entries, memory


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("fusion", [Plain(), Counts()], ids=["plain", "counts"])
def test_one_that_keeps_the_rules_passes(fusion: ListFusion, seed: int) -> None:
    check_fusion(fusion, seed=seed)


def test_it_says_what_it_has_checked() -> None:
    """Nine scenes: each once more, in four choices of runs, with a unit unheard, entries and units in another order."""
    kept = check_fusion(Plain(), seed=3)
    assert kept.kind == Plain().kind
    assert len(kept.scenes) == 9
    assert kept.scenes[0] == "one object and one unit"
    assert list(kept.asked) == list(FUSION_RULES)
    each = {"again": 9, "runs": 36, "chunks": 18} | dict.fromkeys(
        ("unheard", "order of entries", "order of units", "silence"), 9
    )
    assert {rule: kept.asked[rule] for rule in each} == each
    # each scene itself and each variation is answered; chunks are resumed, which is no answer of its own
    varied = sum(each.values()) - each["silence"] - each["chunks"] + kept.asked["causality"]
    assert kept.asked["answer"] == kept.asked["inputs"] == 9 + varied
    assert kept.asked["causality"] > 0
    said = repr(check_fusion(FirstUnitLeads(), units_in_any_order=False))
    assert said.startswith(f"{FirstUnitLeads().kind} keeps 9 rules in 9 scenes of seed 0: answer (")
    assert said.endswith("; not asked: order of units")


# ---------------------------------------------------------------------------------------------- numbers that are wrong


class NotANumber(Plain):
    def changed(self, entries: Entries, now_s: float) -> Entries:
        entries["vx_mps"][3:] = math.nan
        return entries


class TooSure(Plain):
    def changed(self, entries: Entries, now_s: float) -> Entries:
        entries["existence"] *= 2
        return entries


class NotDefinite(Plain):
    def changed(self, entries: Entries, now_s: float) -> Entries:
        entries["cov_en_m2"] = 1.01 * np.sqrt(entries["cov_ee_m2"] * entries["cov_nn_m2"])
        return entries


class NumbersOfUnitsMixed(Plain):
    """Hands on what units call their tracks: two units' track 3 look like one."""

    def step(self, now_s: float, inbox: Inbox, memory: Any) -> tuple[Entries, Any]:
        return np.concatenate([entries_of(0), *(one.entries for one in inbox.newest)]), memory


class FromTheFuture(Plain):
    def changed(self, entries: Entries, now_s: float) -> Entries:
        entries["captured_s"] = now_s + 0.1
        return entries


class NoSuchUnit(Plain):
    def changed(self, entries: Entries, now_s: float) -> Entries:
        entries["unit_ix"] = 99
        return entries


class PlainNumbers(Plain):
    def changed(self, entries: Entries, now_s: float) -> Entries:
        return np.column_stack([entries["x_m"], entries["y_m"]])


class OnlyEntries(Plain):
    def step(self, now_s: float, inbox: Inbox, memory: Any) -> Any:
        return super().step(now_s, inbox, memory)[0]


class Crashes(Plain):
    def changed(self, entries: Entries, now_s: float) -> Entries:
        entries["x"] = 0.0
        return entries


class NothingForNothing(Plain):
    """Forgets that there may be nothing to list."""

    def changed(self, entries: Entries, now_s: float) -> Entries:
        entries["existence"] /= entries["existence"].max()
        return entries


class NoLists(ListFusion):
    kind: str = "tests.fusion.test_testing:NoLists"

    def fuse(self, inputs: Inputs) -> Any:
        return [[entries_of(0) for _ in inputs.issue_s] for _ in inputs.lists.start]


class OfUnits(ListFusion):
    """Gives what it was given."""

    kind: str = "tests.fusion.test_testing:OfUnits"

    def fuse(self, inputs: Inputs) -> ObjectLists:
        return inputs.lists


class Overlapping(ListFusion):
    """Every run's lists begin at 0."""

    kind: str = "tests.fusion.test_testing:Overlapping"

    def fuse(self, inputs: Inputs) -> ObjectLists:
        fused = Union().fuse(inputs)
        return ObjectLists(fused.start - fused.start[:, :1], fused.entries)


WRONG = [
    (NotANumber, r"'two units at the same instants', run 0, instant 0\.\d{3} s: vx_mps: .*found NaN or infinity"),
    (TooSure, r"'one object and one unit', run 0, instant 0\.\d{3} s: existence: expected probabilities, found 1\."),
    (NotDefinite, r"run 0, instant 0\.\d{3} s: cov_\*_m2: expected positive definite covariances"),
    (FromTheFuture, r"instant 0\.000 s: captured_s: expected the capture of a list that has arrived, found 0\.1 s"),
    (NumbersOfUnitsMixed, "track_id: expected each once in a list, found one twice"),
    (NoSuchUnit, r"instant 0\.\d{3} s: unit_ix: expected −1 … 0, found 99 … 99"),
    (PlainNumbers, r"run 0, instant 0\.000 s: expected entries of ENTRY and memory from step, .* ndarray of float64"),
    (OnlyEntries, r"run 0, instant 0\.\d{3} s: expected entries of ENTRY and memory from step, found ValueError"),
    (Crashes, r"run 0, instant 0\.000 s: expected entries of ENTRY and memory from step, found ValueError: .* x"),
    (NothingForNothing, r"instant 0\.\d{3} s: .*found ValueError: zero-size array"),
    (NoLists, r"'one object and one unit': fuse: expected Lists, found list"),
    (OfUnits, r"'.*': fuse: expected lists of ENTRY with start \(3, 11\), found .* with start \(3, 21\)"),
    (Overlapping, r"'one object and one unit': expected start of whole numbers from 0 to \d+, .*, found \[\[0, "),
]


@pytest.mark.parametrize(("fusion", "said"), WRONG, ids=[fusion.__name__ for fusion, _ in WRONG])
def test_a_wrong_answer_is_found_and_placed(fusion: type[ListFusion], said: str) -> None:
    broken(fusion(kind=f"tests.fusion.test_testing:{fusion.__name__}"), "answer", said)


def broken(fusion: ListFusion, rule: str, said: str, **options: Any) -> None:
    """It breaks this rule, and what is said of it is one paragraph."""
    with pytest.raises(NonconformingError, match=said) as caught:
        check_fusion(fusion, **options)
    assert caught.value.rule == rule
    assert str(caught.value).startswith(f"{fusion.kind} breaks the rule {rule!r}: {FUSION_RULES[rule]}. ")
    assert "\n" not in str(caught.value)


# ------------------------------------------------------------------------------------------------ rules broken


class Altered(ListFusion):
    """Union, altered."""

    kind: str = "tests.fusion.test_testing:Altered"

    def fuse(self, inputs: Inputs) -> ObjectLists:
        fused = Union().fuse(inputs)
        self.alter(fused.entries, inputs)
        return fused

    def alter(self, entries: Entries, inputs: Inputs) -> None:
        raise NotImplementedError


class ChangesEntries(Altered):
    def alter(self, entries: Entries, inputs: Inputs) -> None:
        inputs.lists.entries["yaw_rad"] = 0.0


class ChangesWhatIsNewest(Altered):
    def alter(self, entries: Entries, inputs: Inputs) -> None:
        inputs.newest[:, 0] = -1


class Draws(Altered):
    def alter(self, entries: Entries, inputs: Inputs) -> None:
        entries["x_m"] += np.random.default_rng().normal(0.0, 1e-12, len(entries))


class CountsOnAndOn(Altered):
    """One counter of tracks for all that is ever asked."""

    count: ClassVar[Iterator[int]] = itertools.count()

    def alter(self, entries: Entries, inputs: Inputs) -> None:
        entries["track_id"] = [next(self.count) for _ in entries]


class DrawsInTurn(Altered):
    """The same numbers every time, but who gets which depends on the runs before."""

    def alter(self, entries: Entries, inputs: Inputs) -> None:
        entries["x_m"] += np.random.default_rng(1).normal(0.0, 1.0, len(entries))


class MeanOfRuns(Altered):
    def alter(self, entries: Entries, inputs: Inputs) -> None:
        entries["z_m"] -= entries["z_m"].sum() / max(len(entries), 1)


class OneInstantEarly(ListFusion):
    kind: str = "tests.fusion.test_testing:OneInstantEarly"

    def fuse(self, inputs: Inputs) -> ObjectLists:
        early = Gnn().fuse(replace(inputs, newest=np.concatenate([inputs.newest[1:], inputs.newest[-1:]])))
        early.entries["captured_s"] = inputs.captured_s[inputs.arrived[:1]]
        return early


class SureOfWhatEnds(Altered):
    """The longer the recording, the surer from its beginning."""

    def alter(self, entries: Entries, inputs: Inputs) -> None:
        entries["existence"] = 1 - 1 / (2 + len(inputs.arrived))


class ByWhatIsLost(Altered):
    """Goes by what is in lists that never arrive."""

    def alter(self, entries: Entries, inputs: Inputs) -> None:
        lost = np.isinf(inputs.arrives_s)
        lengths = np.diff(inputs.lists.start, axis=1)[:, lost]
        entries["z_m"] = (lengths > 6).any()


class AfterTheFact(StepFusion):
    """Improves upon a list it has issued already."""

    kind: str = "tests.fusion.test_testing:AfterTheFact"

    def step(self, now_s: float, inbox: Inbox, memory: Any) -> tuple[Entries, Any]:
        entries, _ = Plain().step(now_s, inbox, None)
        if memory is not None and len(memory) == len(entries):
            memory["x_m"] = (memory["x_m"] + entries["x_m"]) / 2
        return entries, entries


class ShareOfUnits(Altered):
    """A share of all units of the experiment, heard or not."""

    def alter(self, entries: Entries, inputs: Inputs) -> None:
        entries["existence"] /= len(inputs.units)


class FirstOfEachList(Plain):
    def step(self, now_s: float, inbox: Inbox, memory: Any) -> tuple[Entries, Any]:
        entries = np.concatenate([entries_of(0), *(one.entries[:1] for one in inbox.newest)])
        entries["track_id"] = -1
        return entries, memory


class ByTheUnitsNumbers(Plain):
    """One object where units use the same number."""

    def step(self, now_s: float, inbox: Inbox, memory: Any) -> tuple[Entries, Any]:
        entries = np.concatenate([entries_of(0), *(one.entries for one in inbox.newest)])
        return entries[np.unique(entries["track_id"], return_index=True)[1]], memory


class FirstUnitLeads(StepFusion):
    """Of entries within 2 m the first unit's stays."""

    kind: str = "tests.fusion.test_testing:FirstUnitLeads"

    def step(self, now_s: float, inbox: Inbox, memory: Any) -> tuple[Entries, Any]:
        kept = entries_of(0)
        for one in inbox.newest:
            far = [(np.hypot(kept["x_m"] - e["x_m"], kept["y_m"] - e["y_m"]) > 2.0).all() for e in one.entries]
            kept = np.concatenate([kept, np.sort(one.entries[np.array(far, dtype=bool)], order=["x_m"])])
        kept["track_id"] = -1
        return kept, memory


class Silent(Plain):
    def changed(self, entries: Entries, now_s: float) -> Entries:
        return entries[:0]


class ByTheOneBefore(ListFusion):
    """Goes by the first list of each unit, which a later time chunk has not."""

    kind: str = "tests.fusion.test_testing:ByTheOneBefore"
    resumable: ClassVar[bool] = True

    def fuse(self, inputs: Inputs) -> ObjectLists:
        fused = Plain().fuse(inputs)
        for s, k in np.ndindex(len(fused.start), len(inputs.issue_s)):
            came = inputs.arrived[: inputs.arrived_start[k + 1]]
            first = came[inputs.captured_s[came] == inputs.captured_s[came].min()]
            fused.of(s, k)["z_m"] = sum(len(inputs.lists.of(s, f)) for f in first)
        return fused


class ForgetsOverACut(Plain):
    """Its memory does not survive."""

    def step(self, now_s: float, inbox: Inbox, memory: Any) -> tuple[Entries, Any]:
        entries, _ = super().step(now_s, inbox, None)
        memory = (memory or 0) + 1
        entries["z_m"] = memory
        return entries, memory

    def resume(self, inputs: Inputs, memory: Any) -> tuple[ObjectLists, Any]:
        return super().resume(inputs, None)[0], None


class OnlyLists(Plain):
    """Gives no memory where one is asked for."""

    def fuse(self, inputs: Inputs) -> ObjectLists:
        return Plain().fuse(inputs)

    resumable: ClassVar[bool] = True

    def resume(self, inputs: Inputs, memory: Any) -> Any:
        return self.fuse(inputs)


class FailsLater(OnlyLists):
    def resume(self, inputs: Inputs, memory: Any) -> Any:
        return self.fuse(inputs), 1 / len(inputs.issue_s)


BROKEN = [
    (ChangesEntries, "inputs", "expected reports as before, found entries changed"),
    (ChangesWhatIsNewest, "inputs", "expected reports as before, found newest changed"),
    (
        Draws,
        "again",
        "one unit; asked again', run 0, instant .* s: expected the bytes of the scene itself, found .* last digits",
    ),
    (
        CountsOnAndOn,
        "again",
        "asked again', run 0, instant .* s: expected the bytes of the scene itself, found .* other track ids",
    ),
    (DrawsInTurn, "runs", r"one unit; runs \[1\]', run 1, instant .* s: x_m: expected .*, found "),
    (MeanOfRuns, "runs", r"one unit; runs \[0\]', run 0, instant .* s: z_m: expected .*, found "),
    (OneInstantEarly, "causality", r"without what arrives after (.*) s', run 0, instant \1 s: x_m: expected "),
    (SureOfWhatEnds, "causality", "without what arrives after 0.* s', run 0, instant 0.* s: existence: expected "),
    (ByWhatIsLost, "causality", "what arrives after .* s spoiled', run 0, instant .* s: z_m: expected 0 .*, found 1"),
    (AfterTheFact, "causality", r"without what arrives after (.*) s', run 0, instant \1 s: x_m: expected "),
    (ForgetsOverACut, "chunks", "one unit; instants in time chunks', run 0, instant .* s: z_m: expected 2 .* found 1"),
    (ByTheOneBefore, "chunks", "'.*; instants in time chunks', run 0, instant .* s: z_m: expected .*, found "),
    (OnlyLists, "chunks", "in time chunks': resume: expected ObjectLists and a memory, found ObjectLists"),
    (FailsLater, "chunks", r"expected ObjectLists and a memory of instants\[0:0\], found ZeroDivisionError: "),
    (ShareOfUnits, "unheard", "one unit; and a unit that is not heard', run 0, instant .* s: existence: expected "),
    (FirstOfEachList, "order of entries", "entries shuffled and tracks renumbered', run 0, instant .*: expected "),
    (ByTheUnitsNumbers, "order of entries", "renumbered', run 0, instant .*: expected . entries .*, found "),
    (FirstUnitLeads, "order of units", "'.*; units in the order B, A', run .*, instant .*: x_m: expected "),
    (Silent, "silence", "All scenes of seed 0: expected entries, found none"),
]


@pytest.mark.parametrize(("fusion", "rule", "said"), BROKEN, ids=[fusion.__name__ for fusion, _, _ in BROKEN])
def test_a_broken_rule_is_named_and_placed(fusion: type[ListFusion], rule: str, said: str) -> None:
    broken(fusion(kind=f"tests.fusion.test_testing:{fusion.__name__}"), rule, said)


def test_every_rule_has_been_broken() -> None:
    assert {rule for _, rule, _ in BROKEN} == FUSION_RULES.keys() - {"answer"}


def test_the_order_of_units_may_matter_where_it_is_said_to() -> None:
    check_fusion(FirstUnitLeads(), units_in_any_order=False)


def test_it_is_found_with_other_seeds_too() -> None:
    for seed in (1, 2):
        broken(OneInstantEarly(), "causality", "expected", seed=seed)
        broken(FirstUnitLeads(), "order of units", "expected", seed=seed)


def test_all_is_said_in_one_paragraph_of_an_assertion() -> None:
    # Of 12 lists in all, and of the one that has arrived: 1 − 1/14 and 1 − 1/3.
    with pytest.raises(AssertionError) as caught:
        check_fusion(SureOfWhatEnds(kind="mine:Mine"))
    assert str(caught.value) == (
        "mine:Mine breaks the rule 'causality': what is issued depends on nothing that arrives later, and is not "
        "changed afterwards. Scene 'one object and one unit; without what arrives after 0.000 s', run 0, instant "
        "0.000 s: existence: expected 0.928571428571 as in the scene itself, found 0.666666666667."
    )


class Keeps(Union):
    """All it has been told."""

    told: ClassVar[list[Inputs]] = []

    def fuse(self, inputs: Inputs) -> ObjectLists:
        self.told.append(inputs)
        return super().fuse(inputs)


def test_the_scenes_hold_what_is_promised() -> None:
    check_fusion(Keeps())
    told = Keeps.told
    assert any(len(one.captured_s) == 0 for one in told), "no lists at all"
    assert any(len(one.captured_s) > 0 and len(one.issue_s) == 0 for one in told), "lists that never arrive"
    assert any(0 < np.isinf(one.arrives_s).sum() < len(one.arrives_s) for one in told), "lists that are lost"
    assert any(len(one.issue_s) > 0 and len(one.lists.entries) == 0 for one in told), "empty lists"
    assert {1, 2, 12} <= {len(one.units) for one in told}
    late = together = of_one = False
    for one in told:
        at = [one.arrived[a:b] for a, b in itertools.pairwise(one.arrived_start)]
        together |= any(len(set(one.unit_ix[came])) > 1 for came in at)
        of_one |= any(len(set(one.unit_ix[came])) < len(came) for came in at)
        for u in range(len(one.units)):
            late |= bool((np.diff(one.captured_s[[f for f in one.arrived if one.unit_ix[f] == u]]) < 0).any())
    assert together, "lists of several units at one instant"
    assert of_one, "several lists of one unit at one instant"
    assert late, "lists that newer ones have overtaken"
