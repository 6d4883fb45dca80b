"""Global nearest neighbour fusion: one optimal assignment per list, every instant by itself."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from copem_replay.core.components import NotNegative, Share
from copem_replay.core.object_list import Entries, Inputs, ObjectLists, view_as_numbers
from copem_replay.core.tracks import AGREE
from copem_replay.fusion.combine import (
    CROSS,
    INVERSE,
    SPLIT_BY_SHARE,
    SPLIT_BY_VARIANCE,
    combine_members,
    unite_conflicting,
)
from copem_replay.fusion.gnn_kernel import EntryClusters, cluster_run, intersect_clusters
from copem_replay.fusion.interface import ListFusion
from copem_replay.fusion.union import join_runs

Gate = Annotated[float, Field(strict=True, gt=0, lt=1)]

_KEYS_OF: dict[str, dict[str, float]] = {
    "split_covariance_intersection": {"dependent_share": 0.5, "dependent_m2": 0.0},
    "cross_covariance": {"correlation": 0.5},
    "covariance_union": {"conflict_gate": 0.99},  # as wide as `gate`
}
"""Keys that only one way to combine has, with their defaults (`dependent_m2` stands in place of the share)."""


def _is_absent(value: object) -> bool:
    return value is None


class Gnn(ListFusion):
    """Every unit's newest list associated and combined anew at each instant: nothing is remembered or predicted.

    List after list, newest capture first, the entries are assigned to the clusters so far at least total cost d² +
    ln|S|, S = P_cluster + P_entry, where d² = νᵀS⁻¹ν is within `gate` (the share of true pairs inside: χ², two degrees
    of freedom) and the classes agree; an entry that is left founds a cluster. A cluster has at most one entry of a
    unit. The members' positions are combined by `combine`: inverse variance (independent errors) or covariance
    intersection (any correlation; of least trace or, `minimise`, determinant), in closed form if fast, which gives the
    best member where that is better; inverse covariance intersection (common information, counted once); split
    covariance intersection (a part of each stated covariance, `dependent_share`, or `dependent_m2` per axis, is
    correlated in any way, the rest is independent); cross covariance (every two errors are correlated by
    `correlation`); covariance union (inverse variance, but clusters whose classes agree and whose boxes overlap, no
    list having both, are one object in conflict: members beyond `conflict_gate` of the others are united with them, so
    that the result covers whichever is right). Existence is 1 − Π(1 − pₙ), class probabilities are the mean; height,
    velocity, size and yaw (on the circle) the mean by inverse trace of the position covariance. Source: S. Blackman, R.
    Popoli, "Design and Analysis of Modern Tracking Systems", 1999 (assignment, its cost and gate); fusion/covariance.py
    and the files beside it, and for the running state by which clusters that do not count all as independent are
    compared W. Niehsen, "Information fusion based on fast covariance intersection filtering", FUSION 2002. Assumes
    Gaussian position errors of the stated covariance without bias, and lists of about one instant. A stale list of a
    moving object, a biased unit or too small a covariance leaves it as a duplicate; objects closer than the gate may
    swap or merge members; inverse variance counts repeated information as often as units state it; existence always
    does.
    """

    kind: Literal["gnn"] = "gnn"
    combine: Literal[
        "inverse_variance", "covariance_intersection", "fast_covariance_intersection",
        "inverse_covariance_intersection", "split_covariance_intersection", "cross_covariance", "covariance_union",
    ] = "inverse_variance"  # fmt: skip
    minimise: Literal["trace", "determinant"] = "trace"
    gate: Gate = 0.99
    min_existence: Share = 0.0
    # Defaults where they are absent: half of everything, and `gate` (see _KEYS_OF).
    dependent_share: Share | None = Field(None, exclude_if=_is_absent)
    dependent_m2: NotNegative | None = Field(None, exclude_if=_is_absent)
    correlation: Annotated[float, Field(strict=True, ge=0, lt=1)] | None = Field(None, exclude_if=_is_absent)
    conflict_gate: Gate | None = Field(None, exclude_if=_is_absent)

    resumable: ClassVar[bool] = True

    @model_validator(mode="before")
    @classmethod
    def _said(cls, values: Any) -> Any:
        """The keys with defaults of the way to combine, so that an experiment that is written back has them."""
        if not isinstance(values, dict):
            return values
        defaults = dict(_KEYS_OF.get(str(values.get("combine")), {}))
        if "conflict_gate" in defaults:
            defaults["conflict_gate"] = values.get("gate", defaults["conflict_gate"])
        if any(values.get(name) is not None for name in defaults):
            return values
        return {name: value for name, value in defaults.items() if name != "dependent_m2"} | {
            name: value for name, value in values.items() if name not in defaults
        }

    @model_validator(mode="after")
    def _of_one_kind(self) -> Self:
        for combine, own in _KEYS_OF.items():
            for name in own:
                if getattr(self, name) is not None and self.combine != combine:
                    raise ValueError(f"{name}: expected only with combine: {combine}, found with {self.combine}")
        if self.dependent_share is not None and self.dependent_m2 is not None:
            raise ValueError("dependent_m2: expected alone, found beside dependent_share: leave one of them out")
        return self

    @property
    def _method(self) -> tuple[int, float] | None:
        """The method of `combine_members` and its setting; None: members are combined in another way."""
        if self.combine == "inverse_covariance_intersection":
            return INVERSE, 0.0
        for method, setting in (
            (SPLIT_BY_SHARE, self.dependent_share), (SPLIT_BY_VARIANCE, self.dependent_m2), (CROSS, self.correlation),
        ):  # fmt: skip
            if setting:  # 0 is inverse variance
                return method, setting
        return None

    def fuse(self, inputs: Inputs) -> ObjectLists:
        """The fused lists of each run: clusters by one optimal assignment per list, members combined by `combine`."""
        runs = []
        method = self._method
        informed = method is None and self.combine not in ("covariance_intersection", "fast_covariance_intersection")
        for bounds in inputs.lists.start:
            entries = inputs.lists.entries[bounds[0] : bounds[-1]]
            clusters, fused = cluster_run(
                entries, view_as_numbers(entries), bounds - bounds[0], inputs.captured_s, inputs.arrives_s,
                inputs.newest, AGREE, -2 * math.log1p(-self.gate), informed, self.min_existence,
            )  # fmt: skip
            if method is not None:
                combine_members(clusters, *method, self.minimise == "determinant", fused)
            elif self.combine == "covariance_union":
                clusters, fused = self._united(clusters, fused, entries, inputs)
            elif not informed:
                fast = self.combine == "fast_covariance_intersection"
                intersect_clusters(clusters, self.minimise == "determinant", fast, fused)
            runs.append((clusters.start, fused))
        return join_runs(runs, len(inputs.issue_s))

    def _united(
        self, clusters: EntryClusters, fused: Entries, entries: Entries, inputs: Inputs
    ) -> tuple[EntryClusters, Entries]:
        """The clusters and their entries, those in conflict joined."""
        gate = -2 * math.log1p(-(self.gate if self.conflict_gate is None else self.conflict_gate))
        return unite_conflicting(clusters, fused, entries, inputs.arrives_s, AGREE, gate)
