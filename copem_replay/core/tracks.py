"""Tracks and Scene: the types that all wings exchange. Read this first.

A log is a bag of tracks. `Tracks` is ragged: its rows are the entries of a sparse matrix tracks × frames,
stored track by track. A *track* is one object as one unit has it, a *frame* is one list of one unit, a *row*
is one object in one list. The runs of a Monte Carlo are the leading axis of the values.

Letters of the shapes, here and everywhere: E tracks, P rows, F frames (lists), S runs, N objects, U units.
Values are `(S, P)`, or `(1, P)` where all runs agree.

Frame of reference: the log's world frame, east (x), north (y), up (z), metres; yaw in radians counter-clockwise
from east; positions are centres of boxes. Times: integer nanoseconds of the log's clock (`stamp_ns`), or float
seconds since the log's start `Scene.t0_ns`. Three times, three words: *captured* (the instant whose state a
list shows), *arrives* (when the receiver has it), *now*.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pandas as pd
    import shapely

    from copem_replay.core.frame import Frame

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]

CLASSES = (
    "pedestrian",
    "bicycle",
    "motorcycle",
    "car",
    "van",
    "truck",
    "bus",
    "trailer",
    "animal",
    "other",
    "vehicle",
)
"""What an object can be; `vehicle`: a vehicle, not said which."""

CLASS_GROUPS = {
    "vru": ("pedestrian", "bicycle", "motorcycle"),
    "vehicles": ("motorcycle", "car", "van", "truck", "bus", "trailer", "vehicle"),
}
"""Names that stand for several classes (`vru`: vulnerable road users)."""


def _build_agreement() -> Bool:
    agree = np.eye(len(CLASSES), dtype=np.bool_)
    other, vehicle = CLASSES.index("other"), CLASSES.index("vehicle")
    agree[other] = agree[:, other] = True
    for name in CLASS_GROUPS["vehicles"]:
        agree[vehicle, CLASSES.index(name)] = agree[CLASSES.index(name), vehicle] = True
    return agree


AGREE: Bool = _build_agreement()
"""(C, C) by indices into CLASSES: the classes are equal, or one is `other`, which says nothing, or one is `vehicle`
(not said which) and the other one of the vehicles. Symmetric, not transitive: a car and a bicycle both agree with
`other`."""

NO_CAPTURE_NS = np.iinfo(np.int64).min
"""Stamp of a fused list at an instant at which no list is recent enough."""

SAME_INSTANT_NS = 1_000
"""Two instants no farther apart than this are one: 1 µs, far below any interval of lists, far above rounding of
stamps."""
SAME_INSTANT_S = SAME_INSTANT_NS * 1e-9  # as stamps become seconds: a difference of 1 µs is one instant
"""`SAME_INSTANT_NS` in seconds."""

TRUTH = "truth"
"""Name of the unit that is no unit: the world as recorded."""


def class_indices(names: tuple[str, ...]) -> NDArray[np.int8]:
    """Indices into `CLASSES` of class and group names, sorted, each once: (K,)."""
    members = {m for name in names for m in CLASS_GROUPS.get(name, (name,))}
    return np.array(sorted(CLASSES.index(m) for m in members), dtype=np.int8)


FROM_MAP: Final = "maps["
"""How the names of solids of maps begin."""


class Solid(NamedTuple):
    """An upright prism that hides what is behind it, for the whole of a log. It is no object: no unit lists it."""

    name: str  # as notes say it
    corners_m: tuple[tuple[float, float], ...]  # K places around a simple polygon
    bottom_m: float  # above z = 0
    height_m: float
    on_ground: bool = False  # its bottom is the ground, as far as that is known
    holes_m: tuple[tuple[tuple[float, float], ...], ...] = ()  # courtyards: corners of each

    @property
    def top_m(self) -> float:
        """The height of the upper end above z = 0."""
        return self.bottom_m + self.height_m

    @property
    def outline(self) -> shapely.Polygon:
        """The polygon with its holes."""
        import shapely

        return shapely.Polygon(self.corners_m, self.holes_m)


def make_outlines(rings_m: Sequence[Sequence[Any]]) -> NDArray[np.object_]:
    """Polygons (N,) as shapely has them, of rings (K, 2) each, the outer first, made together: one by one is slow."""
    import shapely

    rings = [np.asarray(ring, dtype=np.float64) for of_one in rings_m for ring in of_one]
    corners = np.concatenate([*rings, np.empty((0, 2))])
    lines = shapely.linearrings(corners, indices=np.repeat(np.arange(len(rings)), [len(ring) for ring in rings]))
    outlines: NDArray[np.object_] = shapely.polygons(
        lines, indices=np.repeat(np.arange(len(rings_m)), [len(of_one) for of_one in rings_m])
    )
    return outlines


def outline_solids(solids: Sequence[Solid]) -> NDArray[np.object_]:
    """The `outline` of each solid."""
    return make_outlines([(solid.corners_m, *solid.holes_m) for solid in solids])


class Area(NamedTuple):
    """A part of the plane that has a name and a kind: the rings of its polygon, the outer first, then its holes."""

    name: str
    kind: str  # crosswalk, junction, drivable, parking
    rings_m: tuple[tuple[tuple[float, float], ...], ...]  # without the first corner again


@dataclass(frozen=True)
class Scene:
    """The constants of one log: its objects, their classes, its start and end, its ego, and what else hides them.

    `moving` is False for stationary objects (they hide others; they are measured only when named).
    `solids` are stationary objects with an outline of their own, and those of maps: they hide, and are no objects.
    `areas` are those of maps and of the recording, `lanes` those that `measure.objects.within` names.
    `frame`: where it is on earth, if that is known.
    `ego_ix` is −1 where the log has no ego vehicle, or none was chosen. `tags`: what the recording, or the experiment,
    says of the drive, by name.

    >>> scene = cr.read_recording("logs/tc016d.mcap").scene
    >>> scene.object_ids[scene.ego_ix], cr.CLASSES[scene.object_class[scene.ego_ix]], scene.end_s
    ('1', 'car', 8.0)
    """

    log: str
    t0_ns: int
    end_ns: int
    object_ids: tuple[str, ...]  # N
    object_class: NDArray[np.int8]  # (N,) index into CLASSES
    moving: Bool  # (N,)
    ego_ix: int = -1
    ego_sized: bool = True  # False: the size of the ego is not known, nor are gaps to it
    solids: tuple[Solid, ...] = ()
    tags: Mapping[str, str] = field(default_factory=dict)
    areas: tuple[Area, ...] = ()
    lanes: tuple[Area, ...] = ()
    frame: Frame | None = None

    @cached_property
    def object_number(self) -> dict[str, int]:
        """Index of each object id."""
        return {name: k for k, name in enumerate(self.object_ids)}

    @property
    def end_s(self) -> float:
        """The log's last instant, seconds since its start."""
        return (self.end_ns - self.t0_ns) * 1e-9


