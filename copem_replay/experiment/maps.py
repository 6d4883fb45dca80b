"""Maps of an experiment, and what they add to a recording: lines to draw, areas, solids, and whether they agree."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Final, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import PrivateAttr, model_validator

from copem_replay.core.components import FileBeside, Flag, Frozen, Positive, error_at_key
from copem_replay.core.errors import InputError, count_noun
from copem_replay.core.extras import load_extra
from copem_replay.core.frame import Frame, SaidPlace
from copem_replay.core.site_map import MapSolid, SiteMap, find_borders, make_polygon, outline_crosswalks
from copem_replay.core.tracks import FROM_MAP, Solid, make_outlines, outline_solids
from copem_replay.core.yaml import Key
from copem_replay.io.open import sha256_of
from copem_replay.io.recording import Recording
from copem_replay.metrics.agreement import (
    NOTED_BELOW,
    REFUSED_BELOW,
    SOLIDS_REFUSED_ABOVE,
    Inside,
    find_agreement,
    find_inside,
)
from copem_replay.perception.config import InPlane
from copem_replay.perception.sensor_poses import FAR_GROUND_M, find_grounds, make_solid_statics

SolidKind = Literal["building", "wall", "hedge", "barrier", "vegetation", "pole"]
_KINDS_OF: Final[Mapping[SolidKind, tuple[str, ...]]] = {
    "wall": ("wall", "retaining_wall", "city_wall"),
    "barrier": ("barrier", "railing", "obstacle"),
    "vegetation": ("vegetation", "tree"),
    "pole": ("pole", "gantry"),
}
"""Kinds of maps by those that are asked for; others by their own name."""
_MOST_PARTS: Final = 50_000
"""Convex parts of the solids of one log: each is looked at from each unit in each list."""


DEFAULT_HEIGHTS_M: Final[Mapping[str, float]] = {
    "building": 8.0, "wall": 2.0, "hedge": 1.5, "retaining_wall": 2.0, "city_wall": 5.0, "level": 3.0,
}  # fmt: skip
"""By kind, where the map does not say; `level`: of one storey."""


class MapHeights(Frozen):
    """Metres by kind, where a map does not say; `level`: of one storey."""

    building: Positive = DEFAULT_HEIGHTS_M["building"]
    wall: Positive = DEFAULT_HEIGHTS_M["wall"]
    hedge: Positive = DEFAULT_HEIGHTS_M["hedge"]
    retaining_wall: Positive = DEFAULT_HEIGHTS_M["retaining_wall"]
    city_wall: Positive = DEFAULT_HEIGHTS_M["city_wall"]
    level: Positive = DEFAULT_HEIGHTS_M["level"]


class MapFile(Frozen):
    """A map: OpenStreetMap, GeoJSON, OpenDRIVE, Lanelet2 or Argoverse 2. `file` is relative to the experiment file.

    `frame: same`: the map's metres are the log's; left out: by its own reference and the log's place. `offset_m` is
    added to its metres. `lanes`: they are drawn, and held against the traffic. `solids`: the map's objects hide, or
    those of the kinds that are listed; `within_m`: those this near to any object of the log.
    `agreement: ignore`: a map whose lanes the traffic does not keep to is not refused.
    """

    file: FileBeside
    frame: Literal["same"] | None = None
    offset_m: InPlane = (0.0, 0.0)
    lanes: Flag = True
    solids: Flag | tuple[SolidKind, ...] = True
    heights_m: MapHeights = MapHeights()
    within_m: Positive = 200.0
    agreement: Literal["check", "ignore"] = "check"
    _sha256: str = PrivateAttr("")

    @model_validator(mode="after")
    def _read(self) -> Self:
        try:
            if not Path(self.file).is_file():
                raise InputError(f"{self.file}: no such file")
            self._sha256 = sha256_of(Path(self.file))
            if self.read_once().degrees and self.frame == "same":
                raise InputError(f"{self.file}: its places are degrees, not metres of the log: no `frame: same`")
        except InputError as error:
            raise error_at_key("file", str(error)) from None
        return self

    @property
    def sha256(self) -> str:
        """Of the file when the experiment was read."""
        return self._sha256

    def read_once(self) -> SiteMap:
        """The map in its file's frame. Raises InputError."""
        return _read_map_once(self.file, self._sha256, tuple(self.heights_m.model_dump().items()))

    def place(self, frame: Frame | None) -> SiteMap:
        """The map in metres of a log with this frame (None: it has none). Raises InputError: its place is unknown."""
        site, offset_m = self.read_once(), np.array(self.offset_m)
        if self.frame == "same":
            return site.moved(lambda at_m: at_m + offset_m)
        if not site.degrees and not site.proj:
            raise InputError(f"{self.file}: its places are metres: expected `frame: same` where they are the log's")
        if frame is None:
            units = "degrees" if site.degrees else f"metres of {site.proj!r}"
            expected = "expected `frame: {proj: …}` of the log" + " or, where they are the log's, `frame: same`" * (
                not site.degrees
            )
            raise InputError(f"{self.file}: its places are {units}, and the log does not say where it is: {expected}")
        try:
            if site.degrees:
                return site.moved(lambda degrees: frame.from_wgs84(degrees[:, ::-1]) + offset_m)
            of_map, notes = SaidPlace(site.proj, site.offset_m, site.yaw_rad).read()
            moved = site.moved(lambda at_m: frame.take(of_map, at_m + offset_m))
        except InputError as error:
            raise InputError(f"{self.file}: {error}") from None
        return replace(moved, assumed=(*moved.assumed, *notes))

    def choose_kinds(self, site: SiteMap) -> list[MapSolid]:
        """The solids of a map of the requested kinds."""
        if isinstance(self.solids, bool):
            return list(site.solids) if self.solids else []
        wanted = {name for kind in self.solids for name in _KINDS_OF.get(kind, (kind,))}
        return [solid for solid in site.solids if solid.kind in wanted]


