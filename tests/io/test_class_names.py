"""Names of classes of public data sets, simulators and drivers, and what a person would say they are."""

from pathlib import Path

import pytest

from copem_replay.core.tracks import CLASSES
from copem_replay.io.class_names import class_from_name
from copem_replay.io.recording import read_log
from tests.helpers.recordings import write_mcap
from tests.io.test_world_frame import TIMES, fields, json_topic

MEANT = {
    "pedestrian": "RoadWorker OFFICIAL_SIGNALER TYPE_WHEELCHAIR woman vru pedestrians human.pedestrian.police_officer "
    "walker.pedestrian.0012 construction_worker PERSON_SITTING",
    "bicycle": "BICYCLIST e-scooter kick_scooter unicycle TYPE_STANDUP_SCOOTER Cyclist vehicle.bicycle cargo_bike "
    "vehicle.gazelle.omafiets",
    "motorcycle": "MotorcyleRider motor_cycle moped powered_two_wheeler vehicle.vespa.zx125 "
    "vehicle.harley-davidson.low_rider motorcycle",
    "car": "SUV Hatchback passengerCar police_car TYPE_MEDIUM_CAR vehicle.tesla.model3 taxi station_wagon "
    "REGULAR_VEHICLE",
    "van": "Van TYPE_DELIVERY_VAN minivan",
    "truck": "BoxTruck BOX_TRUCK fire_truck FireTruck lorries Semi-truck TRUCK_CAB TYPE_SEMITRACTOR ConcreteTruck "
    "heavyTruck vehicle.carlamotors.firetruck construction_vehicle",
    "bus": "ARTICULATED_BUS SCHOOL_BUS truck_bus vehicle.bus.rigid",
    "trailer": "vehicle.trailer semitrailer MESSAGE_BOARD_TRAILER TRAFFIC_LIGHT_TRAILER",
    "animal": "DOG deer large_animal",
    "other": "bicycle_rack STOP_SIGN MOBILE_PEDESTRIAN_CROSSING_SIGN bus_stop car_door Pylons Trafficcone TYPE_SIGN "
    "train_car UNKNOWN_MOVABLE static_object.bicycle_rack roadSideUnit construction_cone TrafficLight "
    "RAILED_VEHICLE roadBoundary pillar CONSTRUCTION_BARREL",
    "vehicle": "priorityVehicle other_vehicle light_vehicle",
}


@pytest.mark.parametrize(("meant", "name"), [(meant, name) for meant, names in MEANT.items() for name in names.split()])
def test_a_name_is_what_a_person_would_say(meant: str, name: str) -> None:
    assert class_from_name(name) == meant


@pytest.mark.parametrize(
    ("name", "meant"),
    [("person on bicycle", "bicycle"), ("Pedestrian with Object", "pedestrian"), ("bicycle lane", "other"),
     ("", None), ("zorb", None), ("1", None)],
)  # fmt: skip
def test_names_of_several_words_and_of_none(name: str, meant: str | None) -> None:
    assert class_from_name(name) == meant


def test_every_class_has_its_own_name() -> None:
    assert [class_from_name(name) for name in CLASSES] == list(CLASSES)


def test_names_that_say_nothing_are_told_of_and_can_be_given_a_class(tmp_path: Path) -> None:
    def lists(t: float) -> dict:
        box = {"track": {"id": 1}, "pos": [t, 0, 0.5], "dims": [1, 1, 1], "rot": 0, "label": "Zorb"}
        rack = {**box, "track": {"id": 2}, "pos": [9, 9, 0.5], "label": "bicycle_rack"}
        return {"header": {"t": {"sec": 0, "nanosec": round(t * 1e9)}, "frame": "map"}, "boxes": [box, rack]}

    path = write_mcap(tmp_path / "a.mcap", [json_topic("/boxes", [(t, lists(t)) for t in TIMES])])
    plain = read_log(path, name="log", topic="/boxes", fields=fields())
    line = "11 object states with a class name that says nothing (Zorb 11): read as other; "
    assert f"{line}`read: {{classes: {{NAME: car}}}}` says what it is" in plain.notes
    assert "11 object states of a class that is no road user's (bicycle_rack 11): read as other" in plain.notes
    said = read_log(path, name="log", topic="/boxes", fields=fields(), classes={"Zorb": "bicycle"})
    assert CLASSES[said.scene.object_class[0]] == "bicycle"
