"""Fit: a perception error model of a recorded unit, from its lists to the keys of an experiment.

The lists are gathered and matched, the parts are fitted, and all is fitted again with narrower and wider gates, to note
the estimates that depend on the gate. The result replays beside what was recorded, in an experiment of its own.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, Literal

import numpy as np

from copem_replay.core.errors import InputError, count_noun
from copem_replay.core.tracks import CLASSES
from copem_replay.core.yaml import CommentedValue, strip_comments
from copem_replay.experiment.schema import Experiment
from copem_replay.extras.fitting.detection import BY, DetectionCouple, DetectionFit, fit_detection, pass_starts
from copem_replay.extras.fitting.errors import ErrorFit, fit_errors, remove_pose
from copem_replay.extras.fitting.estimate import PER_ROW, Estimate, round_digits
from copem_replay.extras.fitting.gather import (
    LONGEST_S,
    Gathered,
    LogView,
    NothingMatchedError,
    check_unit,
    gather_rows,
    raw_lists,
    view_log,
)
from copem_replay.extras.fitting.moments import ErrorBin
from copem_replay.extras.fitting.pose import DelayFit, unit_delay
from copem_replay.extras.fitting.replay_check import FEWEST_PASSES, TOTALS, StatisticCheck, remove_memory, replay_check
from copem_replay.extras.fitting.rest import RestFit, fit_rest
from copem_replay.io.recording import Recording
from copem_replay.perception.config import PoseError
from copem_replay.perception.pem.model import Pem

# Estimates by name, wherever the parts of a fit hold them, and plain data.

_ROUNDING = 1e-9
"""Relative difference up to which two numbers count as equal: more than summing in another order makes."""


def name_estimates(part: Any, name: str = "") -> Iterator[tuple[str, Estimate]]:
    """Every estimate with its name, as `detection.memory.share`, in the order of the fields."""
    if isinstance(part, Estimate):
        yield name, part
        return
    for key, value in _list_members(part):
        yield from name_estimates(value, f"{name}.{key}" if name else key)


def _list_members(part: Any) -> Iterator[tuple[str, Any]]:
    """Name and value of each member of an estimate, columns of rows left out; none of a plain value."""
    if is_dataclass(part):
        yield from ((f.name, getattr(part, f.name)) for f in fields(part) if not f.metadata.get(PER_ROW))
    elif isinstance(part, Mapping):
        yield from ((" ".join(key) if isinstance(key, tuple) else str(key), value) for key, value in part.items())
    elif isinstance(part, list | tuple):
        yield from ((str(k), value) for k, value in enumerate(part))


def find_moved(main: Any, others: Mapping[float, Any]) -> list[str]:
    """A line for each estimate that another gate moves out of its interval; `others`: fits by their gate, in metres."""
    by_gate = {gate_m: dict(name_estimates(parts)) for gate_m, parts in others.items()}
    lines = []
    for name, estimate in name_estimates(main):
        shown = name.removeprefix("rest.")
        for gate_m, estimates in by_gate.items():
            other = estimates.get(name)
            if other is None or other.why is not None or estimate.why is not None or math.isnan(estimate.low):
                continue
            slack = _ROUNDING * abs(estimate.value)
            if not (math.isnan(other.value) or estimate.low - slack <= other.value <= estimate.high + slack):
                lines.append(f"{shown}: {estimate.words()}, but {other.value:.3g} with a gate of {gate_m:g} m")
    return lines


def to_plain_data(part: Any) -> Any:
    """Any content of a fit as plain data for JSON; NaN and infinity as null."""
    if isinstance(part, float | np.floating):
        return float(part) if math.isfinite(part) else None
    if isinstance(part, np.ndarray):
        return to_plain_data(part.tolist())
    if isinstance(part, np.generic):
        return part.item()
    if isinstance(part, list | tuple):
        return [to_plain_data(value) for value in part]
    if is_dataclass(part) or isinstance(part, Mapping):
        return {key: to_plain_data(value) for key, value in _list_members(part)}
    return part


# Fitting a unit.

Truth = Literal["partial", "complete"]
SURE = 0.05
"""p below which a replay check fails, over the number of statistics: the usual level of five per cent."""
_GATES = (0.75, 1.25)
"""Widths of the other gates that a unit is fitted with, as shares of the experiment's gate."""