@lru_cache(maxsize=4)
def _read_map_once(file: str, _sha256: str, heights_m: tuple[tuple[str, float], ...]) -> SiteMap:
    site: SiteMap = load_extra("reader", "map")(Path(file), dict(heights_m))
    return site


def add_maps(
    recording: Recording, maps: Sequence[MapFile], frame: Frame | None = None
) -> tuple[Recording, list[tuple[Key, str]]]:
    """A recording with the content of its maps added, and the problems with them by key. `frame`: of the recording."""
    lines, areas, solids = list(recording.lane_boundaries), list(recording.scene.areas), list(recording.scene.solids)
    lanes, notes, problems = list(recording.lanes), list(recording.notes), list[tuple[Key, str]]()
    if lanes:
        notes.append(f"lanes of the recording: {find_agreement(recording.scene, recording.truth, lanes).words}")
    for k, source in enumerate(maps):
        where = f"{FROM_MAP}{k}] {Path(source.file).name}"
        try:
            site = source.place(frame)
        except InputError as error:
            problems.append((("maps", k), str(error)))
            continue
        notes += [f"{where}: {site.licence}"] if site.licence else []
        notes += [f"{where}: {line}" for line in site.assumed]
        if source.lanes and site.lanes:
            found = find_agreement(recording.scene, recording.truth, site.lanes)
            notes.append(f"{where}: {found.words}")
            if found.refused and source.agreement == "check":
                problems.append((("maps", k), _explain_refusal(source, found.share or 0.0)))
            lines += [*find_borders(site.lanes), *outline_crosswalks(site.areas, site.lanes)]
            lanes += site.lanes
        drawn = [area for area in site.areas if not make_polygon(area.rings_m).is_empty]
        areas += drawn
        if len(drawn) < len(site.areas):
            left_out = count_noun(len(site.areas) - len(drawn), "area")
            notes.append(f"{where}: {left_out} whose outline crosses itself or has no extent: left out")
        near, said, refused = _choose_solids(recording, source.choose_kinds(site), source.within_m, where)
        solids += near
        notes += [f"{where}: {line}" for line in said]
        if site.lanes:
            continue
        problems += [(("maps", k), refused)] if refused else []
        inside = find_inside(recording.scene, recording.truth, outline_solids(near))
        notes += [f"{where}: {inside.words}"] if inside.words else []
        if inside.refused and source.agreement == "check":
            problems.append((("maps", k), _explain_inside(source, inside)))
    corners = sum(len(solid.corners_m) + sum(map(len, solid.holes_m)) + 2 * len(solid.holes_m) for solid in solids)
    # As many triangles at most as corners, and two more for each hole: most maps need not be cut to know.
    if maps and corners > _MOST_PARTS and (parts := len(make_solid_statics(solids).body)) > _MOST_PARTS:
        expected = f"expected solids of at most {_MOST_PARTS:,} convex parts, found {parts:,}"
        problems.append((("maps",), f"{expected}: take a smaller `within_m`, or fewer kinds as `solids`"))
    scene = replace(recording.scene, areas=tuple(areas), solids=tuple(solids))
    return replace(
        recording, scene=scene, lane_boundaries=tuple(lines), lanes=tuple(lanes), notes=tuple(notes)
    ), problems


def _explain_refusal(source: MapFile, share: float) -> str:
    return (
        f"{Path(source.file).name}: expected at least {REFUSED_BELOW:.0%} of the states of moving vehicles in a lane "
        f"of their heading (on real drives {NOTED_BELOW:.0%} and more), found {share:.0%}: is the map in the frame of "
        "the log? `copem-replay info LOG --map FILE` estimates a shift for `offset_m`; or `agreement: ignore`"
    )


