"""Global nearest neighbour in NumPy and SciPy: what the fast code of the package is held against, and raced against.

The same algorithm (see copem_replay/fusion/gnn.py), vectorised over entries and clusters, with dense matrices: all
pairs are looked at, and `scipy.optimize.linear_sum_assignment` assigns. Position covariances are positive definite.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely
import shapely.affinity
from numba import njit
from scipy.optimize import linear_sum_assignment, minimize
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from copem_replay.core.object_list import Entries, Inputs, ObjectLists, entries_of
from copem_replay.core.tracks import CLASS_GROUPS, CLASSES
from copem_replay.fusion.combine import covariance_union
from tests.helpers.reports import inputs_of
from tests.oracles import correlated

covariance_union = njit(covariance_union)  # as kernels call it

Array = npt.NDArray[Any]


def fuse(
    inputs: Inputs,
    *,
    combine: str = "inverse_variance",
    minimise: str = "trace",
    gate: float = 0.99,
    min_existence: float = 0.0,
    setting: float = 0.0,
) -> ObjectLists:
    """The fused lists of all runs."""
    ends, fused = [], [entries_of(0)]
    total = 0
    for run in range(len(inputs.lists.start)):
        ends.append([total])
        for newest in inputs.newest:
            lists = []
            for f in newest[newest >= 0]:
                one = inputs.lists.of(run, f)
                lists.append((one[one["existence"] >= min_existence], inputs.captured_s[f], inputs.arrives_s[f]))
            fused.append(fuse_instant(lists, combine=combine, minimise=minimise, gate=gate, setting=setting))
            total += len(fused[-1])
            ends[-1].append(total)
    return ObjectLists(np.array(ends, dtype=np.int64), np.concatenate(fused))


def fuse_instant(
    lists: Sequence[tuple[Entries, float, float]], *, combine: str, minimise: str, gate: float, setting: float = 0.0
) -> Entries:
    """One fused list from (entries, captured, arrives) of each unit.

    `setting`: the one number of a way to combine (share, variance in m², correlation, gate of conflicts).
    """
    entries, captured_s, arrives_s, bounds = _stacked(lists)
    if len(entries) == 0:
        return entries_of(0)
    independent = combine in ("inverse_variance", "covariance_union")
    cluster = _clusters(entries, bounds, -2 * math.log(1 - gate), independent)
    if combine == "covariance_union":
        said = np.repeat(np.arange(len(bounds) - 1), np.diff(bounds))
        found = _summaries(entries, captured_s, arrives_s, cluster, "inverse_variance", minimise, 0.0)
        host = _united(found, cluster, said)
        order = np.argsort(cluster, kind="stable")
        entries, captured_s, arrives_s = entries[order], captured_s[order], arrives_s[order]
        cluster = np.unique(host[cluster[order]], return_inverse=True)[1]
    return _summaries(entries, captured_s, arrives_s, cluster, combine, minimise, setting)


def _stacked(lists: Sequence[tuple[Entries, float, float]]) -> tuple[Entries, Array, Array, Array]:
    """All entries in canonical order, with capture and arrival of each, and where the lists begin."""
    ordered = [(one[np.lexsort((one["y_m"], one["x_m"]))], captured, arrives) for one, captured, arrives in lists]
    ordered.sort(key=lambda a: (-a[1], -len(a[0]), np.stack([a[0]["x_m"], a[0]["y_m"]], axis=1).tolist(), a[2]))
    counts = [len(one) for one, _, _ in ordered]
    entries = np.concatenate([entries_of(0), *(one for one, _, _ in ordered)])
    captured_s = np.repeat([captured for _, captured, _ in ordered], counts)
    arrives_s = np.repeat([arrives for _, _, arrives in ordered], counts)
    return entries, captured_s, arrives_s, np.cumsum([0, *counts])


def _agree() -> Array:
    def one(a: str, b: str) -> bool:
        vehicles = CLASS_GROUPS["vehicles"]
        return a == b or "other" in (a, b) or ("vehicle" in (a, b) and a in vehicles and b in vehicles)

    return np.array([[one(a, b) for a in CLASSES] for b in CLASSES])


AGREE = _agree()


def _kinds(probability: Array) -> Array:
    """(N,) the most probable class of each; `other` where none is said to be."""
    kinds: Array = np.where(probability.any(axis=1), probability.argmax(axis=1), CLASSES.index("other"))
    return kinds


def _mean_cov(entries: Entries) -> tuple[Array, Array]:
    mean = np.stack([entries["x_m"], entries["y_m"]], axis=1)
    cov = np.stack([entries[f"cov_{name}_m2"] for name in ("ee", "en", "en", "nn")], axis=1)
    return mean, cov.reshape(-1, 2, 2)


def _clusters(entries: Entries, bounds: Array, threshold: float, informed: bool) -> Array:
    """(M,) number of each entry's cluster. `informed`: running states sum information, else intersect pairwise."""
    x, P = _mean_cov(entries)
    information = np.linalg.inv(P)
    probability = entries["class_probability"]
    kind = _kinds(probability)
    cluster = np.empty(len(entries), dtype=np.int64)
    mean, cov, inverse, sums = x[:0], P[:0], P[:0], probability[:0]
    for a, b in itertools.pairwise(bounds):
        innovation = mean[:, None] - x[None, a:b]
        S = cov[:, None] + P[None, a:b]
        ee, en, nn = S[..., 0, 0], S[..., 0, 1], S[..., 1, 1]
        dx, dy = innovation[..., 0], innovation[..., 1]
        det = ee * nn - en * en
        d2 = (nn * dx * dx - 2 * en * dx * dy + ee * dy * dy) / det
        allowed = (d2 <= threshold) & AGREE[_kinds(sums)[:, None], kind[None, a:b]]
        cost = np.zeros(allowed.shape)
        if allowed.any():
            spread = np.log(det[allowed])
            cost[allowed] = d2[allowed] + spread - (threshold + largest_around(allowed, spread)) - 1e-9
        chosen, partner = linear_sum_assignment(cost)
        paired = allowed[chosen, partner]
        c, e = chosen[paired], partner[paired] + a
        alpha = beta = np.ones(len(c))
        if not informed:
            own, other = np.trace(cov[c], axis1=1, axis2=2), np.trace(P[e], axis1=1, axis2=2)
            alpha, beta = other / (own + other), own / (own + other)
        part = beta[:, None, None] * information[e]
        inverse[c] = alpha[:, None, None] * inverse[c] + part
        cov[c] = np.linalg.inv(inverse[c])
        mean[c] += np.einsum("nij,njk,nk->ni", cov[c], part, x[e] - mean[c])
        sums[c] += probability[e]
        new = np.setdiff1d(np.arange(a, b), e)
        cluster[e], cluster[new] = c, len(mean) + np.arange(len(new))
        mean, cov = np.concatenate([mean, x[new]]), np.concatenate([cov, P[new]])
        inverse, sums = np.concatenate([inverse, information[new]]), np.concatenate([sums, probability[new]])
    return cluster


