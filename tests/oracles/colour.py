"""How far apart colours are for a reader, written plainly: contrast, and difference for colour-blind readers.

Sources: contrast, WCAG 2.1. ΔE2000, G. Sharma, W. Wu, E. N. Dalal, "The CIEDE2000 color-difference formula", Color
Research and Application 30 (2005), equation by equation. Deuteranopia and protanopia, G. M. Machado, M. M. Oliveira,
L. A. F. Fernandes, "A physiologically-based model for simulation of color vision deficiency", IEEE TVCG 15 (2009),
severity 1.
CIELAB and ΔE*ab, CIE 1976, D65.
"""

from __future__ import annotations

from math import atan2, cos, degrees, exp, hypot, radians, sin, sqrt

Rgb = tuple[int, ...]

DEUTERANOPE = ((0.367322, 0.860646, -0.227968), (0.280085, 0.672501, 0.047413), (-0.011820, 0.042940, 0.968881))
PROTANOPE = ((0.152286, 1.052583, -0.204868), (0.114503, 0.786281, 0.099216), (-0.003882, -0.048116, 1.051998))
XYZ = ((0.4124564, 0.3575761, 0.1804375), (0.2126729, 0.7151522, 0.0721750), (0.0193339, 0.1191920, 0.9503041))
WHITE = (0.95047, 1.0, 1.08883)


def linear(colour: Rgb) -> list[float]:
    light = []
    for channel in colour[:3]:
        c = channel / 255
        light.append(c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4)
    return light


def contrast(one: Rgb, other: Rgb) -> float:
    bright = []
    for colour in (one, other):
        red, green, blue = linear(colour)
        bright.append(0.2126 * red + 0.7152 * green + 0.0722 * blue)
    return (max(bright) + 0.05) / (min(bright) + 0.05)


def times(matrix: tuple[tuple[float, ...], ...], vector: list[float]) -> list[float]:
    return [sum(m * v for m, v in zip(row, vector, strict=True)) for row in matrix]


def lab(light: list[float]) -> tuple[float, float, float]:
    f = []
    for value, white in zip(times(XYZ, light), WHITE, strict=True):
        t = value / white
        f.append(t ** (1 / 3) if t > (6 / 29) ** 3 else t / (3 * (6 / 29) ** 2) + 4 / 29)
    return 116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])


def ciede2000(one: tuple[float, ...], other: tuple[float, ...]) -> float:
    """ΔE2000 of two colours in CIELAB."""
    (l1, a1, b1), (l2, a2, b2) = one, other
    mean_c = (hypot(a1, b1) + hypot(a2, b2)) / 2
    g = 0.5 * (1 - sqrt(mean_c**7 / (mean_c**7 + 25**7)))
    a1, a2 = (1 + g) * a1, (1 + g) * a2
    c1, c2 = hypot(a1, b1), hypot(a2, b2)
    h1, h2 = degrees(atan2(b1, a1)) % 360, degrees(atan2(b2, a2)) % 360
    if c1 * c2 == 0:
        turn, mean_h = 0.0, h1 + h2
    else:
        turn = h2 - h1
        mean_h = (h1 + h2) / 2
        if abs(turn) > 180:
            turn += -360 if turn > 0 else 360
            mean_h += 180 if h1 + h2 < 360 else -180
    turned = 2 * sqrt(c1 * c2) * sin(radians(turn / 2))
    t = (1 - 0.17 * cos(radians(mean_h - 30)) + 0.24 * cos(radians(2 * mean_h))
         + 0.32 * cos(radians(3 * mean_h + 6)) - 0.20 * cos(radians(4 * mean_h - 63)))  # fmt: skip
    away, mean_c = ((l1 + l2) / 2 - 50) ** 2, (c1 + c2) / 2
    s_l, s_c, s_h = 1 + 0.015 * away / sqrt(20 + away), 1 + 0.045 * mean_c, 1 + 0.015 * mean_c * t
    r_c = 2 * sqrt(mean_c**7 / (mean_c**7 + 25**7))
    r_t = -sin(radians(60 * exp(-(((mean_h - 275) / 25) ** 2)))) * r_c
    light, strong, hue = (l2 - l1) / s_l, (c2 - c1) / s_c, turned / s_h
    return sqrt(light**2 + strong**2 + hue**2 + r_t * strong * hue)


def least_apart(one: Rgb, other: Rgb) -> float:
    """ΔE2000 of two colours, or of what a deuteranope or a protanope sees of them if that is less."""
    plain = [linear(colour) for colour in (one, other)]
    seen = [plain]
    for reader in (DEUTERANOPE, PROTANOPE):
        seen.append([[min(max(v, 0.0), 1.0) for v in times(reader, light)] for light in plain])
    return min(ciede2000(lab(pair[0]), lab(pair[1])) for pair in seen)


def apart_for_a_deuteranope(one: Rgb, other: Rgb) -> float:
    """ΔE*ab of what a deuteranope sees of two colours."""
    seen = []
    for colour in (one, other):
        light = [min(max(v, 0.0), 1.0) for v in times(DEUTERANOPE, linear(colour))]
        seen.append(lab(light))
    return float(sum((a - b) ** 2 for a, b in zip(*seen, strict=True)) ** 0.5)