@dataclass(frozen=True, repr=False)
class Tracks:
    """Object states in the lists of units, over time and runs. Shapes are checked here and nowhere else.

    Rows of a track are in order of capture, `start[e]:start[e + 1]`; a track has at least one row. NaN may lie
    under `valid == False` and nowhere else. Covariances are None where states are exact.
    Raises ValueError when a shape is wrong: that is a defect of the caller, never of a recording.

    >>> scene, truth = (recording := cr.read_recording("logs/tc016d.mcap")).scene, recording.truth
    >>> of_ego = truth.row_object_ix == scene.ego_ix
    >>> truth.vx_mps[0, of_ego].mean().round(2)
    np.float64(10.0)
    """

    units: tuple[str, ...]  # U names; the truth has the one unit TRUTH
    start: Int  # (E + 1,)
    unit_ix: Int  # (E,)
    object_ix: Int  # (E,) index into Scene.object_ids
    frame_ix: Int  # (P,)
    stamp_ns: Int  # (F,) capture instants
    captured_s: Float  # (F,)
    frame_unit_ix: Int  # (F,)
    arrives_s: Float  # (S | 1, F); inf: never
    valid: Bool  # (S | 1, P)
    x_m: Float  # values, all (S | 1, P)
    y_m: Float
    z_m: Float
    yaw_rad: Float
    vx_mps: Float
    vy_mps: Float
    length_m: Float
    width_m: Float
    height_m: Float
    cov_ee_m2: Float | None = None  # position covariance, easting and northing
    cov_en_m2: Float | None = None
    cov_nn_m2: Float | None = None
    yaw_var_rad2: Float | None = None
    size_var_m2: Float | None = None  # of length, width and height alike
    speed_var_m2ps2: Float | None = None
    entry_age_s: Float | None = None  # how long before its list each row was captured, in lists that a unit has fused

    def __post_init__(self) -> None:
        E, P, F = len(self.unit_ix), len(self.frame_ix), len(self.stamp_ns)
        expected = {"start": (E + 1,), "object_ix": (E,), "captured_s": (F,), "frame_unit_ix": (F,)}
        for name, shape in expected.items():
            if (found := getattr(self, name).shape) != shape:
                raise ValueError(f"Tracks.{name}: expected shape {shape}, found {found}")
        if self.start[0] != 0 or self.start[-1] != P or (np.diff(self.start) < 1).any():
            raise ValueError("Tracks.start: expected 0 … P, strictly increasing (no empty tracks)")
        runs = {1}
        for name in ("arrives_s", "valid", *STATES):
            array = getattr(self, name)
            if array is None:
                continue
            columns = F if name == "arrives_s" else P
            if array.ndim != 2 or array.shape[1] != columns:
                raise ValueError(f"Tracks.{name}: expected (runs, {columns}), found {array.shape}")
            runs.add(array.shape[0])
        if len(runs) > 2:
            raise ValueError(f"Tracks: values disagree on the number of runs: {sorted(runs)}")

    def __repr__(self) -> str:
        shown = ", ".join(self.units) if len(self.units) <= 3 else f"{len(self.units)} units"
        rows, lists, runs = len(self.frame_ix), len(self.stamp_ns), max(len(self.valid), len(self.arrives_s))
        return f"Tracks({rows} states of {len(self.unit_ix)} tracks in {lists} lists of {shown}, runs: {runs})"

    def to_dataframe(self, scene: Scene | None = None) -> pd.DataFrame:
        """The states of one run, list by list: `captured_s`, `unit`, the object, and the state.

        The object is `object_ix`, with its `scene` also `object_id` and `object_class`. Raises ValueError for tracks of
        several runs.

        >>> recording = cr.read_recording("logs/tc016d.mcap")
        >>> recording.truth.to_dataframe(recording.scene)["object_id"].nunique() == len(recording.scene.object_ids)
        True
        """
        import pandas as pd

        if len(self.valid) != 1:
            raise ValueError(f"to_dataframe: expected the tracks of one run, found {len(self.valid)}")
        rows = self.by_frame[0][self.valid[0, self.by_frame[0]]]
        object_ix = self.row_object_ix[rows]
        columns: dict[str, object] = {
            "captured_s": self.captured_s[self.frame_ix[rows]],
            "unit": np.array(self.units, dtype=object)[self.row_unit_ix[rows]],
            "object_ix": object_ix,
        }
        if scene is not None:  # −1, of no object, is the last
            columns["object_id"] = np.array([*scene.object_ids, None], dtype=object)[object_ix]
            kinds = np.array([*np.array(CLASSES, dtype=object)[scene.object_class], None], dtype=object)
            columns["object_class"] = kinds[object_ix]
        stated = {name: getattr(self, name) for name in STATES}
        return pd.DataFrame(columns | {name: of[0, rows] for name, of in stated.items() if of is not None})

    @property
    def common_arrives_s(self) -> Float:
        """(F,) when each list arrives, in the one run there is, or in all alike. Raises ValueError where runs differ.

        Callers ask for one run at a time.
        """
        if len(self.arrives_s) != 1:
            raise ValueError(
                f"Tracks.arrives_s: expected arrivals that all runs share, found {len(self.arrives_s)} rows"
            )
        arrives_s: Float = self.arrives_s[0]
        return arrives_s

    @cached_property
    def track_ix(self) -> Int:
        """(P,) the track of each row."""
        return np.repeat(np.arange(len(self.unit_ix)), np.diff(self.start))

    @cached_property
    def row_object_ix(self) -> Int:
        """(P,) the object of each row."""
        return self.object_ix[self.track_ix]

    @cached_property
    def row_unit_ix(self) -> Int:
        """(P,) the unit of each row."""
        return self.unit_ix[self.track_ix]

    @cached_property
    def row_captured_s(self) -> Float:
        """(P,) when the list of each row was captured."""
        return self.captured_s[self.frame_ix]

    @cached_property
    def entry_captured_s(self) -> Float:
        """(P,) when each row was captured: with its list, but for lists of one run that a unit has fused."""
        return self.row_captured_s if self.entry_age_s is None else self.row_captured_s - self.entry_age_s[0]

    @cached_property
    def by_frame(self) -> tuple[Int, Int]:
        """The other order: rows list by list (P,), and where each list starts (F + 1,)."""
        order = np.argsort(self.frame_ix, kind="stable")
        bounds = np.searchsorted(self.frame_ix[order], np.arange(len(self.stamp_ns) + 1))
        return order, bounds

    @cached_property
    def by_object(self) -> tuple[Int, Int]:
        """Rows (P,) unit by unit, then object by object, those of no object first, then in order of capture.

        And where those of each unit and object begin, (U · (O + 1) + 1,), O the highest object index + 1.
        """
        objects = int(self.object_ix.max(initial=-1)) + 2
        key = self.row_unit_ix * objects + self.row_object_ix + 1
        order = np.lexsort((self.row_captured_s, key))
        return order, np.searchsorted(key[order], np.arange(len(self.units) * objects + 1))

    @cached_property
    def west_to_east(self) -> Int:
        """(P,) rows list by list, in each from west to east, and at one place the first object first; of one run."""
        return np.lexsort((self.row_object_ix, self.x_m[0], self.frame_ix))

    @cached_property
    def rows_after_miss(self) -> Int:
        """(K,) rows whose object is not in the list before theirs, but in an earlier one."""
        missed = np.diff(self.frame_ix) != 1
        missed[self.start[1:-1] - 1] = False
        return np.flatnonzero(missed) + 1

    def take_tracks(self, keep: Bool) -> Tracks:
        """Only the tracks in the mask `keep` (E,). Lists stay: one that loses all entries is an empty list."""
        return self if keep.all() else self.take_rows(np.flatnonzero(np.repeat(keep, np.diff(self.start))))

    def take_rows(self, rows: Int, *, states: bool = True) -> Tracks:
        """Only some rows, ascending (K,). Lists stay, tracks without rows do not.

        `states=False`: states are not needed and become 0, which takes no memory.
        """
        lengths = np.diff(np.searchsorted(rows, self.start))
        has_rows = lengths > 0
        columns: dict[str, Any] = {
            name: None if (a := getattr(self, name)) is None else a[:, rows]
            for name in ("valid", *(STATES if states else ()))
        }
        columns |= {} if states else _stateless(len(rows))
        return replace(
            self,
            start=np.concatenate([[0], np.cumsum(lengths[has_rows])]),
            unit_ix=self.unit_ix[has_rows],
            object_ix=self.object_ix[has_rows],
            frame_ix=self.frame_ix[rows],
            **columns,
        )

    def in_lists_of(self, other: Tracks) -> Tracks:
        """These rows in the lists of `other`, which are equal: so both share the memory."""
        return replace(
            self,
            stamp_ns=other.stamp_ns,
            captured_s=other.captured_s,
            frame_unit_ix=other.frame_unit_ix,
            arrives_s=other.arrives_s,
        )

    def captured_between(self, from_s: float, until_s: float) -> Tracks:
        """Only rows captured from an instant on and before another; of one unit, whose lists ascend in time."""
        first, after = np.searchsorted(self.captured_s, (from_s, until_s))
        if first == 0 and after == len(self.captured_s):
            return self
        return self.take_rows(self.rows_between(first, after))

    def rows_between(self, first: int, after: int) -> Int:
        """(K,) the rows of lists from one on and before another, ascending."""
        order, bounds = self.by_frame
        return np.sort(order[bounds[first] : bounds[after]])


