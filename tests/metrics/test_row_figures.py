"""Means of rows with the limits of means between bounds, over logs, objects and passes, against plain loops."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from copem_replay.metrics.limits import find_clusters
from copem_replay.metrics.row_figures import JUDGED, FigureRows
from copem_replay.metrics.survival import CENSORED, DETECTED, LEFT, cumulative_incidence, restricted_mean
from tests.oracles import intervals as oracle

HORIZON_S = 2.5


class TalliedRow(NamedTuple):
    cluster: int
    time_s: float | None  # None: never
    length_s: float
    left: bool
    runs: int

    @property
    def until_s(self) -> float:
        return self.length_s if self.time_s is None else self.time_s

    @property
    def unknown_s(self) -> float:
        return max(min(self.until_s, self.length_s), 0.0)


def mean_time_s(rows: list[TalliedRow]) -> float:
    endings = [DETECTED if row.time_s is not None else LEFT if row.left else CENSORED for row in rows]
    columns = (np.array(of, dtype=float) for of in ([row.until_s for row in rows], [row.runs for row in rows]))
    time_s, weight = columns
    return restricted_mean(*cumulative_incidence(time_s, np.array(endings), weight), HORIZON_S)


def mean_unknown_s(rows: list[TalliedRow], most_s: float = math.inf) -> float:
    return sum(row.runs * min(row.unknown_s, most_s) for row in rows) / sum(row.runs for row in rows)


def expected(
    rows: list[TalliedRow], of: Callable[[list[TalliedRow]], float], least: float, most: float, followed: float = 1.0
) -> tuple[float, float]:
    numbers = sorted({row.cluster for row in rows})
    without = [of([row for row in rows if row.cluster != k]) for k in numbers]
    weights = [sum(row.runs for row in rows if row.cluster == k) for k in numbers]
    return oracle.bounded(of(rows), without, weights, least, most, followed)


def make_table(rows: list[TalliedRow], over: str) -> pd.DataFrame:
    """A log, object or pass for each cluster; its rows are of several objects, passes, or instants."""
    first = [next(j for j, one in enumerate(rows) if one.cluster == row.cluster) for row in rows]
    names = {
        "logs": ([f"log {row.cluster}" for row in rows], list(range(len(rows))), [0] * len(rows)),
        "objects": (["a"] * len(rows), [row.cluster for row in rows], list(range(len(rows)))),
        "passes": (["a"] * len(rows), ["rtk"] * len(rows), first),
    }[over]
    table = pd.DataFrame(dict(zip(("log", "object_id", "episode"), names, strict=True)))
    return table.assign(
        onset_s=1.0,
        ended_s=[1.0 + row.length_s for row in rows],
        ended_by=["object_left" if row.left else "log_end" for row in rows],
        time_to_detection_s=[math.nan if row.time_s is None else row.time_s for row in rows],
    )


quarters = st.integers(0, 16).map(lambda k: k / 4)
tallied = st.builds(
    TalliedRow, st.integers(0, 6), st.none() | st.integers(-4, 16).map(lambda k: k / 4), quarters, st.booleans(),
    st.integers(1, 4),
)  # fmt: skip


@given(st.lists(tallied, max_size=12), st.sampled_from(["logs", "objects", "passes"]), st.data())
def test_means_have_the_limits_of_the_plain_formula(some: list[TalliedRow], over: str, data: st.DataObject) -> None:
    rows = [*(data.draw(tallied)._replace(cluster=k) for k in range(5)), *some]
    table = make_table(rows, over)
    weight = np.array([row.runs for row in rows], dtype=float)
    clusters = find_clusters(table)
    assert clusters is not None
    assert (clusters.over, clusters.count) == (over, len({row.cluster for row in rows}))
    figures = FigureRows(table, weight, clusters)

    told = sum(row.runs for row in rows if row.time_s is not None or row.left or row.length_s >= HORIZON_S)
    earliest_s = min(0.0, *(row.until_s for row in rows))
    found = JUDGED["ttd_rmst_s"].limit(figures, HORIZON_S, 0.95, math.nan)
    assert found.value == pytest.approx(mean_time_s(rows), abs=1e-9)
    if told:
        limits = expected(rows, mean_time_s, earliest_s, HORIZON_S, told / weight.sum())
        assert (found.low, found.high) == pytest.approx(limits, abs=1e-9)
    else:
        assert found.kind is None

    longest_s = max(row.length_s for row in rows)
    found = JUDGED["unknown_s"].limit(figures, HORIZON_S, 0.95, math.nan)
    assert (found.low, found.high) == pytest.approx(expected(rows, mean_unknown_s, 0.0, longest_s), abs=1e-9)
    found = JUDGED["unknown_to_horizon_s"].limit(figures, HORIZON_S, 0.95, math.nan)
    limits = expected(rows, lambda kept: mean_unknown_s(kept, HORIZON_S), 0.0, HORIZON_S)
    assert (found.low, found.high) == pytest.approx(limits, abs=1e-9)
