"""Frames of logs: projections against Krüger's series, words of other tools, headings, and what is refused."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from copem_replay.core.errors import InputError
from copem_replay.core.frame import (
    Frame,
    SaidPlace,
    check_scale,
    distance_on_earth_m,
    make_frame,
    make_local_proj,
    read_argoverse2_city,
    read_mgrs,
    write_degrees,
)
from tests.oracles import krueger

LAT, ZONE = st.floats(-80, 84), st.integers(1, 60)


@given(LAT, ZONE, st.floats(-3.5, 3.5))
def test_utm_is_kruegers_series_in_every_zone_of_both_hemispheres(lat: float, zone: int, east_deg: float) -> None:
    meridian = 6 * zone - 183
    south = " +south" if lat < 0 else ""
    frame, notes = make_frame(f"+proj=utm +zone={zone}{south} +datum=WGS84")
    east_m, north_m = krueger.project(lat, meridian + east_deg, meridian)
    expected = (500_000 + east_m, north_m + (10_000_000 if lat < 0 else 0))
    lon = (meridian + east_deg + 180) % 360 - 180
    assert frame.from_wgs84([lat, lon])[0] == pytest.approx(expected, abs=1e-6)
    assert notes == []


@given(
    LAT, st.floats(-180, 180), st.floats(-10, 10), st.tuples(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6)),
    st.tuples(st.floats(-3000, 3000), st.floats(-3000, 3000)),
)  # fmt: skip
def test_there_and_back(
    lat: float, lon: float, yaw: float, offset: tuple[float, float], at: tuple[float, float]
) -> None:
    local = Frame(make_local_proj(lat, lon))
    frame, _ = make_frame(local.proj, offset, yaw)
    # a place of the log within 3 km of the projection's origin, wherever the offset has put the log's own origin
    place_m = frame.unproject(np.array([at]))
    assert frame.from_wgs84(frame.to_wgs84(place_m)) == pytest.approx(place_m, abs=1e-6)


def test_turned_then_moved() -> None:
    """By hand: (10, 0) turned by 90° is (0, 10), moved by (5, 7) it is (5, 17)."""
    frame = Frame("EPSG:32632", (5.0, 7.0), math.pi / 2)
    assert frame.project([10.0, 0.0])[0] == pytest.approx([5, 17])
    assert frame.unproject(np.array([[5.0, 17.0]]))[0] == pytest.approx([10, 0])


@pytest.mark.parametrize(("zone", "sign"), [(32, 1), (33, -1)])
def test_grid_north_is_not_true_north(zone: int, sign: int) -> None:
    """Between two zones at 12° E each grid is turned by 2.2°: where a line due east runs is measured on places."""
    frame, _ = make_frame(f"EPSG:326{zone}")
    lat, lon = 48.0, 12.0
    start, east = frame.from_wgs84([[lat, lon], [lat, lon + 1e-4]])
    measured = math.degrees(math.atan2(*(east - start)[::-1]))
    assert frame.yaw_of_heading(90.0, lat, lon) == pytest.approx(measured, abs=1e-4)
    by_hand = math.degrees(math.atan(math.tan(math.radians(3)) * math.sin(math.radians(lat))))  # on a sphere
    assert measured == pytest.approx(sign * by_hand, abs=1e-2)
    assert frame.heading_of_yaw(measured, lat, lon) == pytest.approx(90.0, abs=1e-4)


@given(st.floats(-4, 4), st.floats(0, 359.9))
def test_heading_of_yaw_undoes_yaw_of_heading(yaw: float, heading: float) -> None:
    frame = Frame("EPSG:25832", (1.0, 2.0), yaw)
    back = frame.heading_of_yaw(frame.yaw_of_heading(heading, 50.0, 7.0), 50.0, 7.0)
    assert math.cos(math.radians(back - heading)) == pytest.approx(1)


def test_a_city_of_argoverse_2() -> None:
    """Places that av2's own tests have (tests/unit/test_utm.py), and the origin that its documentation prints."""
    frame = Frame(*read_argoverse2_city("WDC"))
    places = frame.to_wgs84([[1716.85, 4470.38], [2139.70, 4606.14]])
    known = [[38.9299801515994, -77.0168603173312], [38.931286945069985, -77.0120195048271]]
    assert places == pytest.approx(np.array(known), abs=1e-7)
    assert read_argoverse2_city("PIT")[1] == pytest.approx((583710, 4477260), abs=0.01)


def test_a_square_of_mgrs() -> None:
    """Autoware's Kashiwanoha map: local places are those of UTM 54 less (300000, 3900000)."""
    assert read_mgrs("54SUE") == ("+proj=utm +zone=54 +datum=WGS84 +units=m", (300_000.0, 3_900_000.0))
    assert read_mgrs("32upu")[1] == (600_000.0, 5_300_000.0)  # Munich
    assert read_mgrs("56HLH") == ("+proj=utm +zone=56 +south +datum=WGS84 +units=m", (300_000.0, 6_200_000.0))  # Sydney


