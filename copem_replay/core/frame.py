"""The frame of a log on earth: how its metres become projected metres, and these latitude and longitude.

`p_projected = R(yaw) · p_log + offset`, as OSI's `proj_frame_offset` and OpenDRIVE's `<offset>` (1.8, clause 8.5) have
it; then the projection. Nothing is guessed, no sign is flipped, no grid is used and nothing is fetched. `pyproj` is
loaded where a place is asked for, never before.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.errors import InputError

if TYPE_CHECKING:
    from pyproj import CRS, Transformer


Places = NDArray[np.float64]
"""Places (N, 2): metres x and y, or degrees latitude and longitude."""
_EARTH_RADIUS_M: Final = 6_371_000.0


@dataclass(frozen=True)
class Frame:
    """The frame of a log's metres: `proj` is a text that PROJ reads, such as EPSG:25832, checked by `make_frame`."""

    proj: str
    offset_m: tuple[float, float] = (0.0, 0.0)
    yaw_rad: float = 0.0

    def to_wgs84(self, points_m: Any) -> Places:
        """Latitude and longitude in degrees (N, 2) of places of the log (N, 2) in metres."""
        east, north = self.project(points_m).T
        lon, lat = _transformer(self.proj).transform(east, north, direction="INVERSE")
        return np.column_stack([lat, lon])

    def from_wgs84(self, points: Any) -> Places:
        """Metres of the log (N, 2) of places (N, 2): latitude, longitude in degrees.

        Raises InputError where the projection does not reach a place.
        """
        lat, lon = np.asarray(points, dtype=np.float64).reshape(-1, 2).T
        projected_m = np.column_stack(_transformer(self.proj).transform(lon, lat))
        if len(beyond := np.flatnonzero(~np.isfinite(projected_m).all(axis=1))):
            where = write_degrees(lat[beyond[0]], lon[beyond[0]])
            raise InputError(f"{self.proj}: expected a place that this projection has, found {where}")
        return self.unproject(projected_m)

    def project(self, points_m: Any) -> Places:
        """Projected metres (N, 2), east and north, of places of the log (N, 2)."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        x, y = np.asarray(points_m, dtype=np.float64).reshape(-1, 2).T
        return np.column_stack([c * x - s * y + self.offset_m[0], s * x + c * y + self.offset_m[1]])

    def unproject(self, projected_m: Places) -> Places:
        """Places of the log (N, 2) of projected metres (N, 2)."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        x, y = (projected_m - np.array(self.offset_m)).T
        return np.column_stack([c * x + s * y, c * y - s * x])

    def take(self, other: Frame, points_m: Any) -> Places:
        """Places of this log (N, 2) from places of another frame (N, 2); of one projection without rounding of PROJ.

        Raises InputError where one of them does not reach a place.
        """
        if other.proj == self.proj:
            return self.unproject(other.project(points_m))
        degrees = other.to_wgs84(points_m)
        if len(beyond := np.flatnonzero(~np.isfinite(degrees).all(axis=1))):
            x_m, y_m = other.project(points_m)[beyond[0]]
            found = f"{x_m:,.0f} m east, {y_m:,.0f} m north"
            raise InputError(f"{other.proj}: expected places on earth, found {found}: is it the right offset?")
        return self.from_wgs84(degrees)

    def yaw_of_heading(self, heading_deg: float, lat: float, lon: float) -> float:
        """Yaw in the log, degrees from its x axis to the left, of a heading clockwise from true north at a place."""
        return 90.0 - heading_deg + self.convergence_deg(lat, lon) - math.degrees(self.yaw_rad)

    def heading_of_yaw(self, yaw_deg: float, lat: float, lon: float) -> float:
        """Heading, degrees clockwise from true north in [0, 360), of a yaw in the log at a place."""
        return (90.0 - yaw_deg + self.convergence_deg(lat, lon) - math.degrees(self.yaw_rad)) % 360.0

    def convergence_deg(self, lat: float, lon: float) -> float:
        """How far grid north is turned clockwise from true north: positive east of the meridian in the north."""
        return float(_factors(self.proj, lon, lat).meridian_convergence)

    def scale(self, lat: float, lon: float) -> float:
        """Projected metres for each metre on the ground."""
        return float(_factors(self.proj, lon, lat).meridional_scale)


def write_degrees(lat: float, lon: float) -> str:
    """A place in words, always latitude first: `48.13712 N 11.57534 E`."""
    return f"{abs(lat):.5f} {'N' if lat >= 0 else 'S'} {abs(lon):.5f} {'E' if lon >= 0 else 'W'}"


def distance_on_earth_m(place: Any, other: Any) -> float:
    """Metres between two places, latitude and longitude in degrees, on a sphere: to tell near from far."""
    (lat, lon), (lat2, lon2) = np.deg2rad(place), np.deg2rad(other)
    half = math.sin((lat2 - lat) / 2) ** 2 + math.cos(lat) * math.cos(lat2) * math.sin((lon2 - lon) / 2) ** 2
    return 2 * _EARTH_RADIUS_M * math.asin(math.sqrt(min(half, 1.0)))


