"""Colours of configurations: a hue for each family, lightness for its variants, told apart by colour-blind readers.

A family is the part of a name up to its first colon: `coPEM:0s` and `coPEM:1s` have one hue. The ground truth is grey.
`tools/palette.py` has searched for the palettes, and says what it asks of them; tests hold them against it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Literal

Rgb = tuple[int, int, int]
Theme = Literal["light", "dark"]
TRUTH: Rgb = (145, 145, 145)
"""Grey of the ground truth in both themes."""
REST: Rgb = (105, 105, 105)
"""Grey of configurations beyond those that have a colour."""
MOST_COLOURS = 8
"""Most configurations that have a colour: no more can be told apart."""
_PALETTES: dict[Theme, dict[str, str]] = {
    "light": {
        "8": "271320 670463 88001f 653545 b81894 b63a58 f23ec6 ff4777",
        "71": "1f0051 251323 3d18b6 57395e 9435c9 8a6a91 c065f9 ca5e00",
        "62": "2d0236 6f0083 6c2c4e 8d5789 a431e1 d564cd 9b4805 d66919",
        "611": "2d0236 6f0083 6c2c4e 8d5789 a431e1 d564cd d66919 227702",
        "53": "0a0755 240ec9 474f66 4a63c9 7b8ab7 670400 b71c0e f53f2d",
        "521": "0a0755 240ec9 3e465c 4a63c9 7b8ab7 670400 f53f2d 227702",
        "5111": "0a0755 240ec9 474f66 4a63c9 7b8ab7 d66919 227702 830043",
        "44": "0f056e 2925d5 5d6b96 6180fe 480301 882f07 b75547 f36329",
        "431": "0f056e 2925d5 5d6b96 6180fe 480301 882f07 f36329 318c4c",
        "422": "0f056e 2925d5 5d6b96 6180fe 520f08 f36329 2a6a1a 3d9756",
        "4211": "0a0755 240ec9 54618c 5774f2 882f07 e65719 318c4c f23ec6",
        "41111": "0a0755 240ec9 3e465c 4a63c9 9b4805 50a33d b24a95 c065f9",
        "332": "140087 2f35e1 5774f2 60053d af308f f23ec6 227702 50a33d",
        "3311": "140087 2f35e1 5774f2 480301 882f07 f36329 318c4c f23ec6",
        "3221": "140087 2f35e1 5774f2 933915 f36329 002c0f 3d9756 f23ec6",
        "32111": "0a0755 240ec9 4a63c9 882f07 f36329 3d9756 b24a95 c065f9",
        "311111": "0f056e 2925d5 6180fe d66919 227702 7e0652 8e519b 670116",
        "2222": "240ec9 4964f6 a02619 f36329 113f04 3d9756 a32384 f23ec6",
        "22211": "140087 2f35e1 a02619 f36329 113f04 3d9756 f23ec6 9c49fd",
        "221111": "140087 2f35e1 933915 f36329 3d9756 f23ec6 9c49fd 660025",
        "2111111": "240ec9 4964f6 882f07 318c4c f23ec6 2f0456 660025 ab8704",
        "11111111": "126df5 f36329 3d9756 e52fba 4e05b0 660025 5d5e04 0a5b5f",
    },
    "dark": {
        "8": "fedbda fbb4e2 fe61f5 ff4777 bf35db db1f0f 9f5455 8d5789",
        "71": "fbdae8 fda8a8 fa8cd7 f53a51 d939d2 9f5455 8d5789 f7a224",
        "62": "fbdae8 fc9af3 fe93a4 d939d2 cd345d 8d5789 f8b35d be7c1c",
        "611": "fbdae8 fc9af3 fe93a4 d939d2 d81459 8d5789 e27429 6efe48",
        "53": "f1ddf6 baa1ce c065f9 8a6a91 6f57c2 f3898a f53f2d ac494d",
        "521": "f1ddf6 baa1ce c065f9 8a6a91 6f57c2 f38b7b e83120 6efe48",
        "5111": "f1ddf6 baa1ce c065f9 8a6a91 6f57c2 e27429 6efe48 d81459",
        "44": "ebb9f7 c67af8 a431e1 8d5789 fda8a8 fb8a44 db1f0f 9f5455",
        "431": "ebb9f7 c67af8 986193 a431e1 f3898a f53f2d ac494d 61f239",
        "422": "ebb9f7 c67af8 986193 a431e1 f38b7b e83120 6efe48 238142",
        "4211": "ebb9f7 c67af8 a431e1 8d5789 f36329 aa4e2c 6efe48 fe93a4",
        "41111": "ebb9f7 c67af8 986193 a431e1 f4902c a9ff96 db1f0f ff4777",
        "332": "b1c1f1 718ef8 455ed9 e77e7f e83120 ac494d b6faa7 46db05",
        "3311": "b1c1f1 718ef8 455ed9 f3898a f53f2d ac494d 61f239 b24a95",
        "3221": "b1c1f1 718ef8 455ed9 f38b7b e83120 6efe48 238142 b24a95",
        "32111": "b1c1f1 718ef8 455ed9 f36329 aa4e2c 6efe48 fe93a4 b24a95",
        "311111": "b1c1f1 718ef8 455ed9 f4902c a9ff96 ff4777 b24a95 db1f0f",
        "2222": "718ef8 455ed9 e77e7f e83120 b6faa7 46db05 f875d2 b24a95",
        "22211": "5995f8 0061e9 f38b7b e83120 6efe48 238142 bb3d9a ccb4fa",
        "221111": "718ef8 455ed9 fb8a44 a75217 33fead b24a95 ccb4fa f2396d",
        "2111111": "5995f8 0061e9 e65719 33fead bb3d9a ccb4fa d81459 ebbc21",
        "11111111": "0061e9 e65719 4fe47d bb3d9a 9782f1 d81459 f9fa44 31dbe3",
    },
}
"""Palettes by theme and by the numbers of configurations of each family, the largest family first.

