"""How long something lasts that is only seen at lists: still there at the next one with probability e^(−Δ/τ)."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from copem_replay.core.tracks import Float
from copem_replay.pipeline.fit.estimate import Estimate


def garwood(count: float) -> tuple[float, float]:
    """The 95 % interval of a Poisson mean of which `count` were seen (or as many as they are worth).

    Source: F. Garwood, "Fiducial limits for the Poisson distribution", Biometrika 28 (1936) 437–442.
    """
    return (float(chi2.ppf(0.025, 2 * count) / 2) if count else 0.0), float(chi2.ppf(0.975, 2 * count + 2) / 2)


def lasting_time(stayed_s: Float, ended_s: Float, what: str) -> Estimate:
    """The mean duration τ (s) by maximum likelihood, of gaps over which it stayed and gaps in which it ended.

    The interval is that of the number of ends. None of them: how long it lasts at least is all that can be told.
    """
    from scipy.optimize import brentq

    n, ends, total_s = len(stayed_s) + len(ended_s), len(ended_s), float(stayed_s.sum() + ended_s.sum())
    low, high = garwood(ends)
    if not ends or not len(stayed_s):
        why = f"no {what} in {total_s:.3g} s" if not ends else f"{what} at every list"
        return Estimate(float("nan"), total_s / high if not ends else 0.0, float("inf"), n, ends, why)

    def slope(log_tau: float) -> float:
        x = ended_s / np.exp(log_tau)
        return float(stayed_s.sum() - (ended_s * np.exp(-x) / -np.expm1(-x)).sum())

    around = np.log(total_s / ends)
    tau_s = float(np.exp(brentq(slope, around - 12, around + 3)))
    return Estimate(tau_s, tau_s * ends / high, tau_s * ends / low if low > 0 else float("inf"), n, ends)
