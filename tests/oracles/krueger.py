"""Transverse Mercator by Krüger's series to the sixth power of n, written plainly: an oracle for projections.

Karney, "Transverse Mercator with an accuracy of a few nanometers", J. Geod. 85 (2011), eqs. 7 to 12, 22 to 26 and 35.
"""

from __future__ import annotations

import cmath
import math

A, F = 6_378_137.0, 1 / 298.257223563
N = F / (2 - F)
E = math.sqrt(F * (2 - F))
RECTIFYING = A / (1 + N) * (1 + N**2 / 4 + N**4 / 64 + N**6 / 256)
ALPHA = (
    N / 2 - 2 * N**2 / 3 + 5 * N**3 / 16 + 41 * N**4 / 180 - 127 * N**5 / 288 + 7891 * N**6 / 37800,
    13 * N**2 / 48 - 3 * N**3 / 5 + 557 * N**4 / 1440 + 281 * N**5 / 630 - 1983433 * N**6 / 1935360,
    61 * N**3 / 240 - 103 * N**4 / 140 + 15061 * N**5 / 26880 + 167603 * N**6 / 181440,
    49561 * N**4 / 161280 - 179 * N**5 / 168 + 6601661 * N**6 / 7257600,
    34729 * N**5 / 80640 - 3418889 * N**6 / 1995840,
    212378941 * N**6 / 319334400,
)


def project(lat_deg: float, lon_deg: float, meridian_deg: float, scale: float = 0.9996) -> tuple[float, float]:
    """Metres east of the meridian and north of the equator."""
    phi, lam = math.radians(lat_deg), math.radians(lon_deg - meridian_deg)
    tau = math.tan(phi)
    sigma = math.sinh(E * math.atanh(E * tau / math.hypot(1, tau)))
    conformal = tau * math.hypot(1, sigma) - sigma * math.hypot(1, tau)
    xi = math.atan2(conformal, math.cos(lam))
    eta = math.asinh(math.sin(lam) / math.hypot(conformal, math.cos(lam)))
    zeta = complex(xi, eta)
    zeta += sum(a * cmath.sin(2 * (j + 1) * complex(xi, eta)) for j, a in enumerate(ALPHA))
    return scale * RECTIFYING * zeta.imag, scale * RECTIFYING * zeta.real
