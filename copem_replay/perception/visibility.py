"""The visible share of an upright box, seen from a unit: exact to rounding.

`surface`: uniform in azimuth over the target's angular extent; at each azimuth the share of the column of the target's
nearest face, bottom to top, that no body in front of it covers. `flat`: the same with infinitely high bodies. A box
whose footprint overlaps the target's does not hide it; an obstacle hides wherever its face is nearer than the target's.
A unit inside the target's footprint sees 1; a unit inside another body, between its bottom and its top, ignores that
body; a unit's own carrier neither hides nor is seen. The integration is in perception/visibility_kernel.py.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, PlainSerializer, WithJsonSchema
from pydantic_core import PydanticKnownError

from copem_replay.core.compiled import call_in_room
from copem_replay.core.components import Component, Slot, ask_component, wrong_answer_error
from copem_replay.core.errors import is_own
from copem_replay.core.tracks import Bool, Float, Int, Tracks
from copem_replay.perception.visibility_kernel import Boxes, compute_shares
from copem_replay.perception.visibility_kernel import Observers as Observers
from copem_replay.perception.visibility_kernel import Statics as Statics

if TYPE_CHECKING:
    import shapely

_ROWS_PER_THREAD = 20_000
"""Views that a thread computes at least: with fewer it costs more than it brings. No result depends on it."""


def make_statics(
    polygons: Sequence[Float | shapely.Polygon] | NDArray[np.object_],
    bottom_m: Sequence[float],
    height_m: Sequence[float],
) -> Statics:
    """Static obstacles from simple polygons, each (K, 2), or with holes; convex or not, any order of corners."""
    import shapely

    outlines = np.empty(len(polygons), dtype=object)
    outlines[:] = [p if isinstance(p, shapely.Polygon) else shapely.Polygon(p) for p in polygons]
    parts: list[Float] = []
    body: list[int] = []
    for k, pieces in enumerate(_cut_all_convex(shapely.orient_polygons(outlines))):
        parts += pieces
        body += [k] * len(pieces)
    index = np.array(body, dtype=np.int64)
    bottom = np.array(bottom_m, dtype=float)
    return Statics(
        xy_m=np.concatenate([*parts, np.empty((0, 2))]),
        start=np.concatenate([[0], np.cumsum([len(p) for p in parts])]).astype(np.int64),
        body=index,
        bottom_m=bottom[index],
        top_m=(bottom + np.array(height_m, dtype=float))[index],
    )


def _cut_all_convex(polygons: NDArray[np.object_]) -> Iterator[list[Float]]:
    """The convex parts of each polygon, counter-clockwise ones. Most are their own: that is asked of all at once."""
    import shapely

    hulls, areas_m2 = shapely.convex_hull(polygons), shapely.area(polygons)
    convex = (shapely.get_num_interior_rings(polygons) == 0) & (shapely.area(hulls) - areas_m2 <= 1e-9 * areas_m2)
    for is_convex, polygon, hull in zip(convex, polygons, shapely.orient_polygons(hulls), strict=True):
        yield [shapely.get_coordinates(hull)[:-1]] if is_convex else cut_convex(polygon)


def cut_convex(polygon: shapely.Polygon) -> list[Float]:
    """Convex parts of a polygon, corners (K, 2) counter-clockwise; holes stay holes.

    Constrained Delaunay triangles, of which edges are dropped as long as both ends stay convex (Hertel and Mehlhorn:
    at most four times as many parts as are needed).
    """
    import shapely

    triangles = shapely.constrained_delaunay_triangles(shapely.orient_polygons(polygon)).geoms
    rings = {k: [(x, y) for x, y in _corners_of(triangle)] for k, triangle in enumerate(triangles)}
    owner = {edge: k for k, ring in rings.items() for edge in _edges_of(ring)}
    for a, b in [(a, b) for a, b in owner if a < b and (b, a) in owner]:
        first_ix, second_ix = owner[a, b], owner[b, a]
        merged = _merge_rings(rings[first_ix], rings[second_ix], a, b) if first_ix != second_ix else None
        if merged is not None:
            rings[first_ix] = merged
            owner |= dict.fromkeys(_edges_of(rings.pop(second_ix)), first_ix)
    return [_corners_of(shapely.Polygon(ring).convex_hull) for ring in rings.values()]


def _corners_of(polygon: shapely.Polygon) -> Float:
    import shapely

    return np.array(shapely.orient_polygons(polygon).exterior.coords)[:-1]


_Corner = tuple[float, float]


def _edges_of(ring: list[_Corner]) -> list[tuple[_Corner, _Corner]]:
    return list(zip(ring, ring[1:] + ring[:1], strict=True))


def _merge_rings(ring_a: list[_Corner], ring_b: list[_Corner], a: _Corner, b: _Corner) -> list[_Corner] | None:
    """Two convex rings without the edge a–b that both have; None: they are not convex together."""
    start, end = ring_a.index(b), ring_b.index(a)
    first, second = ring_a[start:] + ring_a[:start], ring_b[end:] + ring_b[:end]  # b … a, and a … b
    if not _turns_left(first[-2], a, second[1]) or not _turns_left(second[-2], b, first[1]):
        return None
    return first + second[1:-1]


def _turns_left(before: _Corner, at: _Corner, after: _Corner) -> bool:
    """Whether a way turns to the left, or not at all as far as rounding lets it be known."""
    ux, uy, vx, vy = at[0] - before[0], at[1] - before[1], after[0] - at[0], after[1] - at[1]
    return ux * vy - uy * vx >= -1e-12 * (ux * ux + uy * uy + vx * vx + vy * vy) and (vx, vy) != (-ux, -uy)


NO_STATICS = Statics(
    np.empty((0, 2)), np.zeros(1, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty(0), np.empty(0)
)


class VisibilityModel(Component, ABC):
    """Base of what `visibility:` may name: how much of each object shows. A list depends on no other list.

    >>> class Nothing(cr.VisibilityModel):
    ...     def shares(self, world, static, observers):
    ...         return np.ones((len(observers.carrier_ix), len(world.frame_ix)))
    """

    @abstractmethod
    def shares(self, world: Tracks, static: Statics, observers: Observers) -> Float:
        """Visible share of every row of the world from every unit: (U, P), 0 … 1.

        What stands where the unit is absent, or for its carrier, is not read.
        """

    def hidden_by(self, world: Tracks, static: Statics, observers: Observers) -> Int:
        """Which body alone hides most of each row of the world from each unit: (U, P), a row of the world.

        −1: none hides any of it; −2 − k: the obstacle k. For showing only; a model that does not know says none.
        """
        return np.full((len(observers.carrier_ix), len(world.frame_ix)), -1)

    @property
    def label(self) -> str:
        """The model in one line: its kind, and what is not by default."""
        said = self.model_dump(mode="json", by_alias=True, exclude={"kind"}, exclude_defaults=True)
        return f"{self.kind} ({', '.join(f'{key}: {value}' for key, value in said.items())})" if said else self.kind


class _BuiltInModel(VisibilityModel):
    """Base of the built-in models: NaN where the unit is absent, for its carrier, and where no share is asked for."""

    flat: ClassVar[bool]

    def shares(self, world: Tracks, static: Statics, observers: Observers, needed: Bool | None = None) -> Float:
        order, _bounds = world.by_frame
        seen, _blocker = _compute_views(world, static, observers, needed, flat=self.flat, blockers=False)
        shares = np.empty_like(seen)
        shares[:, order] = seen
        return shares

    def hidden_by(self, world: Tracks, static: Statics, observers: Observers) -> Int:
        order, _bounds = world.by_frame
        _seen, listed = _compute_views(world, static, observers, None, flat=self.flat, blockers=True)
        blocker = np.empty_like(listed)
        blocker[:, order] = np.where(listed >= 0, order[listed], listed) if len(order) else listed
        return blocker


class Surface(_BuiltInModel):
    """The share of the surface that faces the unit, with bodies as high as they are."""

    kind: Literal["surface"] = "surface"
    flat: ClassVar[bool] = False


class Flat(_BuiltInModel):
    """The share of the outline seen from above, with infinitely high bodies."""

    kind: Literal["flat"] = "flat"
    flat: ClassVar[bool] = True


BUILT_IN: dict[str, VisibilityModel] = {"surface": Surface(), "flat": Flat()}
"""The models that plain words stand for."""


def _model_from_word(value: object) -> object:
    """The model that a plain word stands for; the keys of a user's own are left to its slot."""
    if isinstance(value, VisibilityModel | Mapping):
        return value
    if not isinstance(value, str) or value not in BUILT_IN:
        raise PydanticKnownError("literal_error", {"expected": " or ".join(map(repr, BUILT_IN))})
    return BUILT_IN[value]