def _united(found: Entries, cluster: Array, said: Array) -> Array:
    """(clusters,) which cluster each is part of: one whose box overlaps its own most, classes agree, and no list is in
    both. `said (M,)`: the list of each entry."""
    boxes = []
    for one in found:
        box = shapely.box(-one["length_m"] / 2, -one["width_m"] / 2, one["length_m"] / 2, one["width_m"] / 2)
        turned = shapely.affinity.rotate(box, one["yaw_rad"], origin=(0, 0), use_radians=True)
        boxes.append(shapely.affinity.translate(turned, one["x_m"], one["y_m"]))
    kind = _kinds(found["class_probability"])
    host = np.arange(len(found))
    lists = [set(said[cluster == c].tolist()) for c in range(len(found))]
    for c in range(len(found)):
        able = [
            (-boxes[c].intersection(boxes[o]).area / boxes[c].union(boxes[o]).area, o)
            for o in range(c)
            if host[o] == o and AGREE[kind[c], kind[o]] and not lists[c] & lists[o]
        ]
        if able and min(able)[0] < 0:
            host[c] = min(able)[1]
            lists[host[c]] |= lists[c]
    return host


def largest_around(allowed: Array, value: Array) -> Array:
    """(P,) the largest `value (P,)` in the connected component of each of the allowed pairs (n, m)."""
    row, col = np.nonzero(allowed)
    n, m = allowed.shape
    links = coo_array((np.ones(len(row)), (row, n + col)), shape=(n + m, n + m))
    count, component = connected_components(links, directed=False)
    top = np.full(count, -np.inf)
    np.maximum.at(top, component[row], value)
    largest: Array = top[component[row]]
    return largest