Any two colours are 15 or more apart (ΔE2000), for a deuteranope, too, and from `TRUTH`; none of middle lightness
looks grey. Contrast to white, or to the dark grounds of viewer and report, is 3:1 or more. The first of a family
has the most.
"""


def configuration_colours(
    configurations: Iterable[str],
    *,
    truths: Collection[str] = (),
    selected: Collection[str] | None = None,
    theme: Theme = "dark",
) -> dict[str, Rgb]:
    """A colour per configuration: `TRUTH` for `truths` among others, `REST` beyond the eighth of these.

    `configurations`: all of an experiment, in its order, whichever of them are shown: so each keeps its colour.
    `selected`: which have a colour if they are more than eight, None: the first eight.
    """
    every = list(configurations)
    coloured = [name for name in every if name not in truths] or every
    if len(coloured) > MOST_COLOURS:
        coloured = [name for name in coloured if selected is None or name in selected][:MOST_COLOURS]
    largest_first = sorted(group_families(coloured).values(), key=len, reverse=True)
    alone = "1" * (MOST_COLOURS - len(coloured))  # places of families that the palette has besides
    palette = _PALETTES[theme]["".join(str(len(family)) for family in largest_first) + alone].split()
    in_order = [name for family in largest_first for name in family]
    colours = {name: _read_colour(digits) for name, digits in zip(in_order, palette, strict=False)}
    return {name: colours.get(name, TRUTH if name in truths else REST) for name in every}


def group_families(configurations: Iterable[str]) -> dict[str, list[str]]:
    """Configurations by family, in their order."""
    families: dict[str, list[str]] = {}
    for name in configurations:
        families.setdefault(name.partition(":")[0], []).append(name)
    return families


def _read_colour(digits: str) -> Rgb:
    red, green, blue = bytes.fromhex(digits)
    return red, green, blue
