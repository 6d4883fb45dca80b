"""Global nearest neighbour: one optimal assignment per list, every instant for itself."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from copem_replay.core.agree import AGREE
from copem_replay.core.components import Share
from copem_replay.core.object_list import ENTRY, Entries, Inputs, ObjectLists
from copem_replay.core.tracks import Float
from copem_replay.fusion.base import ListFusion
from copem_replay.fusion.gnn_kernel import fuse_run, intersect
from copem_replay.fusion.union import run_after_run


class Gnn(ListFusion):
    """Every unit's newest list associated and combined anew at each instant: nothing is remembered or predicted.

    List after list, newest capture first, the entries are assigned to the clusters so far at least total cost d² +
    ln|S|, S = P_cluster + P_entry, where d² = νᵀS⁻¹ν is within `gate` (the share of true pairs inside: χ², two degrees
    of freedom) and the classes agree; whoever is left founds a cluster. No unit is twice in one. The members' positions
    are combined by `combine`: inverse variance (independent errors) or covariance intersection (any correlation; of
    least trace or, `minimise`, determinant), in closed form if fast, which gives the best member where that is better.
    Existence is 1 − Π(1 − pₙ), class probabilities are the mean; height, velocity, size and yaw (on the circle) the
    mean by inverse trace of the position covariance. Source: S. Blackman, R. Popoli, "Design and Analysis of Modern
    Tracking Systems", 1999 (assignment, its cost and gate); fusion/covariance.py, and for the running state by which
    intersecting clusters are compared W. Niehsen, "Information fusion based on fast covariance intersection filtering",
    FUSION 2002. Assumes Gaussian position errors of the stated covariance without bias, and lists of about one instant.
    A stale list of a moving object, a biased unit or too small a covariance leaves it as a duplicate; objects closer
    than the gate may swap or merge members; units that repeat each other are counted as often as they speak, unless
    covariances are intersected; existence always is.
    """

    kind: Literal["gnn"] = "gnn"
    combine: Literal["inverse_variance", "covariance_intersection", "fast_covariance_intersection"] = "inverse_variance"
    minimise: Literal["trace", "determinant"] = "trace"
    gate: Annotated[float, Field(strict=True, gt=0, lt=1)] = 0.99
    min_existence: Share = 0.0

    resumable: ClassVar[bool] = True

    def fuse(self, inputs: Inputs) -> ObjectLists:
        """Every run by itself."""
        runs = []
        informed = self.combine == "inverse_variance"
        for bounds in inputs.lists.start:
            entries = inputs.lists.entries[bounds[0] : bounds[-1]]
            clusters, fused = fuse_run(
                entries, numbers(entries), bounds - bounds[0], inputs.captured_s, inputs.arrives_s, inputs.newest,
                AGREE, -2 * math.log1p(-self.gate), informed, self.min_existence,
            )  # fmt: skip
            if not informed:
                fast = self.combine == "fast_covariance_intersection"
                intersect(clusters, self.minimise == "determinant", fast, fused)
            runs.append((clusters.start, fused))
        return run_after_run(runs, len(inputs.issue_s))


def numbers(entries: Entries) -> Float:
    """The same memory as rows of numbers, x and y first; whatever is an integer is none of them (see WIDTH)."""
    values: Float = np.ascontiguousarray(entries).view(np.float64).reshape(len(entries), ENTRY.itemsize // 8)
    return values
