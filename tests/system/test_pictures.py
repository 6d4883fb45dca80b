"""The pictures of the README and the docs: all there, small, and in the colours they were taken in."""

from __future__ import annotations

import io
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from copem_replay.core.colours import configuration_colours

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tools"))

from pictures import LARGEST_BYTES, PICTURES, as_png  # noqa: E402


def test_every_picture_is_shown_with_words_that_say_what_is_on_it() -> None:
    shown = {}
    for page in (ROOT / "README.md", *ROOT.glob("docs/**/*.md")):
        for words, target in re.findall(r"!\[(.*?)\]\((.*?)\)", page.read_text(encoding="utf-8")):
            shown[(page.parent / target).resolve()] = words
    assert set(shown) == set(PICTURES.iterdir())
    assert all(len(words.split()) > 5 for words in shown.values())


@pytest.mark.parametrize("path", sorted(PICTURES.iterdir()), ids=lambda path: path.name)
def test_pictures_are_small_and_not_empty(path: Path) -> None:
    assert path.stat().st_size <= LARGEST_BYTES
    with Image.open(path) as picture:
        assert picture.format == "PNG"
        assert 1000 <= picture.width <= 1400
        assert len(picture.convert("RGB").getcolors(1 << 24) or []) > 50


def test_a_few_dots_keep_their_colours_in_a_dark_window() -> None:
    """Many shades of nearly black, and nine pixels each of the colours that tell configurations apart."""
    shades = np.random.default_rng(1).integers(0, 40, (300, 400))
    pixels = np.repeat(shades[..., None], 3, axis=-1).astype(np.uint8)
    colours = list(configuration_colours(map(str, range(7)), ()).values())
    for k, colour in enumerate(colours):
        pixels[10:13, 10 * k + 10 : 10 * k + 13] = colour
    with Image.open(io.BytesIO(as_png(Image.fromarray(pixels)))) as small:
        found = np.asarray(small.convert("RGB"))
    for k, colour in enumerate(colours):
        assert np.abs(found[11, 10 * k + 11].astype(int) - colour).max() <= 16


def test_what_does_not_get_small_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pictures.LARGEST_BYTES", 9_000)
    noise = np.random.default_rng(1).integers(0, 256, (100, 100, 3), dtype=np.uint8)
    with pytest.raises(SystemExit, match="expected at most 9000"):
        as_png(Image.fromarray(noise))
