"""Each drive once: figures are means of the drives' own, and their limits those of a mean between bounds."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from copem_replay.metrics.limits import find_clusters, weigh_rows
from copem_replay.metrics.row_figures import JUDGED, FigureRows
from copem_replay.metrics.summary import summarise_tally
from tests.oracles import intervals as oracle

HORIZON_S = 5.0
Drives = list[list[float | None]]


def tally_of(drives: Drives) -> pd.DataFrame:
    """A row of the tally for each object of each drive, in one run; None: it left undetected."""
    rows = [
        {
            "log": f"log{k}", "configuration": "a", "event": "detected", "object_id": str(j), "object_class": "car",
            "episode": 0, "onset_s": 0.0, "distance_at_onset_m": 40.0, "began": "crossed", "ended_s": 10.0,
            "ended_by": "object_left", "detection_s": time_s, "time_to_detection_s": time_s,
            "distance_at_detection_m": None if time_s is None else 50.0 - time_s, "runs": 1,
        }
        for k, times in enumerate(drives) for j, time_s in enumerate(times)
    ]  # fmt: skip
    table = pd.DataFrame(rows)
    for name in ("detection_s", "time_to_detection_s", "distance_at_detection_m"):
        table[name] = table[name].astype(float)
    return table


def summary_of(drives: Drives, weigh: str) -> dict[str, float]:
    table, _ = summarise_tally(tally_of(drives), ["a"], {"a": None}, horizon_s=HORIZON_S, weigh=weigh)
    return dict(table.iloc[0])


times = st.one_of(st.none(), st.integers(0, 90).map(lambda tenths: tenths / 10))
drawn_drives = st.lists(st.lists(times, min_size=1, max_size=6), min_size=3, max_size=6)


@given(drawn_drives)
def test_figures_are_means_of_the_drives_own(drives: Drives) -> None:
    found = summary_of(drives, "drives")
    alone = [summary_of([times], "objects") for times in drives]
    for name in ("detected_share", "left_undetected_share", "ttd_rmst_s", "unknown_s", "unknown_to_horizon_s"):
        assert found[name] == pytest.approx(float(np.mean([one[name] for one in alone])), abs=1e-9), name
    assert found["n"] == sum(map(len, drives))


@given(drawn_drives)
def test_limits_are_those_of_a_mean_between_bounds_of_drives_that_weigh_alike(drives: Drives) -> None:
    K, table = len(drives), tally_of(drives)
    weight, clusters = weigh_rows(table, "runs", "drives"), find_clusters(table, weigh="drives")
    rows = FigureRows(table, weight, clusters)
    shares = [sum(t is not None for t in of) / len(of) for of in drives]
    means = [sum(HORIZON_S if t is None else min(t, HORIZON_S) for t in of) / len(of) for of in drives]
    for name, values, most in (("detected_share", shares, 1.0), ("ttd_rmst_s", means, HORIZON_S)):
        value = float(np.mean(values))
        without = [(sum(values) - one) / (K - 1) for one in values]
        expected = oracle.bounded(value, without, [1.0] * K, 0.0, most)
        figure = JUDGED[name].limit(rows, HORIZON_S, 0.95, 0.5)
        assert (figure.value, figure.kind) == (pytest.approx(value, abs=1e-9), "bounded")
        assert (figure.low, figure.high) == pytest.approx(expected, abs=1e-9)
    summary = summary_of(drives, "drives")
    share = JUDGED["detected_share"].limit(rows, HORIZON_S, 0.95, 0.5)
    assert (summary["detected_share_low"], summary["detected_share_high"]) == pytest.approx((share.low, share.high))
    assert summary["interval"] == "bounded"
    for name in ("ttd_rmst_s", "unknown_to_horizon_s"):
        mean = JUDGED[name].limit(rows, HORIZON_S, 0.95, 0.5)
        assert (summary[f"{name}_low"], summary[f"{name}_high"]) == pytest.approx((mean.low, mean.high))


@given(drawn_drives, st.integers(0, 90).map(lambda tenths: tenths / 10))
def test_a_quantile_is_held_by_the_mean_of_the_drives_shares(drives: Drives, bound_s: float) -> None:
    K, table = len(drives), tally_of(drives)
    rows = FigureRows(table, weigh_rows(table, "runs", "drives"), find_clusters(table, weigh="drives"))
    shares = [sum(t is not None and t <= bound_s for t in of) / len(of) for of in drives]
    value = float(np.mean(shares))
    expected = oracle.bounded(value, [(sum(shares) - one) / (K - 1) for one in shares], [1.0] * K, 0.0, 1.0)
    share = rows.limit_time_quantile(0.5, 0.95, bound_s).share
    assert share == pytest.approx((expected[0], value, expected[1]), abs=1e-9)
    beyond = rows.limit_distance_quantile(0.5, 0.95, 50.0 - bound_s).share  # 50 m less what it took
    assert beyond == pytest.approx((expected[0], value, expected[1]), abs=1e-9)


def test_a_single_drive_is_what_it_is() -> None:
    drives: Drives = [[0.5, 1.0, 2.0, None, 3.0, 7.0]]
    assert summary_of(drives, "drives") == summary_of(drives, "objects")


def test_a_busy_drive_counts_once() -> None:
    """Sixty objects known after 4 s beside two drives of one object, known at once: 4·60/62 s, or 4/3 s."""
    drives: Drives = [[4.0] * 60, [0.0], [0.0]]
    assert summary_of(drives, "objects")["ttd_rmst_s"] == pytest.approx(4 * 60 / 62)
    assert summary_of(drives, "drives")["ttd_rmst_s"] == pytest.approx(4 / 3)
