"""Maps of an experiment, and what they add to a recording: lines to draw, areas, solids, and whether they agree."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, PrivateAttr, ValidationInfo, field_validator, model_validator

from copem_replay.core.components import Flag, Frozen, Positive, error_at_key
from copem_replay.core.errors import InputError, count_noun
from copem_replay.core.site_map import MapSolid, SiteMap, find_borders, make_polygon
from copem_replay.core.tracks import Float, Solid
from copem_replay.core.yaml import Key
from copem_replay.io.maps.registry import read_map
from copem_replay.io.open import sha256_of
from copem_replay.io.recording import Recording
from copem_replay.metrics.agreement import NOTED_BELOW, REFUSED_BELOW, find_agreement
from copem_replay.perception.config import InPlane


class MapFile(Frozen):
    """A map: OpenDRIVE, Lanelet2 or Argoverse 2, told apart by content. `file` is relative to the experiment file.

    `frame: same`: the map's metres are the log's. `offset_m` is added to them. `lanes`: they are drawn, and held
    against the traffic. `solids`: the map's objects hide; `within_m`: those this near to any object of the log.
    `agreement: ignore`: a map whose lanes the traffic does not keep to is not refused.
    """

    file: Annotated[str, Field(min_length=1)]
    frame: Literal["same"]
    offset_m: InPlane = (0.0, 0.0)
    lanes: Flag = True
    solids: Flag = True
    within_m: Positive = 200.0
    agreement: Literal["check", "ignore"] = "check"
    _sha256: str = PrivateAttr("")

    @field_validator("file")
    @classmethod
    def _beside(cls, file: str, info: ValidationInfo) -> str:
        folder = (info.context or {}).get("folder")
        return file if folder is None else str(Path(folder) / file)

    @model_validator(mode="after")
    def _read(self) -> Self:
        try:
            if not Path(self.file).is_file():
                raise InputError(f"{self.file}: no such file")
            self._sha256 = sha256_of(Path(self.file))
            if _read_map_once(self.file, self._sha256).degrees:
                raise InputError(f"{self.file}: its places are degrees, not metres of the log: no `frame: same`")
        except InputError as error:
            raise error_at_key("file", str(error)) from None
        return self

    @property
    def sha256(self) -> str:
        """Of the file when the experiment was read."""
        return self._sha256

    @property
    def site(self) -> SiteMap:
        """The map in the frame of the log."""
        offset_m = np.array(self.offset_m)
        return _read_map_once(self.file, self._sha256).moved(lambda at_m: at_m + offset_m)


@lru_cache(maxsize=4)
def _read_map_once(file: str, _sha256: str) -> SiteMap:
    return read_map(Path(file))


def add_maps(recording: Recording, maps: Sequence[MapFile]) -> tuple[Recording, list[tuple[Key, str]]]:
    """A recording with what its maps add, and the problems with them, by key."""
    lines, areas, solids = list(recording.lane_boundaries), list(recording.scene.areas), list(recording.scene.solids)
    notes, problems = list(recording.notes), list[tuple[Key, str]]()
    for k, asked in enumerate(maps):
        site, where = asked.site, f"maps[{k}] {Path(asked.file).name}"
        notes += [f"{where}: {line}" for line in site.assumed]
        if asked.lanes and site.lanes:
            found = find_agreement(recording.scene, recording.truth, site.lanes)
            notes.append(f"{where}: {found.words}")
            if found.refused and asked.agreement == "check":
                problems.append((("maps", k), _explain_refusal(asked, found.share or 0.0)))
            lines += [*find_borders(site.lanes), *_raise_crosswalks(site)]
        drawn = [area for area in site.areas if not make_polygon(area.rings_m).is_empty]
        areas += drawn
        if len(drawn) < len(site.areas):
            left_out = count_noun(len(site.areas) - len(drawn), "area")
            notes.append(f"{where}: {left_out} whose outline crosses itself or has no extent: left out")
        near, counts = _choose_solids(recording, site.solids if asked.solids else (), asked.within_m, where)
        solids += near
        notes += [f"{where}: {count_noun(number, 'solid')} {what}" for what, number in counts.items()]
    scene = replace(recording.scene, areas=tuple(areas), solids=tuple(solids))
    return replace(recording, scene=scene, lane_boundaries=tuple(lines), notes=tuple(notes)), problems


def _explain_refusal(asked: MapFile, share: float) -> str:
    return (
        f"{Path(asked.file).name}: expected at least {REFUSED_BELOW:.0%} of the states of moving vehicles in a lane of "
        f"their heading (on real drives {NOTED_BELOW:.0%} and more), found {share:.0%}: is the map in the frame of the "
        "log? `copem-replay info LOG --map FILE` estimates a shift for `offset_m`; or `agreement: ignore`"
    )


def _raise_crosswalks(site: SiteMap) -> Iterator[Float]:
    """The outlines of crosswalks, each corner as high as the nearest point of a lane's border."""
    from scipy.spatial import KDTree

    points = np.concatenate([line for lane in site.lanes for line in (lane.left_m, lane.right_m)])
    tree = KDTree(points[:, :2])
    for area in site.areas:
        if area.kind == "crosswalk":
            ring = np.array([*area.rings_m[0], area.rings_m[0][0]])
            yield np.column_stack([ring, points[tree.query(ring)[1], 2]])


def _choose_solids(
    recording: Recording, solids: Sequence[MapSolid], within_m: float, where: str
) -> tuple[list[Solid], Counter[str]]:
    """The solids near any object of the log, and how many are left out and why."""
    import shapely

    counts, near = Counter[str](), list[Solid]()
    if not solids:
        return near, counts
    truth = recording.truth
    valid = truth.valid[0]
    at_m = np.unique(np.round(np.stack([truth.x_m[0, valid], truth.y_m[0, valid]], axis=1)), axis=0)
    tree = shapely.STRtree(shapely.points(at_m))
    for solid in solids:
        outline = shapely.Polygon(solid.rings_m[0], solid.rings_m[1:])
        if not outline.is_valid or outline.area <= 0.0:
            counts["whose outline crosses itself: left out"] += 1
        elif not len(tree.query(outline, predicate="dwithin", distance=within_m)):
            counts[f"beyond {within_m:g} m of every object: left out"] += 1
        else:
            corners = tuple((float(x), float(y)) for x, y in solid.rings_m[0])
            name = f"{where} {solid.name}"
            near.append(Solid(name, corners, solid.bottom_m, solid.top_m - solid.bottom_m))
    if near:
        counts = Counter({"of the map may hide": len(near)}) + counts
    return near, counts