@dataclass(frozen=True)
class FitOptions:
    """How a unit is fitted. `truth` None: partial where a list has more entries about no true object than objects."""

    hold_out: tuple[str, ...] = ()
    folds: int | None = None
    truth: Truth | None = None
    by: tuple[str, ...] = BY
    monotone: bool = True
    simplest: bool = False
    other_gates: bool = True
    delay_by: Literal["log", "class"] | None = None


@dataclass(frozen=True)
class FittedParts:
    """The parts of a fit: detection, errors of entries, and all else."""

    detection: DetectionFit
    errors: ErrorFit
    rest: RestFit


@dataclass(frozen=True)
class ReplayChecks:
    """The recording among runs of the fitted model, and among runs of it without memory (empty: it has no memory).

    `held_out`: on logs that the model was not fitted to; else on those that it was.
    """

    held_out: bool
    fitted: tuple[StatisticCheck, ...]
    memoryless: tuple[StatisticCheck, ...]

    @property
    def fails(self) -> bool:
        """Whether any statistic is too often outside of what the model gives."""
        return any(self.refuses(one) for one in self.fitted)

    def refuses(self, check: StatisticCheck) -> bool:
        """Whether a statistic contradicts the model, at a level that as many share (Bonferroni)."""
        return check.verdict == "too sure" and check.p * check.among < SURE

    def lines(self) -> Iterator[str]:
        """A line per statistic."""
        memoryless_checks = {check.statistic: check for check in self.memoryless}
        where = "logs held out" if self.held_out else "the logs it was fitted to"
        for check in self.fitted:
            line = f"replay check on {where}, {check.statistic}: {_format_verdict(check)}"
            memoryless = memoryless_checks.get(check.statistic)
            yield line if memoryless is None else f"{line}; without memory: {_format_verdict(memoryless)}"


def _format_verdict(c: StatisticCheck) -> str:
    if c.statistic in TOTALS:
        return f"{c.verdict} (all passes, p {c.p:.2g})"
    return f"{c.verdict} ({c.inside} of {count_noun(len(c.pit), 'pass', 'passes')} inside 95 %, p {c.p:.2g})"


@dataclass(frozen=True)
class Fit:
    """A fitted unit. `logs`: names of the logs it is fitted to; `held_out`: of those that are held out."""

    unit: str
    logs: tuple[str, ...]
    held_out: tuple[str, ...]
    how: FitOptions
    truth: Truth
    delay: DelayFit
    rate_hz: Estimate
    parts: FittedParts
    gathered: Gathered
    held: Gathered | None  # rows of the logs that are held out, within the reach of the others
    gates: tuple[str, ...]  # lines on estimates that another gate moves
    notes: tuple[str, ...]
    checks: ReplayChecks | None = None
    needless: str = ""  # what braking for nothing on logs held out is, in a line; empty: none is held out

    @property
    def said(self) -> tuple[str, ...]:
        """All notes: on the data, on detection, and on estimates that another gate moves."""
        notes = [f"detection: {line}" for line in self.parts.detection.notes]
        notes += [f"no memory of detection: {why}" for why in (self.parts.detection.memory_why,) if why is not None]
        between, shape = self.parts.errors.between_logs, self.parts.errors.shape
        notes += [f"errors: {shape.words()}"] if shape.heavier else []
        notes += (
            [f"errors that differ between logs: {between.untold}"] if between is not None and between.untold else []
        )
        notes += [f"another gate: {line}" for line in self.gates]
        return (*self.notes, *notes)


