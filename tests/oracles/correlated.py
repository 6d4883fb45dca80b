"""Estimates whose errors hang together, combined plainly: equations word for word, general optimisers."""

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag, sqrtm
from scipy.optimize import minimize, minimize_scalar

Array = npt.NDArray[Any]


def size(P: Array, by_determinant: bool) -> float:
    return float(np.linalg.slogdet(P)[1] if by_determinant else np.trace(P))


def best_linear(x: Array, joint: Array) -> tuple[Array, Array]:
    """Mean and covariance of the best linear unbiased estimate of what is stated n times, `joint (nd, nd)`."""
    n, d = x.shape
    H = np.vstack([np.eye(d)] * n)
    P = np.linalg.inv(H.T @ np.linalg.solve(joint, H))
    return P @ H.T @ np.linalg.solve(joint, x.ravel()), P


def by_correlation(x: Array, cov: Array, correlation: float) -> tuple[Array, Array]:
    """Every two errors correlated: ρ √A √B."""
    roots = np.vstack([np.real(sqrtm(one)) for one in cov])
    joint = correlation * roots @ roots.T + (1 - correlation) * block_diag(*cov)
    return best_linear(x, joint)


def inverse_intersection(x: Array, cov: Array, by_determinant: bool) -> tuple[Array, Array]:
    """Noack's equations, one estimate after the other, ω by a bounded search."""
    a, A = x[0], cov[0]
    for b, B in zip(x[1:], cov[1:], strict=True):

        def common(omega: float, A: Array = A, B: Array = B) -> Array:
            return np.linalg.inv(omega * A + (1 - omega) * B)

        def result(omega: float, A: Array = A, B: Array = B) -> Array:
            return np.linalg.inv(np.linalg.inv(A) + np.linalg.inv(B) - common(omega, A, B))

        found = minimize_scalar(
            lambda omega, result=result: size(result(omega), by_determinant),
            bounds=(0, 1), method="bounded", options={"xatol": 1e-12},
        )  # fmt: skip
        omega = min([found.x, 0.0, 1.0], key=lambda o: size(result(o), by_determinant))
        P, G = result(omega), common(omega)
        K, L = P @ (np.linalg.inv(A) - omega * G), P @ (np.linalg.inv(B) - (1 - omega) * G)
        a, A = K @ a + L @ b, P
    return a, A


def split_intersection(x: Array, dependent: Array, independent: Array, by_determinant: bool) -> tuple[Array, Array]:
    """The best linear estimate under the bound diag(Dᵢ/wᵢ + Nᵢ), weights by sequential quadratic programming."""
    n = len(x)

    def bound(weight: Array) -> Array:
        share = np.maximum(weight, 1e-9) / np.maximum(weight, 1e-9).sum()
        return block_diag(*(D / w + N for D, N, w in zip(dependent, independent, share, strict=True)))

    if n == 1:
        return x[0], dependent[0] + independent[0]

    def bounded(weight: Array) -> float:  # the same as the block matrix gives, block after block
        share = np.maximum(weight, 1e-9) / np.maximum(weight, 1e-9).sum()
        parts = np.linalg.inv(dependent / share[:, None, None] + independent)
        return size(np.linalg.inv(parts.sum(axis=0)), by_determinant)

    found = minimize(
        bounded, np.full(n, 1 / n), method="SLSQP",
        bounds=[(0, 1)] * n, constraints={"type": "eq", "fun": lambda w: w.sum() - 1},
        options={"ftol": 1e-15, "maxiter": 500},
    )  # fmt: skip
    return best_linear(x, bound(found.x))


def union_at_least(a: Array, A: Array, b: Array, B: Array) -> float:
    """A trace that no union can be below: the largest that its dual problem gives, whose every value is such a bound.

    For ‖Z‖ ≤ 1: tr P ≥ (tr A + tr B + |δ|²/2)/2 + ⟨Z, B − A⟩/2 − |Zδ|²/4. Eigenvalues of Z are sines: none is above 1.
    """
    delta = b - a
    start = (np.trace(A) + np.trace(B) + delta @ delta / 2) / 2

    def at(p: Array) -> float:
        turn = np.array([[np.cos(p[2]), -np.sin(p[2])], [np.sin(p[2]), np.cos(p[2])]])
        Z = turn @ np.diag(np.sin(p[:2])) @ turn.T
        return float(start + np.trace(Z @ (B - A)) / 2 - np.sum((Z @ delta) ** 2) / 4)

    starts = [np.array([s, t, u]) for s in (-1.0, 1.0) for t in (-1.0, 1.0) for u in (0.1, 0.9, 1.7)]
    return max(-minimize(lambda p: -at(p), one, method="BFGS", options={"gtol": 1e-10}).fun for one in starts)
