"""Messages made of columns, many lists at once: byte by byte what the libraries make of one list after the other."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
import pytest
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from hypothesis import given, settings
from hypothesis import strategies as st

from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.object_list import ENTRY
from copem_replay.core.tracks import CLASSES, NO_CAPTURE_NS, UNCERTAINTIES, VALUES, Int, Scene, Tracks
from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.io.encodings import column_bytes as list_blocks
from copem_replay.io.encodings.cdr_bytes import encode_cdr
from copem_replay.io.encodings.column_bytes import encode_messages
from copem_replay.io.write.detail import DetailWriter, Statuses, StatusWriter
from copem_replay.io.write.osi import SensorDataWriter
from copem_replay.io.write.ros2 import ObjectsWriter
from copem_replay.io.write.scene import BoxWriter, Draw, UncertaintyWriter, draw_scenes, principal_axes
from tests.oracles import messages as plain

SCENE_UPDATE = "foxglove_msgs/msg/SceneUpdate"
T0_NS = 1_700_000_000_123_456_789
UNITS = 20
COLOUR = (255, 0, 77)
NUMBERS = {f"u{k}": 120 + k for k in range(UNITS)}
"""Some take one byte, some two."""
SCENE = Scene(
    log="drive", t0_ns=T0_NS, end_ns=T0_NS + 10**10,
    object_ids=("0", "7", "300", str(2**63), str(2**64 - 1), "stationary:5", "Müller's car", "18446744073709551616"),
    object_class=np.array([0, 1, 2, 3, 4, 5, 6, 7], dtype=np.int8) % len(CLASSES),
    moving=np.array([True, True, False, True, True, False, True, False]),  # of object −1, too, were it an index
)  # fmt: skip
COUNT = len(SCENE.object_ids)


def drawn(seed: int, lists: int, longest: int, said: bool, exact: bool) -> FusedTracks:
    """Fused lists; numbers are often 0, or −0."""
    rng = np.random.default_rng(seed)
    frame_ix = np.repeat(np.arange(lists), rng.integers(0, longest + 1, lists))
    P = len(frame_ix)
    frame_ix = rng.permutation(frame_ix)

    def numbers(count: int = P) -> np.ndarray:
        return rng.choice([0.0, -0.0, 1.0, 0.1, -3e-300, 12345.678901, float(rng.normal())], count)

    captures = 6
    units = np.arange(UNITS)
    received = Tracks(
        units=tuple(NUMBERS), start=np.arange(UNITS + 1) * captures, unit_ix=units, object_ix=units % COUNT,
        frame_ix=np.tile(np.arange(captures), UNITS), stamp_ns=T0_NS + np.arange(captures) * 10**8 - 10**8,
        captured_s=np.arange(captures) * 0.1 - 0.1, frame_unit_ix=np.zeros(captures, dtype=int),
        arrives_s=np.arange(captures)[None] * 0.1, valid=rng.random((1, UNITS * captures)) < 0.8,
        **{name: numbers(UNITS * captures)[None] for name in VALUES},
    )  # fmt: skip
    stamp_ns = np.where(rng.random(lists) < 0.2, NO_CAPTURE_NS, T0_NS + rng.integers(-1, 5, lists) * 10**8)
    spread = {} if exact else {name: np.abs(numbers())[None] for name in UNCERTAINTIES}
    if not exact and P:
        spread["yaw_var_rad2"][0, 0] = np.nan
    fused = Tracks(
        units=("fused",), start=np.arange(P + 1), unit_ix=np.zeros(P, dtype=int),
        object_ix=rng.integers(-1 if said else 0, COUNT, P), frame_ix=frame_ix, stamp_ns=stamp_ns,
        captured_s=np.zeros(lists), frame_unit_ix=np.zeros(lists, dtype=int), arrives_s=np.arange(lists)[None] * 0.1,
        valid=rng.random((1, P)) < 0.9, **{name: numbers()[None] for name in VALUES}, **spread,
    )  # fmt: skip
    start = np.zeros(P + 1, dtype=int) if said else np.concatenate([[0], np.cumsum(rng.choice([0, 1, UNITS], P))])
    entries = rng.integers(0, UNITS * captures, start[-1])
    claims = None
    if said:
        claims = np.zeros(P, dtype=ENTRY)
        claims["existence"] = rng.choice([0.0, -0.0, 0.5, 1.0], P)
        claims["class_probability"] = rng.choice([0.0, 0.25, 1.0], (P, len(CLASSES)), p=[0.8, 0.1, 0.1])
        claims["track_id"] = rng.choice([-1, 0, 127, 128, 2**63 - 1], P)
        claims["unit_ix"] = rng.choice([-1, 0, UNITS - 1], P)
        claims["captured_s"] = rng.choice([-0.1, 0.0, 0.1, 0.2], P)
        claims["captured_s"][claims["unit_ix"] < 0] = -np.inf
    many = np.abs(numbers(UNITS * captures))
    view = None if said or exact else ViewGeometry(*(many if k != 3 else many / 3 for k in range(_FIELDS)))
    stated_s = rng.choice([-0.05, 0.0, 0.2], P) if said and rng.random() < 0.5 else None
    return FusedTracks(fused, received, entries, start, view, claims, SCENE, stated_s=stated_s)


_FIELDS = len(ViewGeometry.__dataclass_fields__)
LISTS = st.builds(drawn, st.integers(0, 2**32), st.integers(1, 5), st.integers(0, 6), st.booleans(), st.booleans())


def available_of(fused_tracks: FusedTracks) -> Int:
    """Of the first list before the Unix epoch, of the second one at it."""
    lists = len(fused_tracks.fused.stamp_ns)
    return np.array([-1, 0, 10**9, T0_NS + 10**8, T0_NS + 2 * 10**8])[:lists]


def same(found: Iterable[bytes], fused_tracks: FusedTracks, expected: Callable[[int, int], bytes]) -> None:
    available_ns = available_of(fused_tracks).tolist()
    assert list(found) == [expected(frame, time_ns) for frame, time_ns in enumerate(available_ns)]


def same_scenes(
    made: Callable[[Draw], Iterable[bytes]],
    fused_tracks: FusedTracks,
    expected: Callable[[int, int], bytes],
    frame_id: str,
) -> None:
    """In protobuf the bytes of its library, in ROS 2 messages of the same content."""
    in_protobuf = list(made(partial(draw_scenes, partial(encode_messages, SceneUpdate.DESCRIPTOR), frame_id)))
    same(in_protobuf, fused_tracks, expected)
    in_ros2 = made(partial(draw_scenes, partial(encode_cdr, SCENE_UPDATE), frame_id))
    for one, other in zip(in_protobuf, in_ros2, strict=True):
        theirs = plain.content_of(plain.decode_ros2(SCENE_UPDATE, other), SceneUpdate.DESCRIPTOR)
        assert theirs == plain.content_of(SceneUpdate.FromString(one), SceneUpdate.DESCRIPTOR)


@pytest.fixture(params=[3, 20_000], autouse=True, scope="module")
def _block(request: pytest.FixtureRequest) -> Iterable[None]:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(list_blocks, "MOST_ROWS", request.param)
        yield


@given(LISTS)
@settings(deadline=None)
def test_sensor_data(fused_tracks: FusedTracks) -> None:
    writer = SensorDataWriter(SCENE, fused_tracks, NUMBERS)
    same(
        writer.messages(available_of(fused_tracks)),
        fused_tracks,
        lambda frame, time_ns: plain.sensor_data(SCENE, fused_tracks, NUMBERS, frame, time_ns),
    )


def test_entries_about_no_object_move_in_messages_of_ros() -> None:
    """Whatever the last object does, as whose index −1 could be read."""
    fused_tracks = drawn(3, 4, 6, True, False)
    fused_tracks = replace(
        fused_tracks, fused=replace(fused_tracks.fused, object_ix=np.full_like(fused_tracks.fused.object_ix, -1))
    )
    still, moves = (replace(SCENE, moving=np.append(SCENE.moving[:-1], last)) for last in (False, True))
    of_both = [ObjectsWriter(scene, fused_tracks, "map") for scene in (still, moves)]
    messages = [list(writer.messages(np.full(4, 10**9))) for writer in of_both]
    assert max(map(len, messages[0])) > 500
    assert messages[0] == messages[1]


@given(LISTS, st.sampled_from(["global", ""]))
@settings(deadline=None)
def test_scene_updates(fused_tracks: FusedTracks, frame_id: str) -> None:
    same_scenes(
        lambda draw: BoxWriter(SCENE, fused_tracks, "gnn", COLOUR, draw).messages(available_of(fused_tracks)),
        fused_tracks,
        lambda frame, time_ns: plain.scene_update(SCENE, fused_tracks, "gnn", COLOUR, frame_id, frame, time_ns),
        frame_id,
    )


@given(LISTS)
@settings(deadline=None)
def test_ellipses(fused_tracks: FusedTracks) -> None:
    fused = fused_tracks.fused
    none = np.zeros(len(fused.frame_ix))
    of = principal_axes(*(none if c is None else c[0] for c in (fused.cov_ee_m2, fused.cov_en_m2, fused.cov_nn_m2)))
    same_scenes(
        lambda draw: UncertaintyWriter(SCENE, fused_tracks, COLOUR, draw).messages(available_of(fused_tracks)),
        fused_tracks,
        lambda frame, time_ns: plain.ellipses(SCENE, fused_tracks, COLOUR, "map", of, frame, time_ns),
        "map",
    )


@given(LISTS, st.booleans())
@settings(deadline=None)
def test_details(fused_tracks: FusedTracks, sized: bool) -> None:
    events = {0: [{"object": "7", "first_unit": "ü", "onset_s": None, "captured_s": 0.1}]}
    sizes_of = (np.arange(len(fused_tracks.fused.frame_ix)) % 2 == 0) & sized
    writer = DetailWriter(SCENE, fused_tracks, events, sizes_of)
    same(
        writer.messages(available_of(fused_tracks)),
        fused_tracks,
        lambda frame, time_ns: plain.detail(SCENE, fused_tracks, events.get(frame, ()), sizes_of, frame, time_ns),
    )


@given(LISTS, st.integers(0, 3))
@settings(deadline=None)
def test_statuses(fused_tracks: FusedTracks, measured: int) -> None:
    detection_s = [0.1, np.nan, 0.2][:measured]
    rows = {
        "object_id": [SCENE.object_ids[k] for k in range(measured)],
        "detected": [t == t for t in detection_s],
        "detection_s": detection_s,
    }
    known_ns = {k: T0_NS + round(t * 1e9) if t == t else None for k, t in enumerate(detection_s)}
    writer = StatusWriter(Statuses(SCENE, fused_tracks, pd.DataFrame(rows)))
    same(
        writer.messages(available_of(fused_tracks)),
        fused_tracks,
        lambda frame, time_ns: plain.status(SCENE, fused_tracks, known_ns, frame, time_ns),
    )