@given(st.floats(-79.9, -0.01) | st.floats(0, 83.9), ZONE, st.floats(-2.9, 2.9))
def test_every_place_is_in_a_square_of_its_own_zone(lat: float, zone: int, east_deg: float) -> None:
    """Letters counted plainly: columns by zone, 20 rows by zone, bands of 8° from 80° S."""
    south = " +south" if lat < 0 else ""
    east_m, north_m = Frame(f"+proj=utm +zone={zone}{south}").from_wgs84([lat, 6 * zone - 183 + east_deg])[0]
    band = "CDEFGHJKLMNPQRSTUVWXX"[int((lat + 80) // 8)]
    column = "ABCDEFGHJKLMNPQRSTUVWXYZ"[(zone - 1) % 3 * 8 + int(east_m // 100_000) - 1]
    row = "ABCDEFGHJKLMNPQRSTUV"[(int(north_m // 100_000) + (0 if zone % 2 else 5)) % 20]
    proj, offset_m = read_mgrs(f"{zone}{band}{column}{row}")
    assert offset_m == (east_m // 100_000 * 100_000, north_m // 100_000 * 100_000)
    assert ("+south" in proj) == (lat < 0)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("+proj=utm +lat_0=37.354293 +lon_0=-122.085980",
         "names no zone of UTM: expected `+zone=…`; if 37.354293, -122.085980 is the origin, "
         "`proj: {at_wgs84: [37.354293, -122.085980]}`"),
        ("+lat_0=49 +lon_0=8", "names no projection: expected `+proj=…`; if 49, 8 is the origin"),
        ("+proj=utm +zone=32 +x_0=0",
         "UTM has its own x_0 and y_0, and others are not heard: expected them as `offset_m`"),
        ("+proj=tmerc +lat_0=48 +axis=wsu", "expected metres east and north, found `+axis=wsu`"),
        ("EPSG:4326", "expected a projection to metres east and north, found degrees (WGS 84)"),
        ("EPSG:4978", "expected a projection to metres east and north, found no projection (WGS 84)"),
        ("EPSG:2272", "found US survey foot"),
        ("EPSG:2053", "found an axis to the west"),
        ("EPSG:99999", "is no projection that PROJ knows, such as EPSG:25832"),
        ("Munich", "is no projection that PROJ knows"),
    ],
)  # fmt: skip
def test_refused_projections(text: str, line: str) -> None:
    with pytest.raises(InputError) as refused:
        make_frame(text)
    (found,) = refused.value.problems
    assert line in found


def test_what_is_left_out_is_said() -> None:
    frame, (note,) = make_frame('EPSG:25832;<offset x="3" y="4"/>')
    assert (frame.proj, frame.offset_m) == ("EPSG:25832", (0.0, 0.0))
    assert note == "`<offset …>` behind the projection is left out: whoever writes it has added it to all places"
    frame, (note,) = make_frame("+proj=tmerc +lat_0=48 +lon_0=11 +nadgrids=a.gsb +geoidgrids=b.gtx")
    assert frame.proj == "+proj=tmerc +lat_0=48 +lon_0=11"
    assert note == "+nadgrids=a.gsb +geoidgrids=b.gtx left out: no grid of a datum is used"


def test_web_mercator_is_no_metric_projection() -> None:
    frame, _ = make_frame("EPSG:3857")
    with pytest.raises(InputError, match=r"expected a metric projection, found one that is 1\.49 times as large there"):
        list(check_scale(frame, frame.from_wgs84([48.0, 11.0])[0]))
    far, _ = make_frame("EPSG:32631")  # two zones away
    (note,) = check_scale(far, far.from_wgs84([10.0, 9.0])[0])
    assert note == "EPSG:32631: a metre there is 1.0050 m of the projection; distances are not corrected"
    near, _ = make_frame("EPSG:25832")
    assert [*check_scale(near, near.from_wgs84([48.0, 11.0])[0])] == []
    with pytest.raises(InputError, match="nowhere on earth: is it `offset_m`"):
        list(check_scale(Frame("EPSG:25832", (1e9, 1e9)), np.zeros(2)))


def test_a_place_that_changes_or_is_turned() -> None:
    with pytest.raises(InputError, match="expected one of all messages"):
        SaidPlace("EPSG:25832", changed="it changes: expected one of all messages").read()
    _, (note,) = SaidPlace("EPSG:25832", (300.0, 400.0), math.pi / 2).read()  # (300, 400) turned is (-400, 300)
    assert note == "turned first, then moved; read the other way round it is 707 m elsewhere"


def test_between_frames() -> None:
    """Two logs of one projection differ by an offset; of two projections by what both say of places."""
    one, two, third = Frame("EPSG:32632", (10.0, 0.0)), Frame("EPSG:32632", (4.0, 1.0)), Frame("EPSG:32633")
    assert one.take(two, [0.0, 0.0])[0].tolist() == [-6.0, 1.0]
    at_m = third.from_wgs84([48.0, 12.0])
    assert one.take(third, at_m) == pytest.approx(one.from_wgs84([48.0, 12.0]), abs=1e-6)


def test_words() -> None:
    assert write_degrees(48.1371234, 11.5753412) == "48.13712 N 11.57534 E"
    assert write_degrees(-33.9, -70.5) == "33.90000 S 70.50000 W"
    # a quarter of a meridian, on the sphere
    assert distance_on_earth_m([0, 0], [90, 0]) == pytest.approx(math.pi / 2 * 6_371_000)


def test_nothing_is_loaded_and_no_network_asked_without_a_place() -> None:
    code = (
        "import sys, copem_replay as cr; cr.inspect_recording('logs/tc016d.mcap'); assert 'pyproj' not in sys.modules;"
        "from copem_replay.core.frame import make_frame; make_frame('EPSG:25832');"
        "import pyproj.network; assert not pyproj.network.is_network_enabled()"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_without_pyproj(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyproj", None)
    with pytest.raises(InputError, match=r"places on earth need pyproj: `pip install 'copem-replay\[maps\]'`"):
        make_frame("EPSG:31468")