def join_tracks(units: tuple[str, ...], pieces: Sequence[Tracks]) -> Tracks:
    """Tracks of several units as one; each piece has lists, and units, of its own. `units`: of all, in their order.

    Values of a piece that all runs share are repeated where another's differ; a variance, or an age, that only some
    have is 0 for the others.
    """
    empty = np.empty(0, dtype=np.int64)
    row_offset = np.concatenate([[0], np.cumsum([len(p.frame_ix) for p in pieces])]).astype(np.int64)
    frame_offset = np.concatenate([[0], np.cumsum([len(p.stamp_ns) for p in pieces])]).astype(np.int64)
    unit_offset = np.concatenate([[0], np.cumsum([len(p.units) for p in pieces])]).astype(np.int64)

    def shifted(name: str, offset: Int) -> Int:
        return np.concatenate([empty, *(getattr(p, name) + offset[k] for k, p in enumerate(pieces))])

    def rows(name: str) -> Any:
        columns = [getattr(p, name) for p in pieces]
        if name in _OPTIONAL:
            if all(column is None for column in columns):
                return None
            columns = [
                np.zeros((1, len(p.frame_ix))) if column is None else column
                for p, column in zip(pieces, columns, strict=True)
            ]
        runs = max((len(column) for column in columns), default=1)
        columns = [np.broadcast_to(column, (runs, column.shape[1])) for column in columns]
        return np.concatenate([np.empty((runs, 0), dtype=columns[0].dtype if columns else float), *columns], axis=1)

    return Tracks(
        units=units,
        start=np.concatenate([[0], *(p.start[1:] + row_offset[k] for k, p in enumerate(pieces))]),
        unit_ix=shifted("unit_ix", unit_offset),
        object_ix=np.concatenate([empty, *(p.object_ix for p in pieces)]),
        frame_ix=shifted("frame_ix", frame_offset),
        stamp_ns=np.concatenate([empty, *(p.stamp_ns for p in pieces)]),
        captured_s=np.concatenate([np.empty(0), *(p.captured_s for p in pieces)]),
        frame_unit_ix=shifted("frame_unit_ix", unit_offset),
        arrives_s=np.concatenate([np.empty((1, 0)), *(p.arrives_s for p in pieces)], axis=1),
        valid=rows("valid").astype(bool),
        **{name: rows(name) for name in STATES},
    )


