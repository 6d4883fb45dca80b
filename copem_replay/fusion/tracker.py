"""The tracker: a Kalman filter per object over all lists that arrive, with three ways to use lists that come late."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from copem_replay.core.components import NotNegative, Positive, Share
from copem_replay.core.interpolation import wrap_angles
from copem_replay.core.object_list import Inputs, ObjectLists, TellsOf, view_as_numbers
from copem_replay.core.tracks import AGREE, Int
from copem_replay.fusion.inputs import WIDTH, order_by_content
from copem_replay.fusion.interface import ListFusion
from copem_replay.fusion.tracker_kernel import (
    PREDICT,
    REPLAY,
    STALE,
    HeardLists,
    StoredMemory,
    TrackerRules,
    empty_memory,
    track_run,
)
from copem_replay.fusion.union import join_runs

_LATE = {"stale": STALE, "predict": PREDICT, "replay": REPLAY}


class Tracker(ListFusion):
    """A constant-velocity Kalman filter per object, updated by every list that arrives, late ones included.

    List after list, entries are assigned to tracks at least total cost d² + ln|S|, S = P + R, where d² is within `gate`
    (the share of true pairs inside: χ², two degrees of freedom) and the classes agree; an entry that is left founds a
    track with its own velocity ± `speed_sigma_mps` per axis. Later velocities are not used. `late` says how a list that
    shows the past is used: `stale`, as if it showed the present, unless a newer one of its unit is there; `predict`,
    its entries are moved to now by their own velocities, R growing by q·age³/3; `replay`, it is processed at its
    capture, and all later captures again, with the same result as if it had come in time; a list older than `buffer_s`
    is ignored. A unit's last claimed existence of a track fades with `forget_s`, existence is 1 − Π(1 −
    cₙe^(−age/forget)), so that it depends on time and not on the rate of lists; a track ends when it is not above
    `drop`. Ages count from capture (`stale`: from arrival), and a unit's last claim is the one captured last, in
    whatever order lists come. Claims of units with partial messages fade only after the receiver's `max_age_s`. A track
    is published above `publish`, when the captures that support it span `confirm_s`. Of two tracks as close as two
    entries of one object may be (d² within the median of χ²), which no list held both for `forget_s`, the younger ends.
    Yaw and height above ground are the newest entry's, size and class probabilities the mean of all. `errors_last_s` τ:
    the position errors of one unit about one object decay as e^(−Δ/τ), so an entry counts as a fresh one of R·(1 +
    φ)/(1 − φ), φ = e^(−Δ/τ) of the time since that unit's last about the track; the first counts fully, and an object
    at rest gets the variance of the best linear estimate. `common_share`: this share of each R may be correlated with
    anything, and does not shrink (split covariance intersection); `errors_last_s` then applies to the rest. Source: Y.
    Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001. Assumes white
    acceleration of density q = `acceleration_psd_m2ps3`, Gaussian position errors of the stated covariance, independent
    between lists and units where these two do not say otherwise, without bias. A turning or braking object lags behind,
    its track too sure of itself; a biased unit, or one whose errors persist, splits objects or pulls them along; an
    object not listed beside its neighbour can be taken for it as long as it is within the gate.
    """

    kind: Literal["tracker"] = "tracker"
    late: Literal["stale", "predict", "replay"] = "predict"
    # The defaults are round numbers; for `gate` and `forget_s` see docs/develop/decisions/fusion.md.
    acceleration_psd_m2ps3: Positive = 1.0
    speed_sigma_mps: Positive = 3.0
    gate: Annotated[float, Field(strict=True, gt=0, lt=1)] = 0.999
    forget_s: Positive = 1.0
    publish: Share = 0.5
    drop: Share = 0.05
    confirm_s: NotNegative = 0.1
    buffer_s: Positive = 2.0
    # None: errors are fresh in every list, and independent.
    errors_last_s: Positive | None = Field(None, exclude_if=lambda value: value is None)
    common_share: Share | None = Field(None, exclude_if=lambda value: value is None)

    @model_validator(mode="after")
    def _ends(self) -> Self:
        if self.drop > self.publish:
            raise ValueError(f"drop: expected at most publish ({self.publish}), found {self.drop}")
        return self

    resumable: ClassVar[bool] = True
    remembers: ClassVar[bool] = True
    # `stale`, too: it takes late lists for the present, so it claims to show that.
    tells_of: ClassVar[TellsOf] = "now"

    @property
    def looks_back_s(self) -> float:
        """Seconds for which earlier lists are received again."""
        return self.buffer_s if self.late == "replay" else 0.0

    def fuse(self, inputs: Inputs) -> ObjectLists:
        """Fuse every run by itself, instant after instant."""
        return self.resume(inputs, None)[0]

    def resume(
        self, inputs: Inputs, memory: Sequence[StoredMemory] | None
    ) -> tuple[ObjectLists, Sequence[StoredMemory]]:
        """The lists at the next instants, and the memory (tracks) of each run after them; `memory` None: none yet."""
        keeps_s = np.zeros(len(inputs.units)) if inputs.keeps_s is None else inputs.keeps_s
        rules = TrackerRules(
            _LATE[self.late], self.acceleration_psd_m2ps3, self.speed_sigma_mps**2, -2 * math.log1p(-self.gate),
            self.forget_s, self.publish, self.drop, self.confirm_s, self.buffer_s, AGREE,
            self.errors_last_s or 0.0, self.common_share or 0.0, keeps_s, self.forget_s + keeps_s.max(initial=0.0),
        )  # fmt: skip
        arrived, start = _select_arrivals(inputs) if self.late == "stale" else (inputs.arrived, inputs.arrived_start)
        memories = memory or [empty_memory(len(inputs.units))] * len(inputs.lists.start)
        runs = [
            track_run(_gather_lists(inputs, s), rules, memory_of_run, inputs.issue_s, arrived, start)
            for s, memory_of_run in enumerate(memories)
        ]
        fused = join_runs([(starts, entries) for starts, entries, _ in runs], len(inputs.issue_s))
        fused.entries["yaw_rad"] = wrap_angles(fused.entries["yaw_rad"])
        return fused, [memory_of_run for _, _, memory_of_run in runs]


def _select_arrivals(inputs: Inputs) -> tuple[Int, Int]:
    """(A,) lists that arrive before any newer one of their unit, and (K + 1,) where those of each instant begin."""
    instant = np.repeat(np.arange(len(inputs.issue_s)), np.diff(inputs.arrived_start))
    newest = inputs.newest[instant, inputs.unit_ix[inputs.arrived]]
    in_order = newest == inputs.arrived
    if inputs.keeps_s is not None:  # `newest` of a unit with partial messages is no list that arrived
        in_order |= (newest >= 0) & (inputs.captured_s[newest] == inputs.captured_s[inputs.arrived])
    start = np.append(0, np.cumsum(np.bincount(instant[in_order], minlength=len(inputs.issue_s))))
    return inputs.arrived[in_order], start.astype(np.int64)


def _gather_lists(inputs: Inputs, run: int) -> HeardLists:
    """The lists of the units in one run, entries in order of content."""
    lists = inputs.lists
    entries = np.ascontiguousarray(lists.entries[lists.start[run, 0] : lists.start[run, -1]])
    start = lists.start[run] - lists.start[run, 0]
    content = np.ascontiguousarray(view_as_numbers(entries)[:, :WIDTH])  # else one row has another type, compiled anew
    return HeardLists(start, order_by_content(start, content), entries, content, inputs.captured_s, inputs.unit_ix)
