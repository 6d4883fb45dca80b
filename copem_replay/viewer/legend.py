"""The colours of configurations, and what lines and bodies are: bars with names on them, in a view of their own."""

from __future__ import annotations

from collections.abc import Mapping

from copem_replay.core.colours import TRUTH, Rgb
from copem_replay.viewer.palette import EGO, HIDES, NOTICED
from copem_replay.viewer.sink import Out

_MARKS: tuple[tuple[str, Rgb, float], ...] = (
    ("truth", TRUTH, 1.0),
    ("ego", EGO, 6.0),
    ("hides it", HIDES, 2.0),
)
_BAR_POINTS, _WIDE, _GAP = 7.0, 4.0, 1.0
"""Half the height of a bar in points; its width and the gap beside it in rows."""
LEGEND_X, LEGEND_Y = (-0.5, 2 * _WIDE + _GAP + 0.5), (-1.0, 6.0)
"""What is in view of it: two columns, and six rows."""


def bars(out: Out, colours: Mapping[str, Rgb]) -> None:
    """A bar per configuration, its name on it, then what is the same for all."""
    import rerun as rr

    columns = ([(name, colour, _BAR_POINTS) for name, colour in colours.items()], list(_MARKS))
    rows = [(*row, c * (_WIDE + _GAP), float(k)) for c, column in enumerate(columns) for k, row in enumerate(column)]
    drawn = rr.LineStrips2D(
        [[[x, y], [x + _WIDE, y]] for _, _, _, x, y in rows],
        colors=[colour for _, colour, *_ in rows],
        radii=rr.Radius.ui_points([points for _, _, points, *_ in rows]),
    )
    out.static(["legend", "bars"], drawn)
    # A label stands below its point: with it a little higher, it is on the bar.
    names = rr.Points2D(
        [[x + _WIDE / 2, y - 0.4] for *_, x, y in rows],
        labels=[name for name, *_ in rows],
        colors=[NOTICED],
        radii=rr.Radius.ui_points(0.0),
        show_labels=True,
    )
    out.static(["legend", "names"], names)
