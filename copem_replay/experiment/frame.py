"""The frame of a log: as the experiment file writes it, and as it is found from all who say it."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Final, Self

from pydantic import Field, PrivateAttr, model_validator

from copem_replay.core.components import Frozen, Number, error_at_key
from copem_replay.core.errors import InputError, quote_value
from copem_replay.core.frame import (
    Frame,
    SaidPlace,
    check_scale,
    distance_on_earth_m,
    make_frame,
    make_local_proj,
    read_argoverse2_city,
    read_mgrs,
)
from copem_replay.experiment.maps import MapFile
from copem_replay.io.recording import Recording, find_middle
from copem_replay.perception.config import InPlane, OnEarthPlace


class ProjWord(Frozen):
    """One of: metres east and north of a place, of a square of MGRS, or of a city of Argoverse 2."""

    at_wgs84: OnEarthPlace | None = None
    mgrs: str | None = None
    argoverse2: str | None = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        given = [name for name in ("at_wgs84", "mgrs", "argoverse2") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"expected one of at_wgs84, mgrs, argoverse2, found {' and '.join(given) or 'none'}")
        return self

    def read(self) -> tuple[str, tuple[float, float]]:
        """What PROJ knows, and the offset of the log's metres to it. Raises InputError."""
        if self.at_wgs84 is not None:
            return make_local_proj(*self.at_wgs84), (0.0, 0.0)
        return read_mgrs(self.mgrs) if self.mgrs is not None else read_argoverse2_city(str(self.argoverse2))


class FrameOfLog(Frozen):
    """Where a log's metres are on earth: turned by `yaw_deg`, then moved by `offset_m`, they are those of `proj`.

    `proj`: whatever PROJ takes, such as EPSG:25832, or `{at_wgs84: [latitude, longitude]}`, `{mgrs: 54SUE}`,
    `{argoverse2: PIT}`. Left out: what the recording says.
    """

    proj: Annotated[str, Field(min_length=1)] | ProjWord
    offset_m: InPlane = (0.0, 0.0)
    yaw_deg: Number = 0.0
    _frame: Frame | None = PrivateAttr(None)
    _notes: tuple[str, ...] = PrivateAttr(())

    @model_validator(mode="before")
    @classmethod
    def _hint_key(cls, written: object) -> object:
        if isinstance(written, Mapping | FrameOfLog):
            return written
        proj = json.dumps(written) if isinstance(written, str) and written != "same" else '"EPSG:25833"'
        raise ValueError(f"expected keys and values such as `frame: {{proj: {proj}}}`, found {quote_value(written)}")

    @model_validator(mode="after")
    def _read(self) -> Self:
        try:
            proj, own_m = (self.proj, (0.0, 0.0)) if isinstance(self.proj, str) else self.proj.read()
            offset_m = (self.offset_m[0] + own_m[0], self.offset_m[1] + own_m[1])
            self._frame, notes = make_frame(proj, offset_m, math.radians(self.yaw_deg))
        except InputError as error:
            raise error_at_key("proj", str(error)) from None
        self._notes = tuple(notes)
        return self

    @property
    def frame(self) -> Frame:
        """The frame that is written."""
        assert self._frame is not None
        return self._frame

    @property
    def notes(self) -> tuple[str, ...]:
        """What of its text was left out."""
        return self._notes


def write_frame(frame: Frame) -> FrameOfLog:
    """A frame in the form of the experiment file."""
    return FrameOfLog(proj=frame.proj, offset_m=frame.offset_m, yaw_deg=math.degrees(frame.yaw_rad))


_APART_M: Final = 1.0


def find_frame(
    frame_key: FrameOfLog | None, maps: Sequence[MapFile], recording: Recording
) -> tuple[Frame | None, str, list[str]]:
    """The frame of a recording; why there is none; notes. The experiment comes first, then the recording, then maps.

    Raises InputError where the one that is to be taken cannot be.
    """
    middle_m, notes = find_middle(recording), list[str]()
    claims: dict[str, tuple[Frame, list[str]]] = {}
    why = "the recording does not say where it is"
    if frame_key is not None:
        claims["frame"] = frame_key.frame, [f"frame: {note}" for note in frame_key.notes]
    if recording.place_said is not None:
        try:
            claims["the recording"] = recording.place_said.read()
        except InputError as error:
            why = str(error)
            notes += [f"place: {why}"] if not claims else []
    for map_file in maps:
        site = map_file.read_once()
        if map_file.frame == "same" and site.proj:
            try:
                frame, of_map = SaidPlace(site.proj, site.offset_m, site.yaw_rad).read()
            except InputError:
                continue  # as for a log, the projection of a map is taken only where it can be
            back_m = (-map_file.offset_m[0], -map_file.offset_m[1])
            offset_m = frame.project(back_m)[0]
            claims[map_file.file] = Frame(frame.proj, (float(offset_m[0]), float(offset_m[1])), frame.yaw_rad), of_map
    if not claims:
        return None, why, notes
    (first, (frame, of_first)), *other_claims = claims.items()
    notes += of_first
    notes += check_scale(frame, middle_m)
    middle = frame.to_wgs84(middle_m)[0]
    for name, (other, _) in other_claims:
        apart_m = distance_on_earth_m(middle, other.to_wgs84(middle_m)[0])
        if not apart_m <= _APART_M:
            notes.append(
                f"place: {name} puts the middle of the log {apart_m:,.0f} m from where {first} does, which is taken"
            )
    return frame, "", notes