def splice_rows(pieces: Sequence[Tracks], *, states: bool = True) -> tuple[Tracks, Int]:
    """Rows of pieces that share their lists, as one; and (P,) the place of each among the rows of piece after piece.

    `states=False`: states are not needed and become 0.
    """
    unit_ix, object_ix, frame_ix = (
        np.concatenate([getattr(piece, name) for piece in pieces])
        for name in ("row_unit_ix", "row_object_ix", "frame_ix")
    )
    order = np.lexsort((frame_ix, object_ix, unit_ix))
    unit_ix, object_ix = unit_ix[order], object_ix[order]
    new = np.flatnonzero((np.diff(unit_ix, prepend=-1) != 0) | (np.diff(object_ix, prepend=-1) != 0))

    columns: dict[str, Any] = {} if states else _stateless(len(order))
    for name in ("valid", *(STATES if states else ())):
        of_pieces = [getattr(piece, name) for piece in pieces]
        columns[name] = None if of_pieces[0] is None else np.concatenate(of_pieces, axis=1)[:, order]
    tracks = replace(
        pieces[0],
        start=np.append(new, len(order)),
        unit_ix=unit_ix[new],
        object_ix=object_ix[new],
        frame_ix=frame_ix[order],
        **columns,
    )
    return tracks, order