def judge_use(fit: Fit) -> str:
    """One sentence on what the model may be used for, and what not."""
    low_m, high_m = fit.gathered.reach.range_m
    rows = fit.gathered.rows
    classes, count = np.unique(rows.view.class_ix[pass_starts(rows.pass_ix)[:-1]], return_counts=True)
    passes = {CLASSES[k]: n for k, n in zip(classes.tolist(), count.tolist(), strict=True)}
    many = [kind for kind, n in passes.items() if n >= FEWEST_PASSES]
    few = [f"{kind} ({count_noun(n, 'pass', 'passes')})" for kind, n in passes.items() if n < FEWEST_PASSES]
    where = f"{', '.join(many or passes)} at {low_m:g} to {high_m:g} m"
    if fit.checks is None:
        return f"Use it for nothing yet ({where}): it was not replayed beside the recording."
    wrong = [check.statistic for check in fit.checks.fitted if fit.checks.refuses(check)]
    if wrong:
        return f"Do not use it for results: replays of it differ from the recording ({where}) in {'; '.join(wrong)}."
    if all(check.verdict == "too few passes to tell" for check in fit.checks.fitted):
        most = count_noun(max((len(check.pit) for check in fit.checks.fitted), default=0), "pass", "passes")
        why = f"{most} cannot tell whether it behaves like the recording, {FEWEST_PASSES} could"
        return f"Use it to try an experiment out ({where}), not for results: {why}."
    known = "" if fit.checks.held_out else ", which it knows already (--hold-out)"
    ghosts = "" if fit.truth == "complete" else ", nor for ghosts, as the truth is partial"
    return (
        f"Use it for {where}, where no statistic of the replay check contradicts it on "
        f"{'logs held out' if fit.checks.held_out else 'the logs it was fitted to'}{known}; "
        f"not beyond, not for {', '.join([*few, 'other classes'])}{ghosts}."
    )


def preview_fit(experiment: Experiment, recordings: Sequence[Recording], unit: str) -> tuple[str, ...]:
    """Lines on the unit's place, its delay, and its matches with the truth, as a fit would find them."""
    label = f"copem-replay fit --unit {unit}"
    try:
        check_unit(experiment, unit)
        lists = raw_lists(recordings, experiment, unit)
        delay = unit_delay(list(zip(recordings, lists, strict=True)), _declared_delay_s(experiment, unit))
        views = _view_logs(recordings, experiment, unit, delay)
        gathered = gather_rows(views, gate_m=experiment.measure.match.gate_m, max_gap_s=experiment.max_gap_s, name=unit)
    except InputError as error:
        return (f"{label} would refuse: {error}",)
    truth: Truth = "partial" if gathered.crowded else "complete"
    matched = count_noun(gathered.matched, "entry", "entries")
    passes = count_noun(gathered.number_of_passes, "pass", "passes")
    first = f"{matched} of true objects in {passes}; delay (s) {delay.estimate.words()}"
    return tuple(f"{label}: {line}" for line in (first, *_note_data(gathered, truth, FitOptions())))


def fit_unit(experiment: Experiment, recordings: Sequence[Recording], unit: str, how: FitOptions | None = None) -> Fit:
    """Fit the recorded `unit` of an experiment over its logs.

    Raises InputError: no such unit or log, no place, or no entry near a true object.
    """
    how = how or FitOptions()
    check_unit(experiment, unit)
    fitted, held_out = _split_held_out(recordings, how)
    lists = raw_lists(fitted, experiment, unit)
    declared_s = _declared_delay_s(experiment, unit)
    delay = unit_delay(list(zip(fitted, lists, strict=True)), declared_s, by=how.delay_by, held_out=held_out)
    views = _view_logs(fitted, experiment, unit, delay)
    gate_m, max_gap_s = experiment.measure.match.gate_m, experiment.max_gap_s
    try:
        gathered = gather_rows(views, gate_m=gate_m, max_gap_s=max_gap_s, folds=how.folds, name=unit)
    except NothingMatchedError:
        _check_delay(fitted, experiment, unit)
        raise
    truth: Truth = how.truth or ("partial" if gathered.crowded else "complete")
    parts = _fit_parts(gathered, truth, how)
    other_gates = {
        share * gate_m: _fit_parts(
            gather_rows(views, gate_m=share * gate_m, max_gap_s=max_gap_s, reach=gathered.reach, folds=how.folds),
            truth, how,
        )
        for share in (_GATES if how.other_gates else ())
    }  # fmt: skip
    unseen = None
    if held_out:
        held_views = _view_logs(held_out, experiment, unit, delay)
        unseen = gather_rows(held_views, gate_m=gate_m, max_gap_s=max_gap_s, reach=gathered.reach)
    return Fit(
        unit, tuple(r.scene.log for r in fitted), tuple(r.scene.log for r in held_out), how, truth, delay,
        _invert_period(parts.rest.list_times.period_s), parts, gathered, unseen, tuple(find_moved(parts, other_gates)),
        (*delay.notes, *_note_data(gathered, truth, how)),
    )  # fmt: skip


