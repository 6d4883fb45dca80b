"""Non-maximum suppression: of entries that overlap the most certain one is kept, and nothing is averaged."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np

from copem_replay.core.compiled import callee, kernel
from copem_replay.core.components import Positive, Share
from copem_replay.core.geometry import rotated_iou
from copem_replay.core.object_list import Entries, Inputs, ObjectLists, most_probable_classes, view_as_numbers
from copem_replay.core.tracks import AGREE, Bool, Float, Int
from copem_replay.fusion.inputs import WIDTH, sort_rows
from copem_replay.fusion.interface import ListFusion
from copem_replay.fusion.union import gather_newest_rows, join_runs


class Nms(ListFusion):
    """Greedy non-maximum suppression over every unit's newest list, the usual late fusion of cooperative detection.

    Entries with an existence below `min_existence` are left out. The others are taken by falling existence (of equals
    the smaller trace of covariance, then the newer capture, then x and y), and each is kept unless its class agrees
    with that of one kept already and the two overlap: their boxes by more than `iou` (intersection over union), or,
    `by: centre`, their centres are within `radius_m`. Entries that are kept are unchanged. Source: R. Xu et al.,
    "OPV2V", ICRA 2022, which has these thresholds of existence and overlap; the radius is chosen. Assumes that the most
    confident unit is the most accurate one and that boxes of one object overlap. Position errors of the order of the
    box (pedestrians; stale lists; entries without a size) leave duplicates, objects closer than the threshold suppress
    each other, and where all units claim certainty the smallest stated covariance decides.
    """

    kind: Literal["nms"] = "nms"
    by: Literal["iou", "centre"] = "iou"
    iou: Share = 0.15
    radius_m: Positive = 2.0
    min_existence: Share = 0.2

    resumable: ClassVar[bool] = True

    def fuse(self, inputs: Inputs) -> ObjectLists:
        """The lists of each run without entries that overlap a more certain one; entries stay as they are."""
        runs = []
        for run in inputs.lists.start:
            bounds = run - run[0]
            entries = inputs.lists.entries[run[0] : run[-1]]
            start, rows = gather_newest_rows(bounds, inputs.newest, entries["existence"] >= self.min_existence)
            kind = most_probable_classes(np.ascontiguousarray(entries["class_probability"]))
            # Entries closer than the sum of their reaches: boxes may overlap, centres are within the radius.
            reach_m = np.full(len(entries), self.radius_m / 2)
            if self.by == "iou":
                reach_m = np.hypot(entries["length_m"], entries["width_m"]) / 2
            place = np.stack([entries["x_m"], entries["y_m"], reach_m])
            start, kept_rows = _suppress_overlapping(
                entries,
                place,
                kind,
                _order_entries(entries, bounds, inputs),
                start,
                rows,
                AGREE,
                self.by == "iou",
                self.iou,
            )
            runs.append((start, entries[kept_rows]))
        fused = join_runs(runs, len(inputs.issue_s))
        fused.entries["track_id"] = -1
        return fused


def _order_entries(entries: Entries, bounds: Int, inputs: Inputs) -> Int:
    """(N,) entries in the order in which they are considered: the most certain first, then the first to arrive."""
    f = np.repeat(np.arange(len(bounds) - 1), np.diff(bounds))
    keys = np.column_stack(
        [
            -entries["existence"], entries["cov_ee_m2"] + entries["cov_nn_m2"], -entries["captured_s"],
            view_as_numbers(entries)[:, :WIDTH], inputs.arrives_s[f], inputs.unit_ix[f],
        ]
    )  # fmt: skip
    order = np.arange(len(entries))
    sort_rows(keys, order)
    return order


@kernel
def _suppress_overlapping(
    entries: Entries, place: Float, kind: Int, order: Int, start: Int, rows: Int, agree: Bool, by_iou: bool, iou: float
) -> tuple[Int, Int]:
    """(K + 1,) where the kept entries of each instant begin, and their rows. `place (3, N)`: x, y, reach (m)."""
    kept_rows, kept_start = np.empty_like(rows), np.zeros_like(start)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    n = 0
    for k in range(len(start) - 1):
        for r in order[np.sort(rank[rows[start[k] : start[k + 1]]])]:
            is_free = True
            for q in range(kept_start[k], n):
                s = kept_rows[q]
                dx, dy, reach = place[0, r] - place[0, s], place[1, r] - place[1, s], place[2, r] + place[2, s]
                if dx * dx + dy * dy > reach * reach or not agree[kind[r], kind[s]]:
                    continue
                if not by_iou or _iou_of_entries(entries[r], entries[s]) > iou:
                    is_free = False
                    break
            if is_free:
                kept_rows[n] = r
                n += 1
        kept_start[k + 1] = n
    return kept_start, kept_rows[:n].copy()


@callee
def _iou_of_entries(a: Any, b: Any) -> float:
    share: float = rotated_iou(
        a.x_m, a.y_m, a.yaw_rad, a.length_m, a.width_m, b.x_m, b.y_m, b.yaw_rad, b.length_m, b.width_m
    )
    return share