def _stateless(rows: int) -> dict[str, Any]:
    """The columns of states that are not needed."""
    return {name: None if name in _OPTIONAL else np.broadcast_to(0.0, (1, rows)) for name in STATES}


VALUES = ("x_m", "y_m", "z_m", "yaw_rad", "vx_mps", "vy_mps", "length_m", "width_m", "height_m")
_OPTIONAL = tuple(f.name for f in fields(Tracks) if f.default is None)
UNCERTAINTIES = _OPTIONAL[:-1]  # the last is `entry_age_s`
STATES = (*VALUES, *_OPTIONAL)
"""The columns of a state."""


def append_tracks(tracks: Tracks, others: Tracks) -> Tracks:
    """The tracks followed by `others`, both of one run and with the same lists.

    Variances that only one of them states are 0 in the other.
    """
    columns: dict[str, Any] = {}
    for name in ("valid", *STATES):
        stated = [getattr(part, name) for part in (tracks, others)]
        if all(column is None for column in stated):
            continue
        parts = zip((tracks, others), stated, strict=True)
        filled = [np.zeros((1, len(part.frame_ix))) if column is None else column for part, column in parts]
        columns[name] = np.concatenate(filled, axis=1)
    for name in ("unit_ix", "object_ix", "frame_ix"):
        columns[name] = np.concatenate([getattr(tracks, name), getattr(others, name)])
    return replace(tracks, start=np.concatenate([tracks.start, others.start[1:] + tracks.start[-1]]), **columns)


@dataclass(frozen=True)
class TimeChunk:
    """Instants from `from_s` on and before `until_s`, in seconds of the log; without bounds all of it."""

    from_s: float = -np.inf
    until_s: float = np.inf


@dataclass(frozen=True)
class UnitFaults:
    """Faults of units' lists in one run, for notes and display; no fusion knows of them.

    `ghosts (G,)`: rows of the lists that are about no object. `not_made (F,)`: lists that are missing in an outage.
    """

    ghosts: Int
    not_made: Bool
