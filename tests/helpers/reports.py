"""Object lists and reports built by hand."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from copem_replay.core.object_list import Entries, Inputs, ObjectLists, entries_of
from copem_replay.core.tracks import CLASSES

Array = npt.NDArray[Any]
SAME_S = 1e-6
"""Arrivals closer than this are one instant."""


def entry(
    x_m: float, y_m: float = 0.0, *, of: str = "car", cov: tuple[float, float, float] = (1.0, 0.0, 1.0), **more: Any
) -> Entries:
    """A list of one entry. `cov`: of the position, easting², both, northing²; `more`: fields of ENTRY by name."""
    one = entries_of(1)
    given = {"x_m": x_m, "y_m": y_m, "length_m": 4.0, "width_m": 2.0, "height_m": 1.5, "existence": 1.0}
    given |= dict(zip(("cov_ee_m2", "cov_en_m2", "cov_nn_m2"), cov, strict=True))
    for name, value in (given | more).items():
        one[name] = value
    if "class_probability" not in more:
        one["class_probability"][0, CLASSES.index(of)] = 1.0
    return one


def joined(*lists: Entries) -> Entries:
    """One list of the entries of all."""
    return np.concatenate([entries_of(0), *lists])


def lists_of(lists_by_run: Sequence[Sequence[Entries]]) -> ObjectLists:
    """Lists from [run][number]."""
    count = len(lists_by_run[0])
    assert all(len(lists) == count for lists in lists_by_run), "every run has the same lists"
    lengths = np.array([[len(one) for one in lists] for lists in lists_by_run], dtype=np.int64)
    ends = np.cumsum(lengths).reshape(lengths.shape)
    first = np.concatenate([[0], ends[:-1, -1]]) if count else np.zeros(len(lists_by_run))
    start = np.concatenate([first[:, None], ends], axis=1).astype(np.int64)
    return ObjectLists(start, joined(*(one for lists in lists_by_run for one in lists)))


def between(lists: ObjectLists, first: int, after: int) -> tuple[ObjectLists, Array]:
    """The lists `first` … `after` − 1 of every run, and which entries of all theirs are."""
    start = lists.start[:, first : after + 1]
    lengths = np.diff(start, axis=1)
    ends = np.cumsum(lengths.sum(axis=1))
    rows = np.concatenate([np.empty(0, dtype=np.int64), *(np.arange(one[0], one[-1]) for one in start)])
    return ObjectLists(start - start[:, :1] + (ends - lengths.sum(axis=1))[:, None], lists.entries[rows]), rows


def chunks(cuts: Sequence[float], count: int) -> list[tuple[int, int]]:
    """From where to where `count` things go when they are cut at these shares of them."""
    places = [0, *sorted(round(cut * count) for cut in cuts), count]
    return list(pairwise(places))


def inputs_of(
    lists_by_run: Sequence[Sequence[Entries]],
    units: Sequence[str],
    captured_s: Sequence[float],
    arrives_s: Sequence[float],
    max_age_s: float = 1.0,
    names: Sequence[str] | None = None,
) -> Inputs:
    """Reports of lists [run][f], list f being of the unit `units[f]`.

    `names`: all units in the order of the experiment, by default in the order of their first list. An arrival of inf is
    none. Instants, newest lists and arrivals are found list by list, as the words of `Inputs` say.
    """
    assert len(units) == len(captured_s) == len(arrives_s) == len(lists_by_run[0])
    order = tuple(names if names is not None else dict.fromkeys(units))
    unit_ix = np.array([order.index(unit) for unit in units], dtype=np.int64)
    filled = [[one.copy() for one in lists] for lists in lists_by_run]
    for lists in filled:
        for f, one in enumerate(lists):
            one["captured_s"], one["unit_ix"] = captured_s[f], unit_ix[f]
    coming = sorted((float(at), f) for f, at in enumerate(arrives_s) if np.isfinite(at))
    instants: list[list[int]] = []
    for place, (at, f) in enumerate(coming):
        if place == 0 or at - coming[place - 1][0] > SAME_S:
            instants.append([])
        instants[-1].append(f)
    issue_s = [max(arrives_s[f] for f in came) for came in instants]
    newest = np.full((len(instants), len(order)), -1, dtype=np.int64)
    for k in range(len(instants)):
        have = [f for came in instants[: k + 1] for f in came]
        for u in range(len(order)):
            mine = [f for f in have if unit_ix[f] == u]
            if mine:
                f = max(mine, key=lambda f: captured_s[f])
                newest[k, u] = f if issue_s[k] <= arrives_s[f] + max_age_s + SAME_S else -1
    return Inputs(
        units=order,
        unit_ix=unit_ix,
        captured_s=np.array(captured_s, dtype=float),
        arrives_s=np.array(arrives_s, dtype=float),
        lists=lists_of(filled),
        issue_s=np.array(issue_s, dtype=float),
        newest=newest,
        arrived=np.array([f for came in instants for f in came], dtype=np.int64),
        arrived_start=np.cumsum([0, *map(len, instants)]).astype(np.int64),
    )