# What others write, read without guessing.

_OFFSET_ELEMENT: Final = re.compile(r";\s*<offset\b[^>]*>")
_GRIDS: Final = ("nadgrids", "geoidgrids")


def make_frame(proj: str, offset_m: tuple[float, float] = (0.0, 0.0), yaw_rad: float = 0.0) -> tuple[Frame, list[str]]:
    """A frame, and notes on what of its text was left out. Raises InputError: no projection to metres east and north.

    `proj`: whatever PROJ takes, such as `EPSG:25832`, `+proj=utm +zone=32 +datum=WGS84`, or WKT.
    """
    notes = list[str]()
    text = proj.strip()
    if (element := _OFFSET_ELEMENT.search(text)) is not None:
        text = text[: element.start()].strip()
        notes.append("`<offset …>` behind the projection is left out: whoever writes it has added it to all places")
    if text.startswith("+") or " +" in text or "+lat_0" in text:
        text, of_words = _check_words(text)
        notes += of_words
    _check_crs(text)
    if not all(math.isfinite(value) and abs(value) < 1e9 for value in (*offset_m, yaw_rad)):
        raise InputError(f"expected an offset in metres, found {offset_m}, turned by {yaw_rad}")
    return Frame(text, offset_m, yaw_rad), notes


class SaidPlace(NamedTuple):
    """The place that a recording or a map states. `changed`: how it changes within a recording, "": it does not."""

    proj: str
    offset_m: tuple[float, float] = (0.0, 0.0)
    yaw_rad: float = 0.0
    changed: str = ""

    def read(self) -> tuple[Frame, list[str]]:
        """The frame, and notes on it. Raises InputError where it cannot be taken."""
        if self.changed:
            raise InputError(self.changed)
        frame, notes = make_frame(self.proj, self.offset_m, self.yaw_rad)
        if self.yaw_rad and any(self.offset_m):  # standards say so, and some writers do it the other way round
            apart_m = math.dist(Frame(self.proj, yaw_rad=self.yaw_rad).project(self.offset_m)[0], self.offset_m)
            notes.append(f"turned first, then moved; read the other way round it is {apart_m:,.0f} m elsewhere")
        return frame, notes


def _check_words(text: str) -> tuple[str, list[str]]:
    """A text of `+key=value` without grids, and a note on them. Raises InputError where PROJ would guess."""
    words = dict(word.lstrip("+").partition("=")[::2] for word in text.split())
    lat, lon = words.get("lat_0"), words.get("lon_0")
    origin = f"; if {lat}, {lon} is the origin, `proj: {{at_wgs84: [{lat}, {lon}]}}`" if lat and lon else ""
    if words.get("proj") == "utm" and "zone" not in words:
        raise InputError(f"{text!r} names no zone of UTM: expected `+zone=…`{origin}")
    if "proj" not in words and "init" not in words:
        raise InputError(f"{text!r} names no projection: expected `+proj=…`{origin}")
    if words.get("proj") == "utm" and {"x_0", "y_0"} & words.keys():
        raise InputError(
            f"{text!r}: UTM has its own x_0 and y_0, and others are not heard: expected them as `offset_m`"
        )
    if "axis" in words:
        raise InputError(f"{text!r}: expected metres east and north, found `+axis={words['axis']}`")
    grids = [word for word in text.split() if word.lstrip("+").partition("=")[0] in _GRIDS]
    notes = [f"{' '.join(grids)} left out: no grid of a datum is used"] if grids else []
    return " ".join(word for word in text.split() if word not in grids), notes


def _check_crs(text: str) -> None:
    """Raises InputError where a projection does not give metres east and north."""
    crs = _crs(text)
    fault = ""
    if crs.is_geographic or crs.is_geocentric or not crs.is_projected:
        fault = f"{'degrees' if crs.is_geographic else 'no projection'} ({crs.name})"
    elif odd := [axis for axis in crs.axis_info if axis.unit_conversion_factor != 1.0]:
        fault = f"{odd[0].unit_name} ({crs.name})"
    elif odd := [axis for axis in crs.axis_info if axis.direction.lower() not in ("east", "north", "up")]:
        fault = f"an axis to the {odd[0].direction} ({crs.name})"
    if fault:
        raise InputError(f"{text!r}: expected a projection to metres east and north, found {fault}")


def check_scale(frame: Frame, middle_m: Places) -> Iterator[str]:
    """A note where a projected metre differs from one on the ground. Raises InputError where it differs much."""
    lat, lon = frame.to_wgs84(middle_m)[0]
    if not (math.isfinite(lat) and math.isfinite(lon)):
        raise InputError(f"{frame.proj}: the log's places, with the offset, are nowhere on earth: is it `offset_m`?")
    scale = frame.scale(lat, lon)
    if not abs(scale - 1.0) <= 0.01:
        raise InputError(
            f"{frame.proj}: expected a metric projection, found one that is {scale:.2f} times as large there"
        )
    if abs(scale - 1.0) > 0.001:
        yield f"{frame.proj}: a metre there is {scale:.4f} m of the projection; distances are not corrected"


