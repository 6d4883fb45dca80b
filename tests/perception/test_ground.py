"""The ground under places and obstacles: the state nearest to them, of all."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import shapely
from hypothesis import given
from hypothesis import strategies as st

from copem_replay.perception.observation import observe_objects
from copem_replay.perception.sensor_poses import find_ground, find_grounds, place_units
from tests.helpers.scenes import EGO_UNIT, Thing, experiment, recording

SQUARE = [[-4.0, -3.0], [6.0, -3.0], [6.0, 5.0], [-4.0, 5.0]]
BENT = [[0.0, 0.0], [30.0, 0.0], [30.0, 30.0], [28.0, 30.0], [28.0, 2.0], [0.0, 2.0]]


def states(places: np.ndarray) -> Any:
    """Objects of 2 m at these places, each on a ground of its own."""
    n = len(places)
    return SimpleNamespace(
        frame_ix=np.zeros(n, dtype=np.int64), x_m=places[None, :, 0], y_m=places[None, :, 1],
        z_m=np.arange(n, dtype=float)[None] + 1.0, height_m=np.full((1, n), 2.0),
    )  # fmt: skip


@given(
    st.lists(st.tuples(st.integers(-90, 90), st.integers(-90, 90)), min_size=1, max_size=60),
    st.sampled_from([[[0.0, 0.0]], [[3.5, -7.0]], SQUARE, BENT]),
    st.sampled_from([0.0, 0.1, 5e6]),
)
def test_it_is_that_of_the_nearest_of_all_the_first_of_equals(
    places: list[tuple[int, int]], corners: list[list[float]], shift_m: float
) -> None:
    at, given_ = np.array(places, dtype=float) + shift_m, np.array(corners) + shift_m
    place = shapely.Point(given_[0]) if len(given_) == 1 else shapely.Polygon(given_)
    distance = [place.distance(shapely.Point(one)) for one in at]
    assert find_ground(states(at), given_) == (float(np.argmin(distance)), min(distance))
    far = place.centroid.buffer(1e3)
    grounds_m, far_m = find_grounds(states(at), [place, far])
    assert (grounds_m[0], far_m[0]) == (float(np.argmin(distance)), min(distance))
    assert (grounds_m[1], far_m[1]) == (0.0, 0.0)  # all are inside


def test_no_states_ground_at_zero() -> None:
    assert find_ground(states(np.empty((0, 2))), np.array([[0.0, 0.0]])) == (0.0, np.inf)


HOUSE = ((57.0, 0.0), (67.0, 0.0), (67.0, 10.0))


def uphill(*objects: tuple[float, float]) -> Any:
    """The scene and the truth of an ego that stands at (0, 0), and others, in a street at z = 62 m."""
    things = [Thing("ego", "car", lambda t: (0.0, 0.0))]
    things += [Thing(f"o{k}", "pedestrian", lambda t, at=at: at) for k, at in enumerate(objects)]
    log = recording(things, until_s=1.0)
    return log.scene, replace(log.truth, z_m=log.truth.z_m + 62.0)


def test_what_is_far_from_all_objects_stands_on_the_ground_of_the_nearest() -> None:
    """A house 57 m away, a mast 80 m away: on z = 0 the house would end 54 m below the street, and hide nothing."""
    scene, truth = uphill()
    mast = {"at": [0.0, -80.0], "yaw_deg": 0, "height_m": 5.0, "pem": "sure"}
    asked = experiment(
        units={"ego": EGO_UNIT, "mast": mast, "near": mast | {"at": [0.0, -50.0]}},
        obstacles=[{"polygon_m": HOUSE, "height_m": 8.0}, {"polygon_m": HOUSE, "height_m": 8.0, "ground_z_m": 3.0}],
    )
    placed = place_units(scene, truth, asked)
    assert [(solid.bottom_m, solid.top_m) for solid in placed.solids] == [(62.0, 70.0), (3.0, 11.0)]
    assert placed.static.bottom_m.tolist() == [42.0, 3.0], "who gives the ground gives the bottom"
    assert placed.static.top_m.tolist() == [70.0, 11.0]
    assert placed.poses["mast"].z_m.tolist() == [67.0] * 11
    assert placed.notes == (
        "obstacle 0 and 1 other: ground taken from the nearest object, up to 80 m away (give ground_z_m)",
    )


def test_nobody_sees_under_a_house_where_the_ground_falls_away() -> None:
    """The house stands at z = 62 m by the ego beside it; from a valley 10 m below nobody sees what is behind it."""
    scene, truth = uphill((59.0, 2.0), (100.0, 3.0))
    low = np.where(truth.row_object_ix == 2, -10.0, 0.0)  # the pedestrian behind the house is in the valley, too
    truth = replace(truth, z_m=truth.z_m + low)
    eye = {"at": [20.0, 3.0], "yaw_deg": 0, "height_m": 2.0, "ground_z_m": 52.0, "pem": "sure"}
    house = {"polygon_m": ((57.0, 0.0), (67.0, 0.0), (67.0, 10.0), (57.0, 10.0)), "height_m": 8.0}
    for said, expected in (({}, 0.0), ({"ground_z_m": 62.0}, 1.0)):
        asked = experiment(units={"ego": EGO_UNIT, "eye": eye}, obstacles=[house | said])
        found = observe_objects(scene, truth, asked)
        behind = (found.tracks.row_object_ix == 2) & (found.tracks.row_unit_ix == 1)
        assert set(found.view.visible_share[behind].tolist()) == {expected}
