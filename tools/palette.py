"""Search the palettes of `core/colours.py`: python tools/palette.py prints them, a line for each kind of experiment.

A kind is how many configurations there are of each family, eight in all. Candidates are a grid in OKLCh that has the
contrast to every ground, and keeps away from the greys. Simulated annealing over them asks for ΔE2000 ≥ 15 between
any two, plainly seen and by a deuteranope, then for one hue within a family, other hues in other families, the same
hue in both themes, and strong colours. A palette with a greyish colour, which may be taken for the truth, is searched
again among strong candidates. `tests/core/test_colours.py` holds the result against plain formulas.

Sources: OKLab, B. Ottosson, "A perceptual color space for image processing" (2020); rest: `tests/oracles/colour.py`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from copem_replay.core.colours import MOST_COLOURS, REST, TRUTH, Theme
from tests.oracles.colour import DEUTERANOPE, WHITE, XYZ, contrast

GROUNDS: dict[Theme, tuple[tuple[int, int, int], ...]] = {
    "light": ((255, 255, 255), (250, 250, 250)),
    "dark": ((18, 19, 23), (27, 27, 27), (30, 30, 30)),
}
HUES_DEG = (255, 60, 145, 340, 295, 25, 110, 200)
"""Hues in OKLCh that families have if they can."""
APART, APART_FROM_REST, CONTRAST = 15.03, 12.0, 3.02
GREYISH, MIDDLE, STRONG = 0.06, (0.45, 0.85), 0.09
"""Chroma in OKLCh below which a colour of middle lightness looks grey, and least chroma of the search after that."""
STEPS, TRIES = 3000, 8


def make_candidates(theme: Theme) -> dict[str, Any]:
    """Colours (N, 3), their hues, strengths, luminances and whether they look grey (N,), least differences (N, N)."""
    light, strong, hue_deg = (
        v.ravel() for v in np.meshgrid(np.arange(0.22, 0.96, 0.035), np.arange(0.04, 0.26, 0.03), np.arange(0, 360, 10))
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
    greys = np.array([TRUTH, REST])
    apart = _least_apart(colours[:, None], greys[None])
    kept = (apart[:, 0] >= APART) & (apart[:, 1] >= APART_FROM_REST)
    kept &= [min(contrast(tuple(c), ground) for ground in GROUNDS[theme]) >= CONTRAST for c in colours.tolist()]
    colours = colours[kept]
    greyish = (strong < GREYISH) & (light > MIDDLE[0]) & (light < MIDDLE[1])
    return {
        "greyish": greyish[shown][kept],
        "colours": colours, "hue_deg": hue_deg[shown][kept], "strong": strong[shown][kept],
        "luminance": _linear(colours) @ np.array([0.2126, 0.7152, 0.0722]),
        "apart": _least_apart(colours[:, None], colours[None]),
    }  # fmt: skip


def search_strong_palette(shape: tuple[int, ...], of: dict[str, Any], *wanted: Any) -> np.ndarray:
    """Indices (8,) as `search_palette` finds them, all of strong candidates if some were greyish."""
    found = search_palette(shape, of, *wanted)
    if not of["greyish"][found].any():
        return found
    kept = np.flatnonzero(of["strong"] >= STRONG)
    rest = {name: value[kept][:, kept] if name == "apart" else value[kept] for name, value in of.items()}
    return kept[search_palette(shape, rest, *wanted)]


def search_palette(shape: tuple[int, ...], of: dict[str, Any], hues_deg: tuple[float, ...], pull: float) -> np.ndarray:
    """Indices (8,) of the candidates of a palette, family by family. `pull`: how much `hues_deg` weigh."""
    family = np.repeat(np.arange(len(shape)), shape)
    near = 1.5 * np.maximum(0, 15.5 - of["apart"]) ** 2 + np.where(of["apart"] < APART, 6, 0)
    turned = _turn(of["hue_deg"][:, None], of["hue_deg"][None])
    within = near + 0.15 * (np.maximum(0, turned - 5) / 10) ** 2
    across = near + 0.15 * (np.maximum(0, 32 - turned) / 10) ** 2
    weak = 12 * np.maximum(0, 0.12 - of["strong"]) - of["strong"]
    own = [weak + pull * (_turn(of["hue_deg"], hue) / 20) ** 2 for hue in hues_deg]
    random, count = np.random.default_rng(7), len(family)

    def cost(i: int, chosen: np.ndarray, others: Any) -> Any:
        pairs = sum((within if family[i] == family[j] else across)[:, chosen[j]] for j in others)
        return own[family[i]] + pairs

    best: tuple[float, np.ndarray] = (np.inf, np.empty(0))
    for _ in range(TRIES):
        chosen = random.integers(len(weak), size=count)
        for step in range(STEPS):
            i = int(random.integers(count))
            costs = cost(i, chosen, [j for j in range(count) if j != i])
            chances = np.exp((costs.min() - costs) / (2.5 * (1 - step / STEPS) ** 2 + 0.002))
            chosen[i] = random.choice(len(weak), p=chances / chances.sum())
        total = sum(float(cost(i, chosen, range(i))[chosen[i]]) for i in range(count))
        best = min(best, (total, chosen), key=lambda found: found[0])
    return best[1]


def list_shapes(total: int, most: int | None = None) -> Iterator[tuple[int, ...]]:
    """Numbers of configurations by family, the largest first."""
    if total == 0:
        yield ()
    for first in range(min(total, most or total), 0, -1):
        for rest in list_shapes(total - first, first):
            yield (first, *rest)


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
    """ΔE2000, plainly seen or by a deuteranope, whichever is less."""
    seen = [(_linear(one), _linear(other))]
    seen.append(tuple(np.clip(linear @ np.array(DEUTERANOPE).T, 0, 1) for linear in seen[0]))
    return np.minimum(*(_ciede2000(_lab(a), _lab(b)) for a, b in seen))


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
    """Print the palettes of both themes."""
    candidates = {theme: make_candidates(theme) for theme in GROUNDS}
    for shape in list_shapes(MOST_COLOURS):
        hues_deg, pull = tuple(map(float, HUES_DEG)), 0.05
        for theme, of in candidates.items():
            families = np.split(search_strong_palette(shape, of, hues_deg, pull), np.cumsum(shape)[:-1])
            if theme == "light":  # the dark palette keeps the hues of the light one
                turns = [np.exp(1j * np.radians(of["hue_deg"][k])).sum() for k in families]
                hues_deg, pull = tuple(float(np.degrees(np.angle(turn)) % 360) for turn in turns), 0.15
            ranked = [
                k[np.argsort(of["luminance"][k] * (1 if theme == "light" else -1), kind="stable")] for k in families
            ]
            digits = " ".join(bytes(of["colours"][k].tolist()).hex() for k in np.concatenate(ranked))
            print(theme, f'"{"".join(map(str, shape))}": "{digits}",', flush=True)


if __name__ == "__main__":
    main()
