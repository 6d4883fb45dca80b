"""Labels of events that cannot collide: above the panel, each on a step of its own, the earliest highest.

Every label begins at the right of its mark, which reaches up to it and no higher: so no mark crosses a label, however
close together or long they are. Time only has to go on to the right until the labels have room.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from copem_replay.report.figures.style import INK

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from copem_replay.report.figures.timeline import Event

LABEL_PT = 7.5
STEP_IN = 0.145
"""Height of a step: a line of text (inches)."""
_LETTER_EM = 0.56
"""Width of a letter, on the average, in sizes of the font (of DejaVu Sans, rounded up)."""


def last_instant(events: Sequence[Event], begin_s: float, end_s: float, width_in: float) -> float:
    """Where the time axis has to end so that all labels fit: `end_s`, or later. `width_in`: of the panel."""
    for event in events:
        label_in = (len(event.label) + 1.5) * _LETTER_EM * LABEL_PT / 72
        share = min(label_in / width_in, 0.8)
        end_s = max(end_s, begin_s + (event.time_s - begin_s) / (1 - share))
    return end_s


def draw_labels(axes: Axes, events: Sequence[Event], steps: int, height_in: float) -> None:
    """Mark events (in order) above a panel `height_in` high, on the lowest of `steps` steps."""
    for k, event in enumerate(events):
        top = 1 + (steps - k - 0.1) * STEP_IN / height_in
        axes.plot(
            [event.time_s, event.time_s], [1, top], transform=axes.get_xaxis_transform(), clip_on=False, **mark(event)
        )
        axes.annotate(
            event.label,
            (event.time_s, top),
            xycoords=axes.get_xaxis_transform(),
            xytext=(2.5, 0),
            textcoords="offset points",
            fontsize=LABEL_PT,
            va="top",
            color=INK,
            annotation_clip=False,
        )


def mark(event: Event) -> dict[str, Any]:
    """How the line of an event looks: what the ego does is solid, what it comes to know is dashed."""
    style = {"onset": (0, (1, 1.5)), "brakes": "-", "outcome": "-"}.get(event.kind, (0, (4, 2)))
    return {"color": INK, "linewidth": 0.9, "linestyle": style, "zorder": 1.5}
