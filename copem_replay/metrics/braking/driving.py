"""What false alarms cost over drives: how often the driver brakes for nothing, for how much of the time, how hard.

From rows of `lists.parquet` (`metrics/braking/needless.py` defines their columns). Runs add draws and no driving: the
events of a drive are the mean over its runs, its hours count once. A log in which the ego does not drive is no drive.
Limits are over logs, from three on; over the runs of a single one, where they tell of other draws alone; of two logs
there are none.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.tracks import Float
from copem_replay.metrics.limits import CONFIDENCE, FEWEST_LOGS, LimitedFigure, limit_left_out, limit_rate
from copem_replay.metrics.metric import Compared, Metric, MetricInputs

if TYPE_CHECKING:
    import pandas as pd

JUDGED_DRIVING = RATE, SHARE = "needless_brakes_per_h", "needless_brake_share"
"""Metrics that are held against bounds."""


@dataclass(frozen=True)
class Drives:
    """Driving and needless braking of one configuration in K drives, or in K runs of one drive (`over`).

    `brakes`: how many, the mean over runs. `over`: what limits are over; None: of two logs there are none.
    """

    hours: Float
    brakes: Float
    needless_h: Float
    speed_lost_mps: float
    must_brake_s: float
    missed_s: float
    over: str | None

    def limit_rate(self, confidence: float = CONFIDENCE) -> LimitedFigure:
        """Needless brakes per hour of driving; value None: nobody drives."""
        if not self.hours.sum() > 0:
            return LimitedFigure(None)
        value = float(self.brakes.sum() / self.hours.sum())
        if self.over is None:
            return LimitedFigure(value)
        low, high = limit_rate(self.brakes, self.hours, confidence)
        return LimitedFigure(value, low, high, "exact")

    def limit_share(self, confidence: float = CONFIDENCE) -> LimitedFigure:
        """The share of the driving time with needless braking, with limits; value None: nobody drives."""
        total = float(self.hours.sum())
        if not total > 0:
            return LimitedFigure(None)
        value = float(self.needless_h.sum()) / total
        if self.over is None:
            return LimitedFigure(value)
        share_without_each = (self.needless_h.sum() - self.needless_h) / (total - self.hours)
        by_run = self.over == "runs"
        mean_drive_h = None if by_run else float((self.hours**2).sum() / total)
        runs = len(self.hours) if by_run else 0
        return limit_left_out(value, share_without_each, self.hours, (0.0, 1.0), confidence, mean_drive_h, runs)

    def limit(self, metric: str, confidence: float) -> LimitedFigure:
        """`limit_rate` or `limit_share`, by the name of the figure: `RATE` or `SHARE`."""
        return self.limit_rate(confidence) if metric == RATE else self.limit_share(confidence)


def sum_drives(rows: pd.DataFrame | None, *, of_runs: bool = False) -> Drives | None:
    """The drives of a configuration; None: needless braking is not measured.

    `rows`: of `lists.parquet`, or summed by log (`sum_lists`), with a column `runs`. `of_runs`: limits are over runs,
    whatever logs there are.
    """
    if rows is None or "needless_brakes" not in rows:
        return None
    rows = (rows if "runs" in rows else rows.assign(runs=1))[rows["driving_s"] > 0]
    names = ["runs", "driving_s", "needless_brakes", "needless_s", "must_brake_s", "must_brake_missed_s"]
    by_log = rows.groupby("log", sort=False)[names].sum()
    over = "logs" if len(by_log) >= FEWEST_LOGS else None
    totals, times = by_log, by_log["runs"]
    if (of_runs or len(by_log) == 1) and "run" in rows and rows["run"].nunique() > 1:
        over, totals = "runs", rows.groupby("run", sort=True)[names].sum()
        times = totals["runs"] / len(by_log)
    hours, brakes, needless = (totals[name].to_numpy(dtype=float) / times.to_numpy(dtype=float) for name in names[1:4])
    must_brake_s, missed_s = (float((by_log[name] / by_log["runs"]).sum()) for name in names[4:])
    lost_mps = float(rows["speed_lost_mps"].max())
    return Drives(hours / 3600, brakes, needless / 3600, lost_mps, must_brake_s, missed_s, over)


def _measure(inputs: MetricInputs) -> Drives | None:
    return sum_drives(inputs.driving)


def _hours(drives: Drives) -> float:
    return float(drives.hours.mean() if drives.over == "runs" else drives.hours.sum())


def _end(limit: Callable[[Drives], LimitedFigure], end: str) -> Callable[[Drives], float | None]:
    def value(drives: Drives) -> float | None:
        number = getattr(limit(drives), end)
        return None if number is None or np.isnan(number) else float(number)

    return value


def _if_driving(name: str) -> Callable[[Drives], float | None]:
    return lambda drives: getattr(drives, name) if drives.hours.sum() > 0 else None


DRIVING = (
    Metric("driving_h", _measure, _hours, 0, "hours in which the ego drives, at `slower_mps` or faster", "needless",
           "hours of driving"),
    Metric(RATE, _measure, _end(Drives.limit_rate, "value"), -1,
           "how often the driver brakes for nothing, per hour of driving", "needless", "brakes for nothing per hour"),
    Metric(f"{RATE}_low", _measure, _end(Drives.limit_rate, "low"), 0, f"lower limit of {RATE}, 95 %"),
    Metric(f"{RATE}_high", _measure, _end(Drives.limit_rate, "high"), 0, f"upper limit of {RATE}, 95 %"),
    Metric(SHARE, _measure, _end(Drives.limit_share, "value"), -1,
           "share of the driving time in which the driver brakes for nothing", "needless",
           "time braking for nothing, %",
           Compared("share of the driving time with needless braking", "needless time", ("lists.parquet",))),
    Metric(f"{SHARE}_low", _measure, _end(Drives.limit_share, "low"), 0, f"lower limit of {SHARE}, 95 %"),
    Metric(f"{SHARE}_high", _measure, _end(Drives.limit_share, "high"), 0, f"upper limit of {SHARE}, 95 %"),
    Metric("needless_interval_over", _measure, lambda of: of.over, 0,
           "what the limits of needless braking are over: logs; runs of one log, which tell of other draws alone", "",
           kind="text", among=("logs", "runs")),
    Metric("needless_speed_lost_max_mps", _measure, _if_driving("speed_lost_mps"), -1,
           "the most speed that braking for nothing takes at once, in any run", "needless",
           "most speed lost for nothing, m/s"),
    Metric("must_brake_s", _measure, _if_driving("must_brake_s"), 0,
           "seconds in which the driver must brake by the truth, all logs", "needless", "must brake by the truth, s"),
    Metric("must_brake_missed_s", _measure, _if_driving("missed_s"), -1,
           "of these, seconds in which he does not by the lists, mean over runs", "needless",
           "of it missed by the lists, s"),
)  # fmt: skip
"""Columns of `summary.csv` where a driver is asked when he brakes for nothing."""