def _pyproj() -> Any:
    try:
        import pyproj
        from pyproj.network import set_network_enabled  # type: ignore[attr-defined]
    except ImportError:
        raise InputError("places on earth need pyproj: `pip install 'copem-replay[maps]'`") from None
    set_network_enabled(False)
    return pyproj


@lru_cache(maxsize=64)
def _crs(text: str) -> CRS:
    pyproj = _pyproj()
    try:
        crs: CRS = pyproj.CRS.from_user_input(text)
    except pyproj.exceptions.CRSError as error:
        why = str(error).rstrip(")").rpartition(": ")[2]
        raise InputError(f"{text!r} is no projection that PROJ knows, such as EPSG:25832: {why}") from None
    return crs


@lru_cache(maxsize=64)
def _transformer(text: str) -> Transformer:
    """From longitude and latitude in degrees to metres east and north."""
    crs, pyproj = _crs(text), _pyproj()
    transformer: Transformer = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    return transformer


def _factors(text: str, lon: float, lat: float) -> Any:
    return _projection(text).get_factors(lon, lat)


@lru_cache(maxsize=64)
def _projection(text: str) -> Any:
    return _pyproj().Proj(_crs(text))


# Words of the field for projections.


def make_local_proj(lat: float, lon: float) -> str:
    """A transverse Mercator projection with origin at a place, scale 1: metres east and north of it."""
    return f"+proj=tmerc +lat_0={lat!r} +lon_0={lon!r} +k=1 +datum=WGS84 +units=m"


_COLUMNS: Final = ("ABCDEFGH", "JKLMNPQR", "STUVWXYZ")
_ROWS: Final = "ABCDEFGHJKLMNPQRSTUV"
_BANDS: Final = "CDEFGHJKLMNPQRSTUVWX"
_SQUARE_M: Final = 100_000.0


def read_mgrs(square: str) -> tuple[str, tuple[float, float]]:
    """Projection and offset of a 100-km square of MGRS, `54SUE`: metres are counted from its south-west corner.

    Raises InputError where there is no such square. Source: NGA.STND.0037, appendix B.
    """
    match = re.fullmatch(r"(\d{1,2})([C-HJ-NP-X])([A-HJ-NP-Z])([A-HJ-NP-V])", square.upper())
    if match is None or not 1 <= int(match[1]) <= 60:
        raise InputError(f"expected a square of MGRS such as 54SUE, found {square!r}")
    zone, band = int(match[1]), _BANDS.index(match[2])
    column = _COLUMNS[(zone - 1) % 3].find(match[3])
    if column < 0:
        raise InputError(
            f"expected a square of MGRS, found {square!r}: zone {zone} has columns {_COLUMNS[(zone - 1) % 3]}"
        )
    row_m = (_ROWS.index(match[4]) - (0 if zone % 2 else 5)) % 20 * _SQUARE_M
    south_deg = -80 + 8 * band
    proj = f"+proj=utm +zone={zone}{' +south' * (south_deg < 0)} +datum=WGS84 +units=m"
    north_deg = min(south_deg + (12 if match[2] == "X" else 8), 84)
    meridian = 6 * zone - 183
    low_m, high_m = (Frame(proj).from_wgs84([lat, meridian])[0, 1] for lat in (south_deg, north_deg))
    rows = [row_m + k * 2_000_000.0 for k in range(6)]
    north_m = next((at_m for at_m in rows if low_m - 1.5 * _SQUARE_M < at_m < high_m + _SQUARE_M / 2), None)
    if north_m is None:
        raise InputError(
            f"expected a square of MGRS, found {square!r}: band {match[2]} has no row {match[4]} in that zone"
        )
    return proj, ((column + 1) * _SQUARE_M, north_m)


_CITIES: Final = {
    "ATX": (14, 30.27464237939507, -97.7404457407424),
    "DTW": (17, 42.29993066912924, -83.17555750783717),
    "MIA": (17, 25.77452579915163, -80.19656914449405),
    "PAO": (10, 37.416065, -122.13571963362166),
    "PIT": (17, 40.44177902989321, -80.01294377242584),
    "WDC": (18, 38.889377, -77.0355047439081),
}
"""Cities of Argoverse 2: zone of UTM, latitude and longitude of the origin, as av2's `geometry/utm.py` has them."""


def read_argoverse2_city(city: str) -> tuple[str, tuple[float, float]]:
    """Projection and offset of the frame of a city of Argoverse 2. Raises InputError where there is no such city."""
    if city not in _CITIES:
        raise InputError(f"expected a city of Argoverse 2 ({', '.join(_CITIES)}), found {city!r}")
    zone, lat, lon = _CITIES[city]
    proj = f"+proj=utm +zone={zone} +datum=WGS84 +units=m"
    east_m, north_m = Frame(proj).from_wgs84([lat, lon])[0]
    return proj, (float(east_m), float(north_m))