def _summaries(
    entries: Entries, captured_s: Array, arrives_s: Array, cluster: Array, combine: str, minimise: str, setting: float
) -> Entries:
    """The fused entry of each cluster."""
    order = np.argsort(cluster, kind="stable")
    entries, captured_s, arrives_s, cluster = entries[order], captured_s[order], arrives_s[order], cluster[order]
    begin = np.flatnonzero(np.diff(cluster, prepend=-1))
    fused = entries_of(len(begin))

    def total(values: Array) -> Array:
        return np.add.reduceat(values, begin, axis=0)

    x, P = _mean_cov(entries)
    mean, cov = _combined(x, P, begin, cluster, combine, minimise, setting)
    fused["x_m"], fused["y_m"] = mean.T
    fused["cov_ee_m2"], fused["cov_en_m2"], fused["cov_nn_m2"] = cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]
    weight = 1 / np.trace(P, axis1=1, axis2=2)
    weight /= total(weight)[cluster]
    for name in ("z_m", "vx_mps", "vy_mps", "length_m", "width_m", "height_m"):
        fused[name] = total(weight * entries[name])
    sin, cos = total(weight * np.sin(entries["yaw_rad"])), total(weight * np.cos(entries["yaw_rad"]))
    fused["yaw_rad"] = np.arctan2(sin, cos)
    fused["existence"] = 1 - np.multiply.reduceat(1 - entries["existence"], begin)
    fused["class_probability"] = total(entries["class_probability"]) / np.bincount(cluster)[:, None]
    fused["captured_s"] = np.maximum.reduceat(captured_s, begin)
    first = np.lexsort((entries["unit_ix"], arrives_s, cluster))[begin]
    fused["unit_ix"] = entries["unit_ix"][first]
    return fused


def _combined(
    x: Array, P: Array, begin: Array, cluster: Array, combine: str, minimise: str, setting: float
) -> tuple[Array, Array]:
    """Mean and covariance of each cluster; positions are taken relative to the cluster's first."""
    if combine in _CORRELATED:
        parts = [
            _CORRELATED[combine](x[a:b], P[a:b], minimise == "determinant", setting)
            for a, b in zip(begin, [*begin[1:], len(x)], strict=True)
        ]
        return np.stack([mean for mean, _ in parts]), np.stack([cov for _, cov in parts])
    information = np.linalg.inv(P)
    if combine == "inverse_variance":
        weight = np.ones(len(x))
    else:
        rule = _intersection if combine == "covariance_intersection" else _fast_intersection
        groups = zip(begin, [*begin[1:], len(x)], strict=True)
        weight = np.concatenate([rule(P[a:b], information[a:b], minimise) for a, b in groups])
    part = weight[:, None, None] * information
    cov = np.linalg.inv(np.add.reduceat(part, begin, axis=0))
    origin = x[begin]
    moment = np.add.reduceat(np.einsum("nij,nj->ni", part, x - origin[cluster]), begin, axis=0)
    return origin + np.einsum("nij,nj->ni", cov, moment), cov


def _intersection(P: Array, information: Array, minimise: str) -> Array:
    """Weights of least trace or determinant, by sequential quadratic programming from equal ones."""
    n = len(P)

    def criterion(weight: Array) -> tuple[float, Array]:
        inverse = np.linalg.inv(np.einsum("n,nij->ij", weight, information))
        if minimise == "trace":
            return float(np.trace(inverse)), -np.einsum("ij,njk,ki->n", inverse, information, inverse)
        return float(np.linalg.slogdet(inverse)[1]), -np.einsum("ij,nji->n", inverse, information)

    if n == 1:
        return np.ones(1)
    one = {"type": "eq", "fun": lambda w: w.sum() - 1, "jac": lambda w: np.ones(n)}
    found = minimize(
        criterion, np.full(n, 1 / n), jac=True, method="SLSQP", bounds=[(0, 1)] * n, constraints=[one],
        options={"ftol": 1e-15, "maxiter": 1000},
    )  # fmt: skip
    weight: Array = found.x / found.x.sum()
    return weight


