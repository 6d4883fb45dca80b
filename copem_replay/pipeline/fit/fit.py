"""A perception error model of a recorded unit: gathered, fitted, held against another gate."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

import numpy as np

from copem_replay.core.errors import InputError
from copem_replay.core.text import counted
from copem_replay.experiment.schema import Experiment
from copem_replay.io.recording import Recording
from copem_replay.pipeline.fit.delay import Delay, unit_delay
from copem_replay.pipeline.fit.detection import DetectionFit, fit_detection
from copem_replay.pipeline.fit.errors import ErrorFit, fit_errors, without_pose
from copem_replay.pipeline.fit.estimate import Estimate
from copem_replay.pipeline.fit.gather import LONGEST_S, Gathered, NothingMatchedError, gather
from copem_replay.pipeline.fit.log_view import LogView, check_unit, log_view, raw_lists
from copem_replay.pipeline.fit.named import moved_by
from copem_replay.pipeline.fit.replay_check import Check
from copem_replay.pipeline.fit.rest import RestFit, fit_rest
from copem_replay.pipeline.fit.rows import FitLists

Truth = Literal["partial", "complete"]
BY = ("range", "visible_share")
SURE = 0.05
"""A replay check fails below this p, over the number of statistics (chosen)."""
_GATES = (0.75, 1.25)
"""The same again with gates so much as wide."""


@dataclass(frozen=True)
class How:
    """How a unit is fitted. `truth` None: partial where a list has more entries about nothing true than objects."""

    hold_out: tuple[str, ...] = ()
    folds: int | None = None
    truth: Truth | None = None
    by: tuple[str, ...] = BY
    monotone: bool = True
    simplest: bool = False
    other_gates: bool = True


@dataclass(frozen=True)
class Parts:
    """What is estimated from rows, lists and entries."""

    detection: DetectionFit
    errors: ErrorFit
    rest: RestFit


@dataclass(frozen=True)
class ReplayChecks:
    """What was recorded among runs of the fitted model, and among runs of it without memory (none: it has none).

    `held_out`: on logs that the model has not seen; else on those it was fitted to.
    """

    held_out: bool
    fitted: tuple[Check, ...]
    memoryless: tuple[Check, ...]

    @property
    def fails(self) -> bool:
        """Whether anything recorded is too often outside of what the model gives; over all statistics (Bonferroni)."""
        return any(one.verdict == "too sure" and one.p * len(self.fitted) < SURE for one in self.fitted)

    def lines(self) -> Iterator[str]:
        """A line per statistic."""
        fresh = {one.statistic: one for one in self.memoryless}
        where = "logs held out" if self.held_out else "the logs it was fitted to"
        for one in self.fitted:
            said = f"replay check on {where}, {one.statistic}: {_verdict(one)}"
            beside = fresh.get(one.statistic)
            yield said if beside is None else f"{said}; without memory: {_verdict(beside)}"


def _verdict(one: Check) -> str:
    return f"{one.verdict} ({one.inside} of {counted(len(one.pit), 'pass', 'passes')} inside 95 %, p {one.p:.2g})"


@dataclass(frozen=True)
class Fit:
    """A fitted unit. `logs`: the names of the logs it is from, `held_out`: of those that it has not seen."""

    unit: str
    logs: tuple[str, ...]
    held_out: tuple[str, ...]
    how: How
    truth: Truth
    delay: Delay
    rate_hz: Estimate
    parts: Parts
    gathered: Gathered
    held: Gathered | None  # the same of logs that are held out, within the same reach
    gates: tuple[str, ...]  # estimates that another gate moves
    notes: tuple[str, ...]
    checks: ReplayChecks | None = None

    @property
    def said(self) -> tuple[str, ...]:
        """All that has to be said of it."""
        more = [f"detection: {line}" for line in self.parts.detection.notes]
        more += [f"no memory of detection: {why}" for why in (self.parts.detection.memory_why,) if why is not None]
        more += [f"another gate: {line}" for line in self.gates]
        return (*self.notes, *more)


def fit(experiment: Experiment, recordings: Sequence[Recording], unit: str, how: How | None = None) -> Fit:
    """Fit the recorded `unit` of an experiment over its logs.

    Raises InputError: no such unit or log, no place, nothing of it near a true object.
    """
    how = how or How()
    check_unit(experiment, unit)
    mine, held_out = _held_out(recordings, how)
    lists = raw_lists(mine, experiment, unit)
    declared_s = _declared_s(experiment, unit)
    delay = unit_delay(list(zip(mine, lists, strict=True)), declared_s)
    views = _views(mine, experiment, unit, delay.seconds)
    gate_m, max_gap_s = experiment.measure.match.gate_m, experiment.max_gap_s
    try:
        gathered = gather(views, gate_m=gate_m, max_gap_s=max_gap_s, folds=how.folds, name=unit)
    except NothingMatchedError:
        _at_another_delay(mine, experiment, unit)
        raise
    truth: Truth = how.truth or ("partial" if gathered.crowded else "complete")
    parts = _parts(gathered, truth, how)
    other = {
        share * gate_m: _parts(
            gather(views, gate_m=share * gate_m, max_gap_s=max_gap_s, reach=gathered.reach, folds=how.folds),
            truth, how,
        )
        for share in (_GATES if how.other_gates else ())
    }  # fmt: skip
    held = None
    if held_out:
        theirs = _views(held_out, experiment, unit, delay.seconds)
        held = gather(theirs, gate_m=gate_m, max_gap_s=max_gap_s, reach=gathered.reach)
    return Fit(
        unit, tuple(r.scene.log for r in mine), tuple(r.scene.log for r in held_out), how, truth, delay,
        rate_of(gathered.lists), parts, gathered, held, tuple(moved_by(parts, other)),
        (*delay.notes, *_notes(gathered, truth, how)),
    )  # fmt: skip


def _views(recordings: Sequence[Recording], experiment: Experiment, unit: str, delay_s: float) -> list[LogView]:
    lists = raw_lists(recordings, experiment, unit)
    return [log_view(one, found, experiment, unit, delay_s) for one, found in zip(recordings, lists, strict=True)]


def _at_another_delay(recordings: Sequence[Recording], experiment: Experiment, unit: str) -> None:
    """Raises InputError where entries are near true objects, if lists are later than they are taken to be."""
    for delay_s in np.arange(0.0, LONGEST_S + 0.01, 0.05).round(2).tolist():
        views = _views(recordings, experiment, unit, delay_s)
        with suppress(NothingMatchedError):
            gather(views, gate_m=experiment.measure.match.gate_m, max_gap_s=experiment.max_gap_s)
            raise InputError(
                f"unit {unit}: its entries are near true objects if its lists are {delay_s:g} s late, which cannot be "
                f"told from them alone; if they are, say `delay_s: {delay_s:g}`"
            )


def _parts(gathered: Gathered, truth: Truth, how: How) -> Parts:
    rows, lists = gathered.rows, gathered.lists
    rest = fit_rest(rows, lists, gathered.other, truth=truth)
    return Parts(
        fit_detection(rows, lists, monotone=how.monotone, by=how.by, simplest=how.simplest),
        without_pose(fit_errors(rows, lists, simplest=how.simplest), rest.placed),
        rest,
    )


def _held_out(recordings: Sequence[Recording], how: How) -> tuple[list[Recording], list[Recording]]:
    """The logs that are fitted, and those that are held out."""
    names = [recording.scene.log for recording in recordings]
    for name in how.hold_out:
        if name not in names:
            raise InputError(f"--hold-out {name}: expected a log of the experiment ({', '.join(names)})")
    mine = [one for one in recordings if one.scene.log not in how.hold_out]
    if not mine:
        raise InputError("--hold-out: expected a log that is left to fit, found all held out")
    return mine, [one for one in recordings if one.scene.log in how.hold_out]


def _declared_s(experiment: Experiment, unit: str) -> float | None:
    """The delay that the experiment says; None: it says none."""
    recorded = experiment.units[unit].recorded
    return recorded.delay_s if recorded is not None and "delay_s" in recorded.model_fields_set else None


def rate_of(lists: FitLists) -> Estimate:
    """Lists per second: of the median time between two."""
    step_s = np.diff(lists.captured_s)[np.diff(lists.log) == 0]
    step_s = step_s[step_s > 0]
    if not len(step_s):
        return Estimate(1.0, why="one list alone has no rate")
    low, middle, high = np.quantile(step_s, [0.025, 0.5, 0.975])
    return Estimate(1 / float(middle), 1 / float(high), 1 / float(low), len(step_s), float("nan"))


def _notes(gathered: Gathered, truth: Truth, how: How) -> list[str]:
    """What has to be said of matches, truth and folds."""
    lists, other = gathered.lists, gathered.other
    notes = [f"{gathered.beyond:.1%} of the matches are farther apart than 0.8 of the gate", *gathered.notes]
    if truth == "partial":
        why = "" if how.truth else ", as a list has more of them than true objects within reach"
        notes.append(
            f"{len(other.list)} of {counted(int(lists.entries.sum()), 'entry', 'entries')} are about no true object; "
            f"they are taken for other traffic{why}: no ghosts are fitted (--truth complete, if the truth has all)"
        )
    if len(np.unique(gathered.rows.fold)) < 2:
        notes.append(f"{counted(gathered.number_of_passes, 'pass', 'passes')}: none is held out to choose a model")
    return notes