def _view_logs(recordings: Sequence[Recording], experiment: Experiment, unit: str, delay: DelayFit) -> list[LogView]:
    lists = raw_lists(recordings, experiment, unit)
    return [
        view_log(recording, unit_lists, experiment, unit, delay.seconds_of(recording.scene.log))
        for recording, unit_lists in zip(recordings, lists, strict=True)
    ]


def _check_delay(recordings: Sequence[Recording], experiment: Experiment, unit: str) -> None:
    """Raises InputError, with the delay, where entries are near true objects if lists are later than assumed."""
    for delay_s in np.arange(0.0, LONGEST_S + 0.01, 0.05).round(2).tolist():
        views = _view_logs(recordings, experiment, unit, DelayFit(Estimate(delay_s, chosen=True)))
        with suppress(NothingMatchedError):
            gather_rows(views, gate_m=experiment.measure.match.gate_m, max_gap_s=experiment.max_gap_s)
            raise InputError(
                f"unit {unit}: its entries are near true objects if its lists are {delay_s:g} s late, which cannot be "
                f"told from them alone; if they are, say `delay_s: {delay_s:g}`"
            )


def _fit_parts(gathered: Gathered, truth: Truth, how: FitOptions) -> FittedParts:
    rows, lists = gathered.rows, gathered.lists
    rest = fit_rest(rows, lists, gathered.other, truth=truth)
    return FittedParts(
        fit_detection(rows, monotone=how.monotone, by=how.by, simplest=how.simplest),
        remove_pose(fit_errors(rows, simplest=how.simplest), rest.placed),
        rest,
    )


def _split_held_out(recordings: Sequence[Recording], how: FitOptions) -> tuple[list[Recording], list[Recording]]:
    """The logs that are fitted, and those that are held out."""
    names = [recording.scene.log for recording in recordings]
    for name in how.hold_out:
        if name not in names:
            raise InputError(f"--hold-out {name}: expected a log of the experiment ({', '.join(names)})")
    fitted = [one for one in recordings if one.scene.log not in how.hold_out]
    if not fitted:
        raise InputError("--hold-out: expected a log that is left to fit, found all held out")
    return fitted, [one for one in recordings if one.scene.log in how.hold_out]


def _declared_delay_s(experiment: Experiment, unit: str) -> float | None:
    """The delay that the experiment states; None: it states none."""
    recorded = experiment.units[unit].recorded
    return recorded.delay_s if recorded is not None and "delay_s" in recorded.model_fields_set else None


def _invert_period(period_s: Estimate) -> Estimate:
    """Lists per second, by the time between two."""
    if period_s.why is not None:
        return Estimate(1.0, why="one list alone has no rate")
    most = 1 / period_s.low if period_s.low > 0 else math.inf
    return replace(period_s, value=1 / period_s.value, low=1 / period_s.high, high=most)


