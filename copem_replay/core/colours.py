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
        "8": "320819 72101f 761f50 b81894 b63a58 db1f0f f23ec6 ff4777",
        "71": "31091f 360050 4d4057 660fb3 964e91 9c49fd cc6ec5 ca5e00",
        "62": "1d162a 39147e 534b63 6b2ae3 7e6e9b aa75f8 9b4805 d66919",
        "611": "1d162a 39147e 534b63 6b2ae3 7e6e9b aa75f8 d66919 227702",
        "53": "0b1248 1e13ad 474f66 3d50fa 7b8ab7 670400 b71c0e f53f2d",
        "521": "0a0755 240ec9 3e465c 4a63c9 7b8ab7 882f07 f36329 318c4c",
        "5111": "0a0755 240ec9 3e465c 4a63c9 7b8ab7 d66919 227702 830043",
        "44": "0f056e 2925d5 5d6b96 6180fe 480301 882f07 b75547 f36329",
        "431": "0f056e 2925d5 5d6b96 6180fe 480301 933915 f36329 3d9756",
        "422": "0f056e 2925d5 5d6b96 6180fe a02619 f36329 113f04 3d9756",
        "4211": "0a0755 240ec9 54618c 5774f2 882f07 f36329 318c4c f23ec6",
        "41111": "0a0755 240ec9 3e465c 4a63c9 d66919 227702 b24a95 c065f9",
        "332": "140087 2f35e1 5774f2 9f5455 db1f0f ff4777 052200 345009",
        "3311": "140087 2f35e1 5774f2 480301 882f07 f36329 318c4c f23ec6",
        "3221": "140087 2f35e1 6180fe 480301 f36329 2a6a1a 3d9756 b81894",
        "32111": "0f056e 2925d5 6180fe 933915 f36329 3d9756 7e0652 8e519b",
        "311111": "0a0755 240ec9 4a63c9 d66919 318c4c b24a95 c065f9 88001f",
        "2222": "1e13ad 3d50fa 520f08 f36329 2a6a1a 3d9756 a32384 f23ec6",
        "22211": "2f35e1 6180fe a02619 f36329 113f04 3d9756 b81894 371160",
        "221111": "140087 2f35e1 933915 f36329 3d9756 f23ec6 9c49fd 660025",
        "2111111": "140087 6180fe 882f07 318c4c bb3d9a 7e1cd8 660025 ab8704",
        "11111111": "3543ee 882f07 318c4c a32384 430c77 660025 ab8704 2d95d3",
    },
    "dark": {
        "8": "fedbda efa9d7 e59292 fb8a44 f254e9 db1f0f c4299f 9f5455",
        "71": "fbdae8 fc9af3 fe93a4 d650f3 f53a51 b24a95 9f5455 f8b35d",
        "62": "f8dbed fc9af3 fe93a4 d939d2 cd345d 8d5789 f8b35d be7c1c",
        "611": "f8dbed fc9af3 fe93a4 d939d2 d81459 8d5789 e27429 6efe48",
        "53": "f1ddf6 baa1ce c065f9 8a6a91 6f57c2 f38b7b e83120 ac494d",
        "521": "f1ddf6 baa1ce c065f9 8a6a91 6f57c2 f38b7b db1f0f 6efe48",
        "5111": "d2f8ff 46d6fc 399bf4 438194 0061e9 a75217 6efe48 f2396d",
        "44": "e4e1fe ab9df9 855ef9 736490 fedbd5 f38b7b e83120 ac494d",
        "431": "e4e1fe aab1f7 7978fb 656995 f38b7b e83120 ac494d 6efe48",
        "422": "e4e1fe aab1f7 7978fb 656995 f36329 aa4e2c 6efe48 76cf8a",
        "4211": "e4e1fe aab1f7 7978fb 656995 f36329 aa4e2c 6efe48 fe93a4",
        "41111": "e4e1fe aab1f7 7978fb 656995 f4902c a9ff96 db1f0f ff4777",
        "332": "b1c1f1 718ef8 455ed9 e77e7f e83120 ac494d b6faa7 46db05",
        "3311": "bcccfd 718ef8 455ed9 f3898a f53f2d ac494d 61f239 b24a95",
        "3221": "bcccfd 718ef8 455ed9 f38b7b e83120 6efe48 238142 b24a95",
        "32111": "bcccfd 718ef8 455ed9 f36329 aa4e2c 6efe48 fe93a4 b24a95",
        "311111": "b1c1f1 718ef8 455ed9 f4902c 83f69f ff4777 b24a95 db1f0f",
        "2222": "718ef8 455ed9 f38b7b e83120 6efe48 238142 f875d2 b24a95",
        "22211": "5995f8 0061e9 f38b7b e83120 6efe48 238142 bb3d9a ccb4fa",
        "221111": "718ef8 455ed9 fb8a44 a75217 33fead b24a95 ccb4fa f2396d",
        "2111111": "718ef8 455ed9 e65719 33fead b24a95 ccb4fa d81459 f6c835",
        "11111111": "0061e9 aa4e2c 33fead bb3d9a aa75f8 ff4777 f6c835 46d6fc",
    },
}
"""Palettes by theme and by the numbers of configurations of each family, the largest family first.

Any two colours are 15 or more apart (ΔE2000), for a deuteranope, too, and from `TRUTH`. Contrast to white, or to the
dark grounds of viewer and report, is 3:1 or more. The first of a family has the most.
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
