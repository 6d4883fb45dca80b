"""How far apart colours are for a reader, written plainly: contrast, and difference to a deuteranope.

Sources: contrast, WCAG 2.1. Deuteranopia, G. M. Machado, M. M. Oliveira, L. A. F. Fernandes, "A physiologically-based
model for simulation of color vision deficiency", IEEE TVCG 15 (2009), severity 1. CIELAB and ΔE*ab, CIE 1976, D65.
"""

from __future__ import annotations

Rgb = tuple[int, ...]

DEUTERANOPE = ((0.367322, 0.860646, -0.227968), (0.280085, 0.672501, 0.047413), (-0.011820, 0.042940, 0.968881))
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


def apart_for_a_deuteranope(one: Rgb, other: Rgb) -> float:
    """ΔE*ab of what a deuteranope sees of two colours."""
    seen = []
    for colour in (one, other):
        light = [min(max(v, 0.0), 1.0) for v in times(DEUTERANOPE, linear(colour))]
        seen.append(lab(light))
    return float(sum((a - b) ** 2 for a, b in zip(*seen, strict=True)) ** 0.5)
