"""Worth of units: how many seconds each unit spares, as a fair share, alone, and by what is lost without it.

The value of a set of units is the mean time unknown that it spares (`unknown_s`, docs/guide/metrics.md). Shares are
Shapley's: the mean of what a unit adds, over all orders in which units may come. The ego's own unit is given, as a
world without any unit decides nothing.

Where units are independent, a set knows an object later than t with the product of the probabilities of its units, and
Shapley's sum is an integral of a polynomial, which Gauss and Legendre's ⌈n/2⌉ nodes give exactly (Owen's multilinear
extension): no set is replayed. Elsewhere all sets are, on the same draws, up to eight units. Definitions:
docs/guide/why.md.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
import pandas as pd

from copem_replay.core.errors import ExperimentError, unknown_name_message
from copem_replay.core.tracks import Float
from copem_replay.experiment.schema import Experiment
from copem_replay.extras.why.causes import replay_rows, select_configuration
from copem_replay.io.recording import Recording
from copem_replay.metrics.onset import select_counted
from copem_replay.pipeline.closed_form import exact_table
from copem_replay.pipeline.expansion import find_facts
from copem_replay.pipeline.prepare import prepare_log

MOST_UNITS = 8
"""Units of which all sets are replayed: 255 configurations."""


class UnitCurves(NamedTuple):
    """Of one episode the probability `unknown (U, K)` that each unit does not know it, in spans of `length_s (K,)`."""

    length_s: Float
    unknown: Float


@dataclass(frozen=True)
class UnitWorths:
    """Seconds that each of the units (U,) spares in the mean, beside those that are given.

    `share_s`: by Shapley; they sum to `given_s` − `all_s`, the time unknown with the given units alone and with all.
    `alone_s`: with the given units alone before. `left_out_s`: what is lost without it, the others there.
    """

    units: tuple[str, ...]
    share_s: Float
    alone_s: Float
    left_out_s: Float
    given_s: float
    all_s: float
    by_curves: bool

    @property
    def table(self) -> pd.DataFrame:
        """The worths as rows of `units.csv`."""
        columns = {"share_s": self.share_s, "alone_s": self.alone_s, "left_out_s": self.left_out_s}
        table = pd.DataFrame({"unit": self.units, **columns})
        return table.sort_values(  # units that are alike stay in their order, whatever rounding does
            "share_s", ascending=False, kind="stable", ignore_index=True, key=lambda share_s: share_s.round(9)
        )


def compute_unit_worths(
    logs: Sequence[tuple[Recording, Experiment]], name: str, units: Sequence[str] | None = None
) -> UnitWorths:
    """The worth of the units of a configuration, of its rows in all logs, each with the experiment of the log.

    `units`: only these are asked about, the others are given; None: all but the one aboard the ego. Raises
    ExperimentError for a unit that the configuration has not, and for more than `MOST_UNITS` where times have no closed
    form.
    """
    selected = [(recording, select_configuration(experiment, name)) for recording, experiment in logs]
    first = selected[0][1]
    members = first.units_of(first.configurations[name])
    for unit in units or ():
        if unit not in members:
            raise ExperimentError(f"configuration {name}: {unknown_name_message('unit', unit, members)}")
    judged = tuple(units or (unit for unit in members if first.units[unit].on != "ego"))
    if not judged:
        raise ExperimentError(
            f"configuration {name}: expected a unit beside the ego's, found {', '.join(members)} alone"
        )
    others = tuple(unit for unit in members if unit not in judged)
    if all(_is_product(experiment, name) for _, experiment in selected):
        try:
            curves = [one for log in selected for one in _list_curves(*log, name, judged, others)]
        except ExperimentError as error:
            _check_count(name, judged, str(error))
        else:
            return share_by_curves(judged, curves)
    _check_count(name, judged, "its units are not independent, or its fusion is not ideal")
    return share_by_sets(judged, _replay_sets(selected, name, judged, others))


def _check_count(name: str, judged: Sequence[str], why: str) -> None:
    if len(judged) > MOST_UNITS:
        raise ExperimentError(
            f"configuration {name}: {len(judged)} units have {2 ** len(judged) - 1:,} sets to replay ({why}); "
            f"ask about {MOST_UNITS} at most with --unit, or use ideal fusion"
        )


# By curves, of units that are independent.


def _is_product(experiment: Experiment, name: str) -> bool:
    """Whether probabilities of units multiply: ideal fusion by the first hit, and no draw that units share."""
    measure = experiment.measure
    if not find_facts(experiment)[name].by_truth_id or (measure.confirm.hits, measure.confirm.of) != (1, 1):
        return False
    lasting = [
        part
        for pem in experiment.pems.values()
        for couple in range(len(pem.couples))
        for part in pem.memory_of(couple).get("detection", ())
    ]
    return all(part.of in ("pair", "unit") for part in lasting)


def _list_curves(
    recording: Recording, experiment: Experiment, name: str, judged: Sequence[str], others: Sequence[str]
) -> Iterator[UnitCurves]:
    """For each episode that counts the share unknown over time, by unit `judged`; `others` are always there."""
    configuration, configurations = experiment.configurations[name], {}
    for unit in (*judged, *others):
        configurations[unit] = configuration.model_copy(update={"units": (unit,)})
    singles = experiment.model_copy(update={"configurations": configurations})
    replay = prepare_log(recording, singles)
    table = select_counted(exact_table(replay, singles), experiment.measure.began)
    for _, rows in table.groupby(["object_id", "episode"], sort=False):
        onset_s, ended_s = float(rows["onset_s"].iloc[0]), float(rows["ended_s"].iloc[0])
        detections = rows.dropna(subset="detection_s")
        at_s = np.unique(np.clip([onset_s, *detections["detection_s"], ended_s], onset_s, ended_s))
        unknown = np.ones((len(configurations), max(len(at_s) - 1, 0)))
        for k, unit in enumerate(configurations):
            curve = detections[detections["configuration"] == unit].sort_values("detection_s")
            last = np.searchsorted(np.maximum(curve["detection_s"].to_numpy(), onset_s), at_s[:-1], side="right") - 1
            incidence = np.append(curve["incidence"].to_numpy(), 0.0)  # −1: none yet
            unknown[k] = 1 - incidence[last]
        yield UnitCurves(np.diff(at_s) * unknown[len(judged) :].prod(axis=0), unknown[: len(judged)])


def share_by_curves(units: Sequence[str], curves: Sequence[UnitCurves]) -> UnitWorths:
    """Worths from survival curves: ∫ (1 − qᵢ) Π (1 − x (1 − qⱼ)) dx over 0 … 1, j ≠ i, and over time."""
    n = len(units)
    nodes, weights = np.polynomial.legendre.leggauss((n + 1) // 2)
    nodes, weights = (nodes + 1) / 2, weights / 2
    length_s = np.concatenate([one.length_s for one in curves])
    q = np.concatenate([one.unknown for one in curves], axis=1)
    factors = 1 - nodes[:, None, None] * (1 - q)
    share_s, left_out_s = np.empty(n), np.empty(n)
    for i in range(n):
        others = np.delete(factors, i, axis=1).prod(axis=1)
        share_s[i] = (weights @ others) @ ((1 - q[i]) * length_s)
        left_out_s[i] = (np.delete(q, i, axis=0).prod(axis=0) * (1 - q[i])) @ length_s
    alone_s, count = (1 - q) @ length_s, len(curves)
    given_s, all_s = length_s.sum(), q.prod(axis=0) @ length_s
    return UnitWorths(
        tuple(units),
        share_s / count,
        alone_s / count,
        left_out_s / count,
        given_s / count,
        all_s / count,
        by_curves=True,
    )


# By sets, replayed on the same draws.


def _replay_sets(
    logs: Sequence[tuple[Recording, Experiment]], name: str, judged: Sequence[str], others: Sequence[str]
) -> dict[frozenset[str], float]:
    """By set of the `judged` units the mean time unknown (s) with it, beside the `others`, by replay."""
    sets = [frozenset(unit_set) for size in range(len(judged) + 1) for unit_set in combinations(judged, size)]
    total_s, count = dict.fromkeys(sets, 0.0), dict.fromkeys(sets, 0)
    for recording, experiment in logs:
        configurations = {}
        for number, unit_set in enumerate(sets):
            units = tuple(unit for unit in experiment.units if unit in unit_set or unit in others)
            if units:
                configurations[str(number)] = experiment.configurations[name].model_copy(update={"units": units})
        joint_experiment = experiment.model_copy(update={"configurations": configurations})
        rows = replay_rows(prepare_log(recording, joint_experiment), joint_experiment)
        for number, of_set in rows.groupby("configuration", sort=False):
            total_s[sets[int(str(number))]] += of_set["unknown_s"].sum()
            count[sets[int(str(number))]] += len(of_set)
        if not others:  # nothing is ever known without a unit
            of_one = rows[rows["configuration"] == "1"]
            total_s[frozenset()] += (of_one["ended_s"] - of_one["onset_s"]).sum()
            count[frozenset()] += len(of_one)
    return {unit_set: total_s[unit_set] / count[unit_set] for unit_set in sets}


def share_by_sets(units: Sequence[str], unknown_s: Mapping[frozenset[str], float]) -> UnitWorths:
    """Worths from the time unknown with each set of units."""
    n, full, nobody = len(units), frozenset(units), frozenset[str]()
    share_s = np.zeros(n)
    for k, unit in enumerate(units):
        for some in unknown_s:
            if unit not in some:
                weight = math.factorial(len(some)) * math.factorial(n - len(some) - 1) / math.factorial(n)
                share_s[k] += weight * (unknown_s[some] - unknown_s[some | {unit}])
    alone_s = np.array([unknown_s[nobody] - unknown_s[frozenset({unit})] for unit in units])
    left_out_s = np.array([unknown_s[full - {unit}] - unknown_s[full] for unit in units])
    return UnitWorths(tuple(units), share_s, alone_s, left_out_s, unknown_s[nobody], unknown_s[full], by_curves=False)
