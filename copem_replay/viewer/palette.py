"""Colours of what is no configuration's: the ground they are on, the truth, statuses, words.

Lines have a contrast of 3:1 or more to the dark ground, words 4.5:1, and 3:1 to the plate of a light theme; statuses
stay apart for deuteranopes. Tests compute it. The ground is said in every 3-D view and plot, so that a viewer in its
light theme shows the same.
"""

from __future__ import annotations

from copem_replay.core.colours import TRUTH, Rgb
from copem_replay.viewer.statuses import CAPTURED, EARLY, HIDDEN, KNOWN, LOST, OUT, UNLISTED, UNMATCHED, VISIBLE

GROUND: Rgb = (18, 19, 23)
GRID: Rgb = (36, 38, 44)
"""Of the grid on it: faint, no line to be read."""
EGO: Rgb = (240, 240, 240)
"""The ego and all units."""
STANDING: Rgb = (112, 112, 112)
"""What is there and never moves; what moves has the truth's grey."""
LANE: Rgb = (104, 104, 114)
"""Boundaries of lanes: seen, but behind all else."""
FIELD: Rgb = (150, 146, 118)
"""Outlines of fields of view."""
ONSET: Rgb = (255, 255, 255)
HIDES: Rgb = (255, 110, 95)
"""What hides something."""
NOTICED: Rgb = (255, 255, 255)
WAITING: Rgb = (226, 226, 226)
BEHIND: Rgb = (255, 205, 196)
"""Of words: what is known, all else, what is hidden. No configuration's colour: some are too dark to be read. All of
them bright: in its light theme the viewer puts them on a grey plate."""
DIFFERENCE: Rgb = (255, 255, 255)
"""Marks of what only one of two configurations holds."""
STATUS: dict[int, Rgb] = {
    OUT: (52, 60, 80),
    UNLISTED: (88, 76, 54),
    HIDDEN: (152, 126, 82),
    VISIBLE: (106, 112, 122),
    LOST: (208, 192, 158),
    CAPTURED: (118, 140, 192),
    UNMATCHED: (190, 202, 228),
}
"""Statuses in which the receiver's list has nothing of the object, the same for all configurations."""
HALF = 0.5
"""Of its strength a configuration's colour has where the object is listed, and not known (chosen)."""


def status_colour(status: int, colour: Rgb) -> Rgb:
    """Of a status in a lane: neutral while nothing is listed, `colour` at half its strength until it is known."""
    if status < EARLY:
        return STATUS[status]
    return colour if status == KNOWN else _times(colour, HALF)


def _times(colour: Rgb, share: float) -> Rgb:
    red, green, blue = (round(channel * share) for channel in colour)
    return red, green, blue


__all__ = [
    "BEHIND", "DIFFERENCE", "EGO", "FIELD", "GRID", "GROUND", "HALF", "HIDES", "LANE", "NOTICED", "ONSET", "STANDING",
    "STATUS", "TRUTH", "WAITING", "status_colour",
]  # fmt: skip