def _note_data(gathered: Gathered, truth: Truth, how: FitOptions) -> list[str]:
    """Notes for the user on matches near the gate, on entries about no object, and on passes to hold out."""
    lists, other = gathered.lists, gathered.other
    notes = [f"{gathered.beyond:.1%} of the matches are farther apart than 0.8 of the gate", *gathered.notes]
    if truth == "partial":
        entries = count_noun(int(lists.entries.sum()), "entry", "entries")
        why = "" if how.truth else ", as a list has more of them than true objects within reach"
        notes.append(
            f"{len(other.list)} of {entries} are about no true object; they are taken for other traffic{why}: "
            "no ghosts are fitted (--truth complete, if the truth has all)"
        )
    if len(np.unique(gathered.rows.fold)) < 2:
        notes.append(f"{count_noun(gathered.number_of_passes, 'pass', 'passes')}: none is held out to choose a model")
    return notes


# A fit as keys of an experiment: the PEM, the unit, and an experiment that replays both beside what was recorded.

RUNS = 500
"""Runs of the experiment that is written: shares are then known to about two per cent."""
Tree = dict[str, Any]


def build_pem(fit: Fit) -> Tree:
    """The PEM, with the interval of every number as a comment."""
    couples = [
        _build_couple(fit, detection, of_bin)
        for detection in fit.parts.detection.couples
        for of_bin in _list_bins(fit)
        if detection.classes is None or of_bin[1].where.of_class in (None, *detection.classes)
    ]
    more = fit.parts.rest.pem_keys()
    memory = fit.parts.detection.memory_keys() | fit.parts.errors.memory_keys() | more.pop("memory", {})
    return {"couples": couples} | ({"memory": memory} if memory else {}) | more


def _list_bins(fit: Fit) -> Iterator[tuple[Tree, ErrorBin]]:
    """The bins of the errors, each with the condition where it holds; the outer ones go to the ends of the reach."""
    low_m, high_m = fit.gathered.reach.range_m
    bins = fit.parts.errors.bins
    nearest = min(error_bin.where.range_m[0] for error_bin in bins)
    farthest = max(error_bin.where.range_m[1] for error_bin in bins)
    for error_bin in bins:
        from_m, to_m = error_bin.where.range_m
        from_m = low_m if from_m == nearest else max(from_m, low_m)
        to_m = high_m if to_m == farthest else min(to_m, high_m)
        if to_m > from_m:
            yield error_bin.where.when | {"range_m": [round_digits(from_m, 6), round_digits(to_m, 6)]}, error_bin


def _build_couple(fit: Fit, detection: DetectionCouple, of_bin: tuple[Tree, ErrorBin]) -> Tree:
    """One couple as keys of the experiment file: where it holds, detection, errors of a bin, existence."""
    where, errors = of_bin
    reach = fit.gathered.reach
    comment = "within reach: nothing is claimed beyond the last 5 m, and the last 5°, with five matched entries"
    when: Tree = where | {"range_m": CommentedValue(where["range_m"], comment)}
    if reach.azimuth_deg is not None:
        when["azimuth_deg"] = list(reach.azimuth_deg)
    return {
        "when": when | detection.when,
        "detection": detection.model(),
        "error": fit.parts.errors.error_keys(errors),
        "existence": CommentedValue(0.9, "chosen: the lists say nothing of it"),
    } | fit.parts.rest.existence.keys()


def build_unit(fit: Fit, experiment: Experiment, pem: str) -> Tree:
    """The unit at its place, with the fitted PEM and rate."""
    recorded = experiment.units[fit.unit]
    tree: Tree = {
        key: value
        for key, value in recorded.model_dump(mode="json", by_alias=True, exclude_unset=True).items()
        if key != "recorded"
    }
    tree |= {"pem": pem, "rate_hz": fit.rate_hz.written(6)}
    return tree | fit.parts.rest.unit_keys()


def build_snippet(fit: Fit, experiment: Experiment) -> Tree:
    """`pems` and `units`, to be pasted into an experiment."""
    return {"pems": {fit.unit: build_pem(fit)}, "units": {fit.unit: build_unit(fit, experiment, fit.unit)}}