def _model_as_data(model: VisibilityModel) -> object:
    return model.kind if model.kind in BUILT_IN else model.model_dump(mode="json", by_alias=True)


Visibility = Annotated[
    VisibilityModel,
    Slot("visibility", {}),
    BeforeValidator(_model_from_word),
    PlainSerializer(_model_as_data),
    WithJsonSchema(
        {
            "anyOf": [
                {"enum": list(BUILT_IN), "type": "string"},
                {"type": "object", "properties": {"kind": {"type": "string", "pattern": ":"}}, "required": ["kind"]},
            ]
        }
    ),
]
"""`visibility:` of an experiment: a plain word, or a model of the user's own, `{kind: package.module:Class}`."""


def visible_shares(
    world: Tracks, static: Statics, observers: Observers, model: VisibilityModel, needed: Bool | None = None
) -> Float:
    """Visible share of every row of the world from every unit: (U, P); NaN where the unit is absent or the carrier.

    `needed (U, P)`: those to compute, the others may be NaN; None: all. A model of the user's own gives all. Raises
    InputError where one fails, or gives no shares.
    """
    expected = (len(observers.carrier_ix), len(world.frame_ix))
    if not expected[1]:  # a model is not asked about no rows
        return np.zeros(expected)
    if isinstance(model, _BuiltInModel) and not is_own(type(model)):
        return model.shares(world, static, observers, needed)
    shares = ask_component(model, "visibility", lambda: np.asarray(model.shares(world, static, observers), dtype=float))
    if shares.shape != expected:
        raise wrong_answer_error(
            model, "visibility", f"shares: expected shape {expected}, found {shares.shape}", "shares"
        )
    viewed = observers.present[:, world.frame_ix] & (world.row_object_ix != observers.carrier_ix[:, None])
    invalid = viewed & ~((shares >= 0) & (shares <= 1 + 1e-12))
    if invalid.any():
        raise wrong_answer_error(model, "visibility", f"shares: expected 0 … 1, found {shares[invalid][0]}", "shares")
    return np.where(viewed, shares, np.nan)


