"""Search the palettes of `core/colours.py`: python tools/palette.py prints them, a line for each theme.

Candidates are a grid in OKLCh that has the contrast to every ground, and keeps away from the grey of the truth. Of the
dark theme they are so bright that lanes show them nearly unchanged (`tint_for_words`). Simulated annealing over them
asks for ΔE2000 ≥ 15 between any two, plainly seen, by a deuteranope and by a protanope, then for the hues, one for
each place, the same in both themes, and strong colours. `tests/core/test_colours.py` holds the result against plain
formulas.

Sources: OKLab, B. Ottosson, "A perceptual color space for image processing" (2020); rest: `tests/oracles/colour.py`.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from copem_replay.core.colours import TRUTH, Theme
from tests.oracles.colour import DEUTERANOPE, PROTANOPE, WHITE, XYZ, contrast

GROUNDS: dict[Theme, tuple[tuple[int, int, int], ...]] = {
    "dark": ((18, 19, 23), (27, 27, 27), (30, 30, 30)),
    "light": ((255, 255, 255), (250, 250, 250)),
}
HUES_DEG = (255, 55, 145, 340, 295, 100, 200, 15)
"""Hues in OKLCh that places have if they can."""
APART, CONTRAST, STRONG, INTENSITY = 15.03, 3.02, 0.09, 0.4
"""Least ΔE2000 and contrast; least chroma in OKLCh; least intensity (0 to 1) in the dark theme."""
STEPS, TRIES, PULL = 4000, 12, 0.12


def make_candidates(theme: Theme) -> dict[str, Any]:
    """Colours (N, 3), their hues and strengths (N,), least differences (N, N)."""
    light, strong, hue_deg = (
        v.ravel() for v in np.meshgrid(np.arange(0.22, 0.97, 0.03), np.arange(0.05, 0.3, 0.03), np.arange(0, 360, 10))
    )
    a, b = strong * np.cos(np.radians(hue_deg)), strong * np.sin(np.radians(hue_deg))
    cone = np.stack([light + 0.3963377774 * a + 0.2158037573 * b, light - 0.1055613458 * a - 0.0638541728 * b,
                     light - 0.0894841775 * a - 1.2914855480 * b]) ** 3  # fmt: skip
    to_rgb = [[4.0767416621, -3.3077115913, 0.2309699292], [-1.2684380046, 2.6097574011, -0.3413193965],
              [-0.0041960863, -0.7034186147, 1.7076147010]]  # fmt: skip
    linear = (np.array(to_rgb) @ cone).T
    shown = ((linear >= -1e-3) & (linear <= 1.001)).all(axis=1)
    linear = np.clip(linear[shown], 0, 1)
    colours = np.rint(255 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055))
    colours = colours.astype(int)
    kept = (_least_apart(colours, np.array([TRUTH])) >= APART) & (strong[shown] >= STRONG)
    kept &= [min(contrast(tuple(c), ground) for ground in GROUNDS[theme]) >= CONTRAST for c in colours.tolist()]
    kept &= (theme == "light") | (colours @ np.array([0.299, 0.587, 0.114]) >= 255 * INTENSITY)
    colours = colours[kept]
    return {
        "colours": colours, "hue_deg": hue_deg[shown][kept], "strong": strong[shown][kept],
        "apart": _least_apart(colours[:, None], colours[None]),
    }  # fmt: skip


def search_palette(of: dict[str, Any], hues_deg: tuple[float, ...]) -> np.ndarray:
    """Indices (K,) of the candidates of a palette, place by place."""
    near = 1.5 * np.maximum(0, APART + 0.5 - of["apart"]) ** 2 + np.where(of["apart"] < APART, 6, 0)
    own = [PULL * (_turn(of["hue_deg"], hue) / 20) ** 2 - 2 * of["strong"] for hue in hues_deg]
    random, count = np.random.default_rng(7), len(hues_deg)

    def cost(i: int, chosen: np.ndarray, others: Any) -> Any:
        return own[i] + sum(near[:, chosen[j]] for j in others)

    best: tuple[float, np.ndarray] = (np.inf, np.empty(0))
    for _ in range(TRIES):
        chosen = random.integers(len(near), size=count)
        for step in range(STEPS):
            i = int(random.integers(count))
            costs = cost(i, chosen, [j for j in range(count) if j != i])
            chances = np.exp((costs.min() - costs) / (2.5 * (1 - step / STEPS) ** 2 + 0.002))
            chosen[i] = random.choice(len(near), p=chances / chances.sum())
        total = sum(float(cost(i, chosen, range(i))[chosen[i]]) for i in range(count))
        best = min(best, (total, chosen), key=lambda found: found[0])
    return best[1]


def _turn(one: Any, other: Any) -> Any:
    return np.abs((one - other + 180) % 360 - 180)


def _linear(colours: np.ndarray) -> np.ndarray:
    share = colours / 255
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def _lab(linear: np.ndarray) -> np.ndarray:
    t = linear @ np.array(XYZ).T / np.array(WHITE)
    x, y, z = np.moveaxis(np.where(t > (6 / 29) ** 3, np.cbrt(t), t / (3 * (6 / 29) ** 2) + 4 / 29), -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], -1)


def _least_apart(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """ΔE2000, plainly seen or by a deuteranope or a protanope, whichever is least."""
    plain = _linear(one), _linear(other)
    seen = [plain]
    for reader in (DEUTERANOPE, PROTANOPE):
        seen.append(tuple(np.clip(linear @ np.array(reader).T, 0, 1) for linear in plain))
    return np.minimum.reduce([_ciede2000(_lab(a), _lab(b)) for a, b in seen])


def _ciede2000(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    (l1, a1, b1), (l2, a2, b2) = np.moveaxis(one, -1, 0), np.moveaxis(other, -1, 0)
    mean = (np.hypot(a1, b1) + np.hypot(a2, b2)) / 2
    g = 1.5 - 0.5 * np.sqrt(mean**7 / (mean**7 + 25**7))
    c1, c2 = np.hypot(g * a1, b1), np.hypot(g * a2, b2)
    h1, h2 = np.degrees(np.arctan2(b1, g * a1)) % 360, np.degrees(np.arctan2(b2, g * a2)) % 360
    turn = (h2 - h1 + 180) % 360 - 180
    mean_h = (h1 + turn / 2) % 360
    wave = [np.cos(np.radians(k * mean_h + shift)) for k, shift in ((1, -30), (2, 0), (3, 6), (4, -63))]
    t = 1 - 0.17 * wave[0] + 0.24 * wave[1] + 0.32 * wave[2] - 0.20 * wave[3]
    away, mean = ((l1 + l2) / 2 - 50) ** 2, (c1 + c2) / 2
    light = (l2 - l1) / (1 + 0.015 * away / np.sqrt(20 + away))
    strong = (c2 - c1) / (1 + 0.045 * mean)
    hue = 2 * np.sqrt(c1 * c2) * np.sin(np.radians(turn / 2)) / (1 + 0.015 * mean * t)
    rotation = -np.sin(np.radians(60 * np.exp(-(((mean_h - 275) / 25) ** 2))))
    rotation *= 2 * np.sqrt(mean**7 / (mean**7 + 25**7))
    return np.sqrt(np.maximum(light**2 + strong**2 + hue**2 + rotation * strong * hue, 0))


def main() -> None:
    """Print the palettes of both themes; the light one keeps the hues of the dark one."""
    hues_deg = tuple(map(float, HUES_DEG))
    for theme in GROUNDS:
        of = make_candidates(theme)
        found = search_palette(of, hues_deg)
        hues_deg = tuple(of["hue_deg"][found].tolist())
        least = (of["apart"][np.ix_(found, found)] + np.diag(np.full(len(found), np.inf))).min()
        digits = " ".join(bytes(of["colours"][k].tolist()).hex() for k in found)
        print(f'"{theme}": "{digits}",  # least ΔE2000 {least:.1f}, hues {hues_deg}', flush=True)


if __name__ == "__main__":
    main()
