"""Limits of a rate from few drives, and the figures of needless braking over drives."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from copem_replay.metrics.braking.driving import DRIVING, RATE, SHARE, Drives, sum_drives
from copem_replay.metrics.limits import limit_rate
from copem_replay.metrics.slices import sum_lists

DRIVEN = st.lists(
    st.tuples(st.integers(0, 180).map(lambda events: events / 20), st.floats(0.1, 3)), min_size=1, max_size=8
)
"""Drives: brakes, the mean of 20 runs, and hours."""
QUIET = settings(deadline=None)


class TestRate:
    @pytest.mark.parametrize(
        ("events", "low", "high"),
        [(1, 0.0253, 5.572), (2, 0.242, 7.225), (5, 1.623, 11.668), (10, 4.795, 18.390), (20, 12.217, 30.888)],
    )
    def test_as_published(self, events: float, low: float, high: float) -> None:
        """Garwood's limits of a Poisson mean, as printed in tables: one drive has no spread between drives."""
        assert limit_rate(np.array([float(events)]), np.array([1.0])) == pytest.approx((low, high), abs=6e-4)

    @pytest.mark.parametrize(("hours", "high"), [(1.0, 3.689), (113 / 3600, 117.5), (3.7, 0.997)])
    def test_without_any(self, hours: float, high: float) -> None:
        """−ln .025 = 3.689 in all: none in 113 s is below 117.5 an hour, none in 3.7 h below 1."""
        for drives in (1, 3, 7):
            found = limit_rate(np.zeros(drives), np.full(drives, hours / drives))
            assert found == (0.0, pytest.approx(high, rel=1e-3))

    def test_alike_drives_have_no_spread(self) -> None:
        """Four drives of two events each in an hour: those of eight events, 3.454 and 15.763."""
        found = limit_rate(np.full(4, 2.0), np.full(4, 0.25))
        assert found == pytest.approx((3.4538, 15.7632), abs=1e-4)

    def test_drives_that_differ_count_as_fewer_events(self) -> None:
        """0, 0 and 9 events in an hour each, rate 3: v = 3/2 · (9 + 9 + 36) / 9 = 9, t of 2 is 4.3027, so that
        φ = 9 · 3/3 · (4.3027/1.96)² = 43.37 and 9 events are worth .2075.
        """
        m = 9 / (9 * (stats.t.ppf(0.975, 2) / stats.norm.ppf(0.975)) ** 2)
        assert m == pytest.approx(0.2075, abs=1e-4)
        low, high = limit_rate(np.array([0.0, 0.0, 9.0]), np.ones(3))
        assert low == pytest.approx(stats.chi2.ppf(0.025, 2 * m) / 2 / m * 3)
        assert high == pytest.approx(stats.chi2.ppf(0.975, 2 * m + 2) / 2 / m * 3)
        assert low < 1e-6
        assert 59 < high < 60

    @QUIET
    @given(
        DRIVEN,
        st.sampled_from([1e-3, 0.2, 60.0, 3600.0]),
    )
    def test_whatever_time_is_counted_in(self, drives: list[tuple[float, float]], unit: float) -> None:
        events, hours = np.array(drives).T
        low, high = limit_rate(events, hours)
        assert limit_rate(events, hours * unit) == pytest.approx((low / unit, high / unit), rel=1e-6, abs=1e-12)
        rate = events.sum() / hours.sum()
        assert 0 <= low <= rate + 1e-12
        assert rate - 1e-12 <= high

    @QUIET
    @given(DRIVEN)
    def test_never_narrower_than_those_of_the_events_alone(self, drives: list[tuple[float, float]]) -> None:
        events, hours = np.array(drives).T
        N, H = events.sum(), hours.sum()
        low, high = limit_rate(events, hours)
        assert low <= (stats.chi2.ppf(0.025, 2 * N) / 2 / H if N else 0.0) + 1e-6
        assert high >= stats.chi2.ppf(0.975, 2 * N + 2) / 2 / H - 1e-6

    def test_wider_with_more_confidence(self) -> None:
        events, hours = np.array([1.0, 0.0, 4.0]), np.ones(3)
        narrow, wide = limit_rate(events, hours, 0.9), limit_rate(events, hours, 0.99)
        assert wide[0] < narrow[0] < narrow[1] < wide[1]


def rows(*of: tuple[str, int, float, int, float], lost_mps: float = 1.0) -> pd.DataFrame:
    """Rows of `lists.parquet`: log, run, driving_s, brakes, needless_s."""
    table = pd.DataFrame(of, columns=["log", "run", "driving_s", "needless_brakes", "needless_s"])
    return table.assign(
        configuration="one", speed_lost_mps=lost_mps, must_brake_s=2.0, must_brake_missed_s=table["run"] / 2,
        lists=10, minutes=1.0, ghosts=0, stale_ghosts=0, duplicates=0,
    )  # fmt: skip