def find_blockers(world: Tracks, static: Statics, observers: Observers, model: VisibilityModel) -> Int:
    """The body that alone hides most of each row of the world from each unit: (U, P), a row of the world.

    −1: none hides any of it; −2 − k: the obstacle k. Raises InputError where a model of the user's own fails.
    """
    blockers = ask_component(model, "visibility", lambda: np.asarray(model.hidden_by(world, static, observers)))
    if is_own(type(model)):
        expected = (len(observers.carrier_ix), len(world.frame_ix))
        least = -2 - int(static.body.max(initial=-1))
        whole = blockers.shape == expected and blockers.dtype.kind in "iu"
        if not whole or ((blockers < least) | (blockers >= max(expected[1], 1))).any():
            message = f"hidden_by: expected whole numbers {least} … {expected[1] - 1} of shape {expected}"
            raise wrong_answer_error(
                model, "visibility", f"{message}, found {blockers.dtype.name} of shape {blockers.shape}", "hidden_by"
            )
    return blockers


def _compute_views(
    world: Tracks, static: Statics, observers: Observers, needed: Bool | None, *, flat: bool, blockers: bool
) -> tuple[Float, Int]:
    """Shares (U, P) by list, NaN: not needed; with `blockers` also which row hides most of each (−1: none)."""
    order, bounds = world.by_frame
    n_units, n_frames = observers.present.shape
    out = np.full((n_units, len(order)), np.nan)
    blocker = np.full((n_units, len(order)) if blockers else (0, 0), -1)
    if not len(order):
        return out, blocker
    z, half = world.z_m[0, order], world.height_m[0, order] / 2
    boxes = Boxes(bounds, box_corners(world)[order], z - half, z + half, world.row_object_ix[order])
    place_m, present = np.ascontiguousarray(observers.place_m), np.ascontiguousarray(observers.present)
    places = Observers(place_m, present, observers.carrier_ix)
    if needed is None:
        needed = np.ones(out.shape, dtype=bool)
    needed_rows = np.ascontiguousarray(needed[:, order])
    threads = min(8, os.cpu_count() or 1)
    pieces = max(1, min(4 * threads, n_units * len(order) // _ROWS_PER_THREAD, n_frames))
    # Cuts with about as many rows each, so that threads end together.
    cuts = np.searchsorted(bounds, np.linspace(0, len(order), pieces + 1)[1:-1])
    edges = [0, *sorted(int(c) for c in cuts), n_frames]
    with ThreadPoolExecutor(threads) as pool:
        list(
            pool.map(
                lambda k: call_in_room(
                    compute_shares, edges[k], edges[k + 1], boxes, static, places, needed_rows, flat, out, blocker
                ),
                range(pieces),
            )
        )
    return out, blocker


def box_corners(tracks: Tracks) -> Float:
    """Corners of the boxes' footprints in the first run, counter-clockwise: (P, 4, 2)."""
    return rectangle_corners(tracks.x_m[0], tracks.y_m[0], tracks.yaw_rad[0], tracks.length_m[0], tracks.width_m[0])


def rectangle_corners(x_m: Float, y_m: Float, yaw_rad: Float, length_m: Float, width_m: Float) -> Float:
    """Corners of rectangles, counter-clockwise: (P, 4, 2)."""
    cos, sin = np.cos(yaw_rad)[:, None], np.sin(yaw_rad)[:, None]
    forward = length_m[:, None] / 2 * np.array([1.0, -1.0, -1.0, 1.0])
    left = width_m[:, None] / 2 * np.array([1.0, 1.0, -1.0, -1.0])
    return np.stack([x_m[:, None] + cos * forward - sin * left, y_m[:, None] + sin * forward + cos * left], axis=-1)
