"""Where detection lasts, and whether that has a closed form: what `exact` needs to know of the PEMs' memory."""

from __future__ import annotations

import numpy as np

from copem_replay.core.errors import ExperimentError
from copem_replay.core.memory import Part
from copem_replay.core.text import counted
from copem_replay.core.tracks import SAME_INSTANT_NS, TRUTH, Float, Int, Tracks
from copem_replay.metrics.lasting_survival import Lasting
from copem_replay.perception.observation import rows_by_unit
from copem_replay.perception.pem.model import Pem
from copem_replay.pipeline.expansion import ExpandedExperiment
from copem_replay.pipeline.prepare import Replay

_TOLERANCE_S = SAME_INSTANT_NS * 1e-9


def check_lasting(experiment: ExpandedExperiment, name: str, hits: int) -> bool:
    """Whether detection lasts in a configuration. Raises ExperimentError where that has no closed form."""
    return bool(_processes(experiment, name, hits))


def lasting(replay: Replay, experiment: ExpandedExperiment, name: str, heard: Tracks) -> Lasting | None:
    """How the detection of each row (P,) lasts in what a configuration hears; None: that of no row does.

    Raises ExperimentError where it does in a way that has no closed form.
    """
    of_unit = _processes(experiment, name, 1)
    if not of_unit:
        return None
    found = replay.measured
    P, keys = len(found.probability), list(dict.fromkeys(key for key, _ in of_unit.values()))
    process, share, tau_s = np.full(P, -1), np.zeros(P), np.full(P, np.inf)
    for (unit, settings), rows in zip(experiment.modelled.items(), rows_by_unit(found.tracks), strict=True):
        if unit not in of_unit:
            continue
        key, time_s = of_unit[unit]
        pem = experiment.pems[str(settings.pem)]
        by_couple = np.array([*(sum(part.share for part in _lasts(pem, c)) for c in range(len(pem.couples))), 0.0])
        process[rows], share[rows], tau_s[rows] = keys.index(key), by_couple[found.couple_ix[rows]], time_s
    for number in range(len(keys)):
        units = [unit for unit, (key, _) in of_unit.items() if keys.index(key) == number]
        _check_order(replay, experiment, name, heard, units)
    return Lasting(process, share, tau_s, heard.row_captured_s)


def _processes(experiment: ExpandedExperiment, name: str, hits: int) -> dict[str, tuple[str, float]]:
    """By unit of a configuration number_key detection lasts: the held number it uses, and its correlation time."""
    configuration = experiment.configurations[name]
    found: dict[str, tuple[str, float]] = {}
    for unit in () if configuration.units == TRUTH else experiment.units_of(configuration):
        settings = experiment.units[unit]
        if settings.pem is None:
            continue
        part = _part(experiment.pems[settings.pem], name, unit)
        if part is None:
            continue
        if hits > 1:
            raise _refused(name, f"detection of unit {unit} lasts, and confirmation by several hits then has no closed "
                           "form; confirm with one hit")  # fmt: skip
        tau_s = np.inf if isinstance(part.correlation_s, str) else part.correlation_s
        key = f"{part.of} {unit}" if part.of in ("pair", "unit") else part.of
        for other, (number_key, other_s) in found.items():
            if number_key == key and other_s != tau_s:
                raise _refused(name, f"units {other} and {unit} have the numbers of `of: {part.of}` in common with two "
                               "correlation times, which has no closed form; give them one")  # fmt: skip
        found[unit] = key, tau_s
        if part.of in ("object", "all") and experiment.share[list(experiment.units).index(unit)] < 1:
            raise _refused(name, f"unit {unit} is only in some runs, and detection of `of: {part.of}` that lasts then "
                           "has no closed form")  # fmt: skip
    return found


def _part(pem: Pem, name: str, unit: str) -> Part | None:
    """The one part of a unit's detection that lasts; None: none does."""
    by_couple = [parts for c in range(len(pem.couples)) if (parts := _lasts(pem, c))]
    if not by_couple:
        return None
    most = max(by_couple, key=len)
    if len(most) > 1:
        raise _refused(name, f"detection of unit {unit} has {_number(len(most))} lasting parts, which has no closed "
                       "form here; leave one")  # fmt: skip
    [first, *others] = [parts[0] for parts in by_couple]
    if any((one.correlation_s, one.of, one.path) != (first.correlation_s, first.of, first.path) for one in others):
        raise _refused(name, f"detection of unit {unit} lasts otherwise from couple to couple, which has no closed "
                       "form; give all one correlation_s and `of`")  # fmt: skip
    if first.path not in (None, "held") and first.correlation_s != "always":
        raise _refused(name, f"detection of unit {unit} {first.path}, which has no closed form; use `path: held`")
    return first


def _lasts(pem: Pem, couple: int) -> list[Part]:
    return [part for part in pem.memory_of(couple).get("detection", ()) if part.share > 0]


def _number(count: int) -> str:
    return {2: "two", 3: "three"}.get(count, str(count))


def _check_order(replay: Replay, experiment: ExpandedExperiment, name: str, heard: Tracks, units: list[str]) -> None:
    """Raise ExperimentError unless lists that go by one number arrive in the order of their captures."""
    ixs = [list(experiment.units).index(unit) for unit in units]
    frames = np.flatnonzero(np.isin(heard.frame_unit_ix, ixs) & np.isfinite(heard.common_arrives_s))
    arrives_s: Float = heard.common_arrives_s[frames[np.argsort(heard.captured_s[frames], kind="stable")]]
    late: Int = np.flatnonzero(arrives_s < np.maximum.accumulate(arrives_s) - _TOLERANCE_S)
    if len(late):
        them = f"unit {units[0]}" if len(units) == 1 else f"the {counted(len(units), 'unit')} {', '.join(units)}"
        raise _refused(
            f"{name}", f"lists of {them} arrive in another order than they were captured in, and detection that lasts "
            "then has no closed form; give them one constant latency", replay.scene.log,
        )  # fmt: skip


def _refused(name: str, why: str, log: str = "") -> ExperimentError:
    return ExperimentError(f"{log + ': ' if log else ''}exact: configuration {name}: {why}, or leave exact out")
