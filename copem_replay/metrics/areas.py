"""Areas of a site: whether places are in those that are named, and in which one each episode begins."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.interpolation import interpolate_states
from copem_replay.core.site_map import make_polygon
from copem_replay.core.tracks import Area, Bool, Float, Scene, Tracks
from copem_replay.metrics.config import MetricsSetup

if TYPE_CHECKING:
    from copem_replay.metrics.episodes import Episodes

_KINDS: Final = ("crosswalk", "junction", "parking", "drivable")
"""Of maps, in the order in which they are asked: a crosswalk lies in a junction or in what is drivable."""


def are_in_areas(x_m: Float, y_m: Float, scene: Scene, names: Sequence[str], experiment: MetricsSetup) -> Bool:
    """(M,) whether places are in any area of these names or kinds, of the experiment or of the log's maps."""
    inside = np.zeros(len(x_m), dtype=bool)
    for name in names:
        if (own := experiment.areas.get(name)) is not None:
            inside |= own.covers(x_m, y_m)
        else:
            inside |= are_in_named(x_m, y_m, scene.areas, [name])
    return inside


def are_in_named(x_m: Float, y_m: Float, areas: Sequence[Area], names: Sequence[str]) -> Bool:
    """(M,) whether places are in any of the areas of these names or kinds, or on a border."""
    import shapely

    inside, points = np.zeros(len(x_m), dtype=bool), shapely.points(x_m, y_m)
    for area in areas:
        if area.name in names or area.kind in names:
            inside |= shapely.intersects(make_polygon(area.rings_m), points)
    return inside


def name_areas(scene: Scene, truth: Tracks, episodes: Episodes, experiment: MetricsSetup) -> NDArray[np.object_]:
    """(M,) the area in which the centre of each object is at its onset; None: in none, or in a gap of the truth.

    It is the first of one's own, in the order of the experiment, else the first kind of the log's maps.
    """
    state, present = interpolate_states(
        truth, episodes.object_ix, episodes.onset_s, t0_ns=scene.t0_ns, max_gap_s=experiment.max_gap_s
    )
    named, nowhere = np.full(len(present), None, dtype=object), present.copy()
    for name, inside in _list_areas(state["x_m"], state["y_m"], scene, experiment):
        named[inside & nowhere] = name
        nowhere &= ~inside
    return named


def _list_areas(x_m: Float, y_m: Float, scene: Scene, experiment: MetricsSetup) -> Iterator[tuple[str, Bool]]:
    for name, own in experiment.areas.items():
        yield name, own.covers(x_m, y_m)
    for kind in _KINDS:
        yield kind, are_in_named(x_m, y_m, scene.areas, [kind])
