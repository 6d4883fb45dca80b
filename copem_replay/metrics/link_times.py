"""What happens to lists on links, for configurations that name one."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import partial

import numpy as np

from copem_replay.communication.arrivals import out_of_sequence, overtaken
from copem_replay.core.tracks import Float, Tracks
from copem_replay.metrics.metric import Given, Metric


@dataclass(frozen=True)
class LinkTimes:
    """Sums over the lists that units send: how many, lost, and overtaken by a newer one of their unit.

    `from_s`, `to_s (N,)`: between which ages the newest list of a unit that has arrived grew older, piece by piece.
    """

    sent: int
    lost: int
    overtaken: int
    from_s: Float
    to_s: Float

    def __add__(self, other: LinkTimes) -> LinkTimes:
        return LinkTimes(
            self.sent + other.sent, self.lost + other.lost, self.overtaken + other.overtaken,
            np.concatenate([self.from_s, other.from_s]), np.concatenate([self.to_s, other.to_s]),
        )  # fmt: skip

    def age_s(self, q: float) -> float | None:
        """The age that it has no more than for a share q of the time, of all units and runs; None: nothing arrived."""
        ages = np.concatenate([self.from_s, self.to_s])
        order = np.argsort(ages, kind="stable")
        step = np.concatenate([np.ones(len(self.from_s)), -np.ones(len(self.to_s))])[order]
        passed = np.concatenate([[0.0], np.cumsum(np.cumsum(step)[:-1] * np.diff(ages[order]))]) if len(ages) else ages
        return float(np.interp(q * passed[-1], passed, ages[order])) if len(ages) and passed[-1] > 0 else None


def link_times(seen: Tracks, arriving: Tracks, heard: Tracks, units: Collection[str], end_s: float) -> LinkTimes:
    """Of lists that some units send in one run, `seen` as they are sent, to a log's end.

    `arriving`: as they arrive, by which they are overtaken or not; `heard`: as the receiver takes them in.
    """
    arrives_s, late = heard.common_arrives_s, out_of_sequence(heard)
    made = np.isfinite(seen.common_arrives_s)
    made &= np.array([name in units for name in heard.units], dtype=bool)[heard.frame_unit_ix]
    came = made & np.isfinite(arrives_s)
    parts: list[tuple[Float, Float]] = []
    for unit in np.unique(heard.frame_unit_ix[made]):
        mine = np.flatnonzero((heard.frame_unit_ix == unit) & ~late & (arrives_s <= end_s))
        mine = mine[np.argsort(arrives_s[mine], kind="stable")]
        until_s = np.append(arrives_s[mine][1:], end_s)
        parts.append((arrives_s[mine] - heard.captured_s[mine], until_s - heard.captured_s[mine]))
    from_s, to_s = (np.concatenate([np.empty(0), *(part[k] for part in parts)]) for k in (0, 1))
    return LinkTimes(int(made.sum()), int((made & ~came).sum()), int((came & overtaken(arriving)).sum()), from_s, to_s)


def _times(given: Given) -> LinkTimes | None:
    return given.link


def _share(part: int, whole: int) -> float | None:
    return part / whole if whole else None


_row = partial(Metric, statistics=_times, better=-1, part="link")
LINK = (
    _row("lost_share", value=lambda of: _share(of.lost, of.sent),
         help="share of the lists sent by a link that it loses"),
    _row("age_of_information_p50_s", value=lambda of: of.age_s(0.5),
         help="age since capture of a unit's newest list that arrived by a link: at most this for 50 % of the time"),
    _row("age_of_information_p95_s", value=lambda of: of.age_s(0.95), help="the same for 95 % of the time"),
    _row("overtaken_share", value=lambda of: _share(of.overtaken, of.sent - of.lost),
         help="share of the arriving lists that come after a newer one of their unit; ideal fusion and trackers still "
              "use them, and all fusions do where messages are partial"),
)  # fmt: skip
"""Columns of `summary.csv` where a configuration has a link."""