def build_experiment(fit: Fit, experiment: Experiment, logs: Sequence[Any]) -> Tree:
    """An experiment over some logs that replays the fitted unit beside the recorded one, as plain data.

    `logs`: its entries of `logs`. Other units and PEMs of the experiment stay.
    """
    data = experiment.as_written()
    name, other = fit.unit, _find_free_name(f"{fit.unit}_recorded", data["units"])
    pem = _find_free_name(name, data["pems"])
    late_s = max(round_digits(fit.delay.seconds, 6), 0.0)
    rows = fit.gathered.rows
    covariance = np.cov(np.stack([rows.east_m, rows.north_m])[:, np.isfinite(rows.east_m)])  # entries may state none
    stated = {
        "delay_s": late_s,
        "covariance_m2": [[round_digits(one, 6) for one in row] for row in covariance.tolist()],
    }
    lists = _complete_recorded(data["units"][name]["recorded"], stated)
    units = dict(data["units"])
    recorded = units.pop(name) | {"recorded": lists}
    entries = [
        _build_log_entry(entry, fit, log, (name, other), stated, lists)
        for entry, log in zip(logs, fit.held_out or fit.logs, strict=True)
    ]
    latency = {"latency_s": {name: late_s}}
    return {
        **{key: value for key, value in data.items() if key not in ("sweep", "show")},
        "logs": entries,
        "runs": RUNS,
        "pems": data["pems"] | {pem: strip_comments(build_pem(fit))},
        "units": {name: strip_comments(build_unit(fit, experiment, pem)), other: recorded, **units},
        "configurations": {"recorded": {"units": [other]}, "fitted": {"units": [name], **latency}},
    }


def _find_free_name(name: str, taken: Any) -> str:
    while name in taken:
        name += "_"
    return name


def _complete_recorded(recorded: Tree, stated: Tree) -> Tree:
    """The keys of recorded lists with the delay that was found, and a covariance where none is stated."""
    return (
        stated | {key: value for key, value in recorded.items() if value is not None} | {"delay_s": stated["delay_s"]}
    )


def _build_log_entry(entry: Any, fit: Fit, log: str, names: tuple[str, str], stated: Tree, recorded: Tree) -> Any:
    """An entry of `logs` with the settings of both units, the fitted and the recorded one, and with its own delay.
    `names`: of both; `stated`, `recorded`: keys of the lists, as fitted and as the experiment has them for all logs.
    """
    settings = dict(entry) if isinstance(entry, dict) else {"file": entry}
    units, own_s = dict(settings.get("units") or {}), fit.delay.of_log.get(log)
    if names[0] not in units and own_s is None:
        return entry
    has_settings = names[0] in units
    own_settings = units.pop(names[0], {})
    if own_settings is None:
        return settings | {"units": units | dict.fromkeys(reversed(names))}
    stated = stated if own_s is None else stated | {"delay_s": max(round_digits(own_s, 6), 0.0)}
    lists = own_settings.get("recorded") or (recorded if own_s is not None else None)
    other = own_settings | ({} if lists is None else {"recorded": _complete_recorded(lists, stated)})
    fitted = {key: value for key, value in own_settings.items() if key != "recorded"}
    return settings | {"units": units | {names[1]: other} | ({names[0]: fitted} if has_settings and fitted else {})}


# The replay check.


def add_replay_check(fit: Fit, *, seed: int = 0) -> Fit:
    """The fit with its replay check, on logs that are held out where there are any, with memory and without."""
    gathered = fit.held or fit.gathered
    pem = Pem.model_validate(strip_comments(build_pem(fit)))
    keys = fit.parts.rest.placed.keys()
    placed = PoseError.model_validate(strip_comments(keys)) if keys else None
    with_memory = replay_check(pem, gathered.rows, gathered.lists, placed=placed, seed=seed)
    memoryless: tuple[StatisticCheck, ...] = ()
    if pem.remembers:
        always_new = None if placed is None else placed.model_copy(update={"memory": None})
        memoryless = replay_check(remove_memory(pem), gathered.rows, gathered.lists, placed=always_new, seed=seed)
    return replace(fit, checks=ReplayChecks(fit.held is not None, with_memory, memoryless))