def _fast_intersection(P: Array, information: Array, _minimise: str) -> Array:
    """Weights of Fränken and Hüpper; the best member alone where it is better."""
    whole = information.sum(axis=0)
    weight = np.linalg.det(whole) - np.linalg.det(whole - information) + np.linalg.det(information)
    weight = weight / weight.sum()
    trace = np.trace(P, axis1=1, axis2=2)
    if np.trace(np.linalg.inv(np.einsum("n,nij->ij", weight, information))) > trace.min() * (1 + 1e-12):
        weight = (trace <= trace.min() * (1 + 1e-12)).astype(float)
        weight /= weight.sum()
    return weight


def _split(x: Array, P: Array, by_determinant: bool, share: float) -> tuple[Array, Array]:
    return correlated.split_intersection(x, share * P, (1 - share) * P, by_determinant)


def _either(x: Array, P: Array, _by_determinant: bool, gate: float) -> tuple[Array, Array]:
    """One after the other: by inverse variance within the gate, by union beyond."""
    a, A = x[0], P[0]
    for b, B in zip(x[1:], P[1:], strict=True):
        if (b - a) @ np.linalg.solve(A + B, b - a) <= -2 * math.log(1 - gate):
            K = A @ np.linalg.inv(A + B)
            a, A = a + K @ (b - a), A - K @ A
        else:
            a, A = covariance_union(a, A, b, B)
    return a, A


_CORRELATED: dict[str, Callable[[Array, Array, bool, float], tuple[Array, Array]]] = {
    "inverse_covariance_intersection": lambda x, P, by, _: correlated.inverse_intersection(x, P, by),
    "split_covariance_intersection": _split,
    "cross_covariance": lambda x, P, _, correlation: correlated.by_correlation(x, P, correlation),
    "covariance_union": _either,
}


# ------------------------------------------------------------------------------------------------ scenes


def in_any_order(entries: Entries) -> list[bytes]:
    """What a list says, to the bit and whatever the order."""
    return sorted(one.tobytes() for one in entries)


def random_reports(
    seed: int, *, units: int, objects: int, captures: int, runs: int = 1, together: bool = False
) -> Inputs:
    """Units that each list every object with probability 0.8, with the errors they state, ten times a second.

    One object per 100 m², moving. `together`: all capture at one instant, else one after the other, unevenly late.
    """
    rng = np.random.default_rng(seed)
    side_m = 10 * math.sqrt(objects)
    place, speed = rng.uniform(0, side_m, (objects, 2)), rng.normal(0, 2, (objects, 2))
    lateness = np.zeros(units) if together else rng.uniform(0, 0.15, units)
    names, captured_s, arrives_s = [], [], []
    lists: list[list[Entries]] = [[] for _ in range(runs)]
    for capture in range(captures):
        for unit in range(units):
            at_s = 0.1 * (capture + (0 if together else unit / units))
            names.append(f"unit {unit}")
            captured_s.append(at_s)
            arrives_s.append(at_s + lateness[unit])
            for run in range(runs):
                lists[run].append(_random_list(rng, place + speed * at_s, speed))
    return inputs_of(lists, names, captured_s, arrives_s)


def _random_list(rng: np.random.Generator, place: Array, speed: Array) -> Entries:
    seen = rng.permutation(np.flatnonzero(rng.uniform(size=len(place)) < 0.8))
    n = len(seen)
    entries = entries_of(n)
    root = rng.normal(size=(n, 2, 2)) * 0.5
    cov = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(2)
    error = np.einsum("nij,nj->ni", np.linalg.cholesky(cov), rng.normal(size=(n, 2)))
    entries["x_m"], entries["y_m"] = (place[seen] + error).T
    entries["vx_mps"], entries["vy_mps"] = (speed[seen] + rng.normal(size=(n, 2))).T
    entries["cov_ee_m2"], entries["cov_en_m2"], entries["cov_nn_m2"] = cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]
    entries["yaw_rad"] = rng.choice([-math.pi, math.pi]) + rng.normal(0, 0.3, n)
    entries["z_m"], entries["length_m"], entries["width_m"], entries["height_m"] = rng.uniform(1, 4, (4, n))
    entries["existence"] = rng.uniform(0.1, 1, n)
    claimed = np.where(rng.uniform(size=n) < 0.2, CLASSES.index("vehicle"), CLASSES.index("car") + seen % 2)
    entries["class_probability"] = rng.dirichlet(np.ones(len(CLASSES)), n) * 0.4
    entries["class_probability"][np.arange(n), claimed] += 0.6
    return entries
