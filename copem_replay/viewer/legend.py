"""Legend: bars in the colours of configurations, of lines and boxes, and of statuses, with names on them, in a view."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from copem_replay.core.colours import TRUTH as TRUTH_COLOUR
from copem_replay.core.colours import Rgb
from copem_replay.perception.sight import HIDDEN, IN_SIGHT, OUT_OF_VIEW
from copem_replay.pipeline.status import EARLY, LOST, NOT_SENT, UNDER_WAY, UNLISTED, UNMATCHED
from copem_replay.viewer.sink import (
    EGO,
    FIELD,
    GROUND,
    HIDES,
    STATUS,
    WORDS_COLOUR,
    RecordingSink,
    scale_colour,
    status_colour,
)

if TYPE_CHECKING:
    import rerun.blueprint as rrb

_BAR_POINTS, _WIDE, _GAP = 7.0, 4.0, 1.0
"""Half the height of a bar in points; its width and the gap beside it in rows."""
_DISC_SHARE = 0.45
"""Strength of the legend's disc: about as pale as those in the picture."""
_MARKS: tuple[tuple[str, Rgb, float], ...] = (
    ("truth", TRUTH_COLOUR, 1.0),
    ("ego", EGO, 6.0),
    ("hides it", HIDES, 2.0),
    ("field of view", FIELD, 1.0),
    ("thin: second entry", WORDS_COLOUR, 0.5),
    ("false, dashed", WORDS_COLOUR, 0.9),
)
_FALSE, _DISC = _MARKS[-1][0], "disc: place ± 2σ"
_STATUSES = {
    OUT_OF_VIEW: "out of range or view", HIDDEN: "hidden", IN_SIGHT: "seen, not listed", UNLISTED: "not listed",
    NOT_SENT: "not sent", LOST: "list lost", UNDER_WAY: "on its way", UNMATCHED: "unmatched",
}  # fmt: skip
"""Words of statuses in lanes, in the order in which they follow each other."""
_BROAD_POINTS = 4.0
"""Broader bars have their names on them, narrower ones below."""
LEGEND_X, LEGEND_Y = (-0.5, 3 * _WIDE + 2 * _GAP + 0.5), (-1.0, 8.0)
"""Bounds of the legend's view: three columns and eight rows."""


def write_legend_bars(out: RecordingSink, colours: Mapping[str, Rgb]) -> None:
    """Write a bar per configuration with its name; beside them those common to all configurations, and statuses.

    Discs of uncertainty, and in lanes what is listed but not known, have the first configuration's colour: of the
    others they have theirs.
    """
    import rerun as rr

    first = next(iter(colours.values()))
    common = [
        *_MARKS,
        (_DISC, scale_colour(first, _DISC_SHARE), _BAR_POINTS),
        ("listed, not known", status_colour(EARLY, first), _BAR_POINTS),
    ]
    statuses = [(word, STATUS[status], _BAR_POINTS) for status, word in _STATUSES.items()]
    columns = ([(name, colour, _BAR_POINTS) for name, colour in colours.items()], common, statuses)
    rows = [(*row, c * (_WIDE + _GAP), float(k)) for c, column in enumerate(columns) for k, row in enumerate(column)]
    strips = [(strip, colour, points) for name, colour, points, x, y in rows for strip in _shape_strips(name, x, y)]
    drawn = rr.LineStrips2D(
        [strip for strip, _, _ in strips],
        colors=[colour for _, colour, _ in strips],
        radii=rr.Radius.ui_points([points for _, _, points in strips]),
    )
    out.static(["legend", "bars"], drawn)
    # A label stands below its point: a point a little higher puts it on a bar; a line would run through it.
    names = rr.Points2D(
        [
            [x + _WIDE / 2 + 0.6 * (name == _DISC), y - (0.4 if points >= _BROAD_POINTS else 0.1)]
            for name, _, points, x, y in rows
        ],
        labels=[name for name, *_ in rows],
        colors=[WORDS_COLOUR],
        radii=rr.Radius.ui_points(0.0),
        show_labels=True,
    )
    out.static(["legend", "names"], names)


def _shape_strips(name: str, x: float, y: float) -> list[list[list[float]]]:
    """A bar; of dashes for false entries, and a disc, beside its name, for uncertainty."""
    if name == _FALSE:
        return [[[x + k * _WIDE / 5, y], [x + (k + 0.6) * _WIDE / 5, y]] for k in range(5)]
    return [[[x, y], [x + (0.1 if name == _DISC else _WIDE), y]]]


def legend_view() -> rrb.Spatial2DView:
    """The view of the legend."""
    import rerun.blueprint as rrb

    bounds = rrb.VisualBounds2D(x_range=LEGEND_X, y_range=LEGEND_Y)
    return rrb.Spatial2DView(origin="legend", name="Legend", background=GROUND, visual_bounds=bounds)