def summed(table: pd.DataFrame, **more: Any) -> Drives:
    drives = sum_drives(table, **more)
    assert drives is not None
    return drives


class TestDrives:
    THREE = (
        ("a", 0, 36.0, 2, 4.0), ("a", 1, 36.0, 4, 6.0), ("b", 0, 72.0, 0, 0.0), ("b", 1, 72.0, 0, 0.0),
        ("c", 0, 360.0, 1, 1.0), ("c", 1, 360.0, 2, 2.0),
    )  # fmt: skip

    def test_over_logs(self) -> None:
        """3, 0 and 1.5 brakes in 36, 72 and 360 s: runs add draws, no driving. 4.5 in .13 h; 5 + 1.5 of 468 s."""
        drives = summed(rows(*self.THREE))
        assert drives.over == "logs"
        assert drives.hours == pytest.approx([0.01, 0.02, 0.1])
        assert drives.brakes == pytest.approx([3.0, 0.0, 1.5])
        rate, share = drives.limit_rate(), drives.limit_share()
        assert rate.value == pytest.approx(4.5 / 0.13)
        assert (rate.low, rate.high) == pytest.approx(limit_rate(np.array([3, 0, 1.5]), np.array([0.01, 0.02, 0.1])))
        assert share.value == pytest.approx(6.5 / 468)
        assert share.low is not None
        assert share.high is not None
        assert 0 <= share.low < 6.5 / 468 < share.high <= 1
        assert drives.must_brake_s == pytest.approx(6.0)
        assert drives.missed_s == pytest.approx(3 * 0.25)

    def test_over_the_runs_of_one_log(self) -> None:
        """The driving of all runs counts: 6 brakes in .02 h."""
        drives = summed(rows(*self.THREE[:2]))
        assert drives.over == "runs"
        assert drives.brakes.tolist() == [2, 4]
        assert drives.hours == pytest.approx([0.01, 0.01])
        rate = drives.limit_rate()
        assert rate.value == pytest.approx(300)
        assert (rate.low, rate.high) == pytest.approx(limit_rate(np.array([2.0, 4]), np.array([0.01, 0.01])))
        assert drives.missed_s == pytest.approx(0.25)

    @pytest.mark.parametrize("table", [rows(*THREE[:4]), rows(THREE[0])])
    def test_neither_of_two_logs_nor_of_one_run(self, table: pd.DataFrame) -> None:
        drives = summed(table)
        assert drives.over is None
        for figure in (drives.limit_rate(), drives.limit_share()):
            assert figure.value is not None
            assert figure.low is None or math.isnan(figure.low)

    def test_over_the_runs_where_that_is_asked(self) -> None:
        """Of these logs: 3 and 6 brakes in .13 h each."""
        drives = summed(rows(*self.THREE), of_runs=True)
        assert drives.over == "runs"
        assert drives.brakes == pytest.approx([3.0, 6.0])
        assert drives.hours == pytest.approx([0.13, 0.13])
        assert drives.limit_rate().value == pytest.approx(4.5 / 0.13)

    def test_summed_by_log_gives_the_same(self) -> None:
        table = rows(*self.THREE)
        whole, of_sums = summed(table), summed(sum_lists(table))
        for name, value in vars(whole).items():
            assert np.array_equal(getattr(of_sums, name), value), name
        again = summed(sum_lists(pd.concat([sum_lists(table[table["run"] == k]) for k in (0, 1)])))
        assert again.brakes == pytest.approx(whole.brakes)
        assert again.hours == pytest.approx(whole.hours)

    def test_a_drive_that_stands_adds_nothing(self) -> None:
        standing = [("d", 0, 0.0, 0, 0.0), ("d", 1, 0.0, 0, 0.0)]
        without, drives = summed(rows(*self.THREE)), summed(rows(*self.THREE, *standing))
        assert drives.limit_share() == without.limit_share()
        assert drives.limit_rate() == without.limit_rate()
        two = summed(rows(*self.THREE[:4], *standing))
        assert two.over is None, "of two drives there are no limits"
        assert summed(rows(*self.THREE[:2], *standing)).over == "runs"

    def test_nobody_drives(self) -> None:
        """Null, not 0."""
        drives = summed(rows(("d", 0, 0.0, 0, 0.0), ("d", 1, 0.0, 0, 0.0), lost_mps=0.0))
        values = {metric.name: metric.value(drives) for metric in DRIVING}
        assert values.pop("driving_h") == 0
        assert values.pop("needless_interval_over") in (None, "runs")
        assert set(values.values()) == {None}
        assert {RATE, SHARE, "needless_speed_lost_max_mps"} <= values.keys()

    def test_not_measured(self) -> None:
        table = rows(*self.THREE).drop(columns="needless_brakes")
        assert sum_drives(table) is None
        assert sum_drives(None) is None