def _explain_inside(source: MapFile, inside: Inside) -> str:
    return (
        f"{Path(source.file).name}: expected at most {SOLIDS_REFUSED_ABOVE:.0%} of the states of moving vehicles "
        f"inside its solids, found {inside.share:.0%}: is the map in the frame of the log? Or `agreement: ignore`"
    )


def _choose_solids(
    recording: Recording, solids: Sequence[MapSolid], within_m: float, where: str
) -> tuple[list[Solid], list[str], str]:
    """The solids near any object of the log; notes on skipped solids; and the reason where no solid is left."""
    import shapely

    counts, truth = Counter[str](), recording.truth
    valid = truth.valid[0]
    at_m = np.unique(np.round(truth.x_m[0, valid]) + 1j * np.round(truth.y_m[0, valid]))  # pairs would be sorted slowly
    outlines = make_outlines([solid.rings_m for solid in solids])
    usable = np.flatnonzero(shapely.is_valid(outlines) & (shapely.area(outlines) > 0.0))
    distance_m = np.full(len(usable), np.inf)
    if len(at_m) and len(usable):
        (solid_number, _), nearest_m = shapely.STRtree(shapely.points(at_m.real, at_m.imag)).query_nearest(
            outlines[usable], return_distance=True, all_matches=False
        )
        distance_m[solid_number] = nearest_m
    chosen = usable[distance_m <= within_m]
    counts["whose outline crosses itself: left out"] += len(solids) - len(usable)
    counts[f"beyond {within_m:g} m of every object: left out"] += len(usable) - len(chosen)
    near, far_m = _stand_solids(recording, [solids[k] for k in chosen], outlines[chosen], where)
    lines = [f"{count_noun(len(near), 'solid')} of the map may hide"] if near else []
    lines += [f"{count_noun(number, 'solid')} {what}" for what, number in counts.items() if number]
    if far_m:
        what = f"ground of {count_noun(len(far_m), 'solid')} taken from the nearest object"
        lines.append(f"{what}, up to {max(far_m):.0f} m away")
    least_m = distance_m.min(initial=np.inf)
    if near or not np.isfinite(least_m):
        return near, lines, ""
    found = f"0 of {count_noun(len(solids), 'solid')} within {within_m:g} m of the log"
    return near, lines, f"{where.split(' ', 1)[1]}: {found}; nearest {_write_km(least_m)}: is the frame right?"


def list_far_units(
    recording: Recording, maps: Sequence[MapFile], places_m: Mapping[str, tuple[float, float]]
) -> Iterator[str]:
    """A note on each place of a unit, by name, near which solids of a map may be left out: no object comes near it."""
    import shapely

    truth, reach_m = recording.truth, min((asked.within_m for asked in maps if asked.solids), default=np.inf)
    valid = truth.valid[0]
    if not np.isfinite(reach_m) or not valid.any() or not recording.scene.solids:
        return
    tree = shapely.STRtree(shapely.points(truth.x_m[0, valid], truth.y_m[0, valid]))
    for name, at_m in places_m.items():
        _, (distance_m, *_) = tree.query_nearest(shapely.Point(at_m), return_distance=True)
        if distance_m > reach_m:
            what = "solids of maps near it are left out"
            yield f"units.{name}: {distance_m:.0f} m from every object; {what} (`within_m: {reach_m:g}`)"


def _write_km(distance_m: float) -> str:
    return f"{distance_m / 1000:,.0f} km" if distance_m >= 100_000.0 else f"{distance_m / 1000:.3g} km"


def _stand_solids(
    recording: Recording, solids: Sequence[MapSolid], outlines: NDArray[np.object_], where: str
) -> tuple[list[Solid], list[float]]:
    """Solids of a map at their heights, and how far away the ground of some was found, of those where that is far."""
    grounds_m, distances_m = np.zeros(len(solids)), np.zeros(len(solids))
    above = np.flatnonzero([solid.above_ground for solid in solids])
    grounds_m[above], distances_m[above] = find_grounds(recording.truth, outlines[above])
    stood = []
    for solid, ground_m in zip(solids, grounds_m.tolist(), strict=True):
        outer, *holes = (tuple((x, y) for x, y in ring.tolist()) for ring in solid.rings_m)
        name, bottom_m, height_m = f"{where} {solid.name}", ground_m + solid.bottom_m, solid.top_m - solid.bottom_m
        stood.append(Solid(name, outer, bottom_m, height_m, solid.on_ground, tuple(holes)))
    return stood, distances_m[distances_m > FAR_GROUND_M].tolist()
