"""Clusters of entries combined where errors hang together: position and covariance of each, from all its members.

Members stand in an order that only their content decides (fusion/gnn_kernel.py), so methods that combine one after the
other may take them as they stand.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from copem_replay.core.object_list import Entries
from copem_replay.core.tracks import Float
from copem_replay.fusion.covariance import covariance_intersection
from copem_replay.fusion.cross_covariance import by_cross_covariance
from copem_replay.fusion.gnn_kernel import Clusters
from copem_replay.fusion.inverse_intersection import inverse_covariance_intersection
from copem_replay.fusion.split_intersection import split_by_share, split_by_variance, split_covariance_intersection

INVERSE, SPLIT_BY_SHARE, SPLIT_BY_VARIANCE, CROSS = 0, 1, 2, 3


@nb.njit(cache=True, nogil=True)
def combine_members(clusters: Clusters, method: int, setting: float, by_determinant: bool, fused: Entries) -> None:
    """Writes positions and covariances of the clusters, in place; one entry alone stays as it is.

    `setting`: the dependent share, the dependent variance in m², or the correlation, as the method asks.
    """
    for c in range(len(fused)):
        members = clusters.member[clusters.begin[c] : clusters.begin[c + 1]]
        if len(members) == 1:
            continue
        x, cov = np.empty((len(members), 2)), np.empty((len(members), 2, 2))
        for i in range(len(members)):
            point = clusters.points[members[i]]
            x[i, 0], x[i, 1] = point.x_m, point.y_m
            cov[i, 0, 0], cov[i, 0, 1], cov[i, 1, 0], cov[i, 1, 1] = point.ee, point.en, point.en, point.nn
        if method == INVERSE:
            mean, P = inverse_covariance_intersection(x, cov, by_determinant)
        elif method == CROSS:
            mean, P = by_cross_covariance(x, cov, setting)
        else:
            mean, P = _split(x, cov, method, setting, by_determinant)
        fused[c].x_m, fused[c].y_m = mean[0], mean[1]
        fused[c].cov_ee_m2, fused[c].cov_en_m2, fused[c].cov_nn_m2 = P[0, 0], P[0, 1], P[1, 1]


@nb.njit(cache=True, nogil=True)
def _split(x: Float, cov: Float, method: int, setting: float, by_determinant: bool) -> tuple[Float, Float]:
    """Split covariance intersection; plain, where nothing is independent: its weights are shared out evenly."""
    if method == SPLIT_BY_SHARE:
        dependent, independent = split_by_share(cov, setting)
    else:
        dependent, independent = split_by_variance(cov, setting)
    if not independent.any():
        mean, P, _ = covariance_intersection(x, cov, by_determinant)
        return mean, P
    mean, P, _, _ = split_covariance_intersection(x, dependent, independent, by_determinant)
    return mean, P
