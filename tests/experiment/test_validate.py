from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from copem_replay.experiment.file import log_paths, make_plain_source
from copem_replay.experiment.validate import check_across_logs, find_problems, log_names, read_logs
from copem_replay.io.recording import Recording
from tests.helpers.experiments import TEXT, changed, drive, source_of
from tests.helpers.recordings import Obj, Topic, truth_topic, write_mcap, write_recording

CARS = "1 (car), 2 (car)"
LATE = "  coPEM: {units: all, latency_s: "


def without_logs(folder: Path, text: str) -> list[str]:
    """`line: key: message` of each problem that shows without a look at the logs (`drive.mcap` is there)."""
    (folder / "drive.mcap").touch()
    source = source_of(folder, text)
    _, found = find_problems(source)
    assert all(line.startswith(f"{source.path}:") for line in found)
    return [line.removeprefix(f"{source.path}:") for line in found]


def against_logs(folder: Path, text: str) -> list[str]:
    """Each problem with the logs, the folder left out of all paths."""
    source = source_of(folder, text)
    experiment, found = find_problems(source)
    assert found == []
    assert experiment is not None
    recordings, refused = read_logs(experiment, log_paths(source)[0], source)
    lines = [log.said(source) for log in refused] + list(check_across_logs(experiment, recordings, source))
    return [line.replace(f"{folder}/", "").removeprefix("experiment.yaml:") for line in lines]


def recordings_of(folder: Path, text: str) -> list[Recording]:
    source = source_of(folder, text)
    experiment, found = find_problems(source)
    assert found == []
    assert experiment is not None
    recordings, refused = read_logs(experiment, log_paths(source)[0], source)
    assert refused == []
    return recordings


class TestReferences:
    @pytest.mark.parametrize(
        ("change", "key", "expected"),
        [
            ("  ego: {on: ego, height_m: 1, pem: onbord}", "11: units.ego.pem", "PEM 'onbord'; did you mean onboard?"),
            ("  ego: {on: ego, height_m: 1, pem: 7}", "11: units.ego.pem", "PEM '7'; there are onboard"),
            ("  PEM: {units: [eg0]}", "15: configurations.PEM.units[0]", "unit 'eg0'; did you mean ego?"),
            ("  PEM: {units: [ego, bus]}", "15: configurations.PEM.units[1]", "unit 'bus'; there are ego, mast"),
            ("  PEM: {units: [truth]}", "15: configurations.PEM.units[0]", "unit 'truth'; there are ego, mast"),
            (f"{LATE}{{maast: 1}}}}", "16: configurations.coPEM.latency_s.maast", "unit 'maast'; did you mean mast?"),
            (f"{LATE}{{x: 1}}}}", "16: configurations.coPEM.latency_s.x", "unit 'x'; there are ego, mast, default"),
            ("measure: {distance_to: moon}", "17: measure.distance_to", "unit 'moon'; there are ego, mast"),
            ("measure: {distance_to: 5}", "17: measure.distance_to", "unit '5'; there are ego, mast"),
        ],
    )
    def test_to_what_is_not_there(self, tmp_path: Path, change: str, key: str, expected: str) -> None:
        what, _, rest = expected.partition(" ")
        assert without_logs(tmp_path, changed(change)) == [f"{key}: no {what} is named {rest}"]

    def test_unit_twice(self, tmp_path: Path) -> None:
        found = without_logs(tmp_path, changed("  PEM: {units: [ego, mast, ego]}"))
        assert found == ["15: configurations.PEM.units[2]: unit 'ego' named twice"]

    def test_configurations_that_are_shown(self, tmp_path: Path) -> None:
        assert without_logs(tmp_path, changed("show: {configurations: [coPEM, GT]}")) == []
        assert without_logs(tmp_path, changed("show: {configurations: [coPEN, GT, 5]}")) == [
            "18: show.configurations[0]: no configuration is named 'coPEN'; did you mean coPEM?",
            "18: show.configurations[2]: no configuration is named '5'; there are GT, PEM, coPEM",
        ]

    @pytest.mark.parametrize("wrong", [[2], {"a": 1}, [[2]], None, 3.5, True, {}, []], ids=repr)
    @pytest.mark.parametrize("key", [
        "logs[0].file", "logs[0].measure.distance_to", "pems", "units.mast.on", "units.mast.sends",
        "configurations.A.units", "configurations.A.fusion", "links", "measure.distance_to", "measure.onset",
        "measure.confirm", "braking", "ego", "max_gap_s", "runs", "show.run", "sweep.loss", "criteria.c.metric",
    ])  # fmt: skip
    def test_a_value_of_any_shape_hides_no_undefined_name(self, key: str, wrong: object) -> None:
        """Also where both stand in one unit, configuration or log."""
        study: dict[str, Any] = {
            "logs": [{"file": "a.mcap", "units": {"mats": {}}, "measure": {}}],
            "units": {"mast": {"pem": "camra"}},
            "configurations": {"A": {"units": "all", "latency_s": {"mats": 1}, "link": {"mats": "radio"}}},
            "show": {"configurations": ["B"]}, "sweep": {"configurations": ["B"]}, "measure": {},
            "criteria": {"c": {"configurations": ["B"], "weigh": "drives"}},
        }  # fmt: skip
        places = [
            "logs[0].units.mats", "units.mast.pem", "configurations.A.latency_s.mats", "configurations.A.link.mats",
            "show.configurations[0]", "sweep.configurations[0]", "criteria.c.configurations[0]",
        ]  # fmt: skip
        place: Any = study
        *path, last = [int(part) if part.isdigit() else part for part in re.findall(r"\w+", key)]
        for part in path:
            place = place[part]
        place[last] = wrong
        _, found = find_problems(make_plain_source(study))
        told = [line.split(": ")[1] for line in found if " is named " in line]
        assert set(places) <= set(told)

    def test_a_recorded_unit_without_a_place(self, tmp_path: Path) -> None:
        """Distances cannot be measured from it, and `all` does not mean it."""
        measure = "measure: {distance_to: mast}"
        nowhere = "unit 'mast' has no place; say `at: [x, y]` or `on: <object id>` of it"
        for place, expected in (
            ("", [f"17: measure.distance_to: {nowhere}"]),
            ("at: [1, 2], ", []),
            ("on: 2, ", []),
            ("on: ego, ", []),
        ):
            mast = f"  mast: {{{place}recorded: {{topic: lists}}}}"
            assert without_logs(tmp_path, changed(mast, measure)) == expected, place
            assert without_logs(tmp_path, changed(mast)) == [], place

    def test_a_recorded_unit_called_ego_needs_no_place(self, tmp_path: Path) -> None:
        """`distance_to: ego` is the vehicle, whatever units are called."""
        for measure in ("measure: {}", "measure: {distance_to: ego}"):
            text = changed("  ego: {recorded: {topic: a}}", measure)
            assert without_logs(tmp_path, text) == []

    def test_all_units_where_all_are_recorded(self, tmp_path: Path) -> None:
        text = changed("  ego: {on: ego, recorded: {topic: a}}", "  mast: {recorded: {topic: b}}")
        assert without_logs(tmp_path, text) == [
            "16: configurations.coPEM.units: all: the experiment has no modelled units; recorded ones are named"
        ]
        assert without_logs(tmp_path, text.replace("units: all", "units: [mast]")) == []
        sight = text.replace("units: all", "units: [mast]").replace(
            "kind: in_range, range_m: 60", "kind: line_of_sight_any"
        )
        assert without_logs(tmp_path, sight) == [
            "17: measure.onset: line_of_sight_any: there is no unit to see anything"
        ]

    @pytest.mark.parametrize("kind", ["union", "nms", "gnn", "tracker"])
    def test_the_truth_is_not_fused(self, tmp_path: Path, kind: str) -> None:
        text = changed(f"  GT: {{units: truth, fusion: {{kind: {kind}}}}}")
        assert without_logs(tmp_path, text) == [
            f"14: configurations.GT.fusion: the truth is not fused; {kind} needs units"
        ]
        assert without_logs(tmp_path, text.replace(kind, "ideal")) == []

    @pytest.mark.parametrize(
        ("changes", "expected"),
        [
            (["  coPEM: {units: all, fusion: {kind: gnn}}"],
             "configuration 'coPEM': gnn has no exact times, as what it does depends on sampled errors; only ideal "
             "fusion has"),
            (["  mast: {recorded: {topic: lists}}"],
             "unit 'mast' is recorded: nothing says how probable its lists were"),
        ],
    )  # fmt: skip
    def test_what_has_no_exact_times(self, tmp_path: Path, changes: list[str], expected: str) -> None:
        text = changed(*changes, "measure: {exact: true}")
        assert without_logs(tmp_path, text) == [f"17: measure.exact: {expected}"]
        assert without_logs(tmp_path, text.replace("exact: true", "exact: false")) == []

    @pytest.mark.parametrize("run", [4, 1_000_000])
    def test_run_that_is_not_made(self, tmp_path: Path, run: int) -> None:
        found = without_logs(tmp_path, changed(f"show: {{run: {run}}}"))
        assert found == [f"18: show.run: expected a run below 4, found {run}"]
        found = without_logs(tmp_path, changed(f"show: {{run: [median, 3, {run}]}}"))
        assert found == [f"18: show.run[2]: expected a run below 4, found {run}"]

    def test_without_units(self, tmp_path: Path) -> None:
        text = "version: 1\nlogs: [drive.mcap]\nconfigurations: {all: {units: all}, one: {units: [ego]}}\n"
        text += "measure: {onset: {kind: line_of_sight_any}}\n"
        assert without_logs(tmp_path, text) == [
            "3: configurations.all.units: all: the experiment has no units",
            "3: configurations.one.units[0]: no unit is named 'ego'; there are none",
            "4: measure.onset: line_of_sight_any: there is no unit to see anything",
        ]

    def test_numbers_and_text_are_the_same_name(self, tmp_path: Path) -> None:
        text = TEXT.replace("mast", "5").replace("[ego]", "['5']").replace("0.5}\nmeasure", "{5: 0.5}}\nmeasure")
        assert without_logs(tmp_path, text) == []
        assert without_logs(tmp_path, text.replace("['5']", "[5, '5']")) == [
            "15: configurations.PEM.units[1]: unit '5' named twice"
        ]

    def test_are_checked_where_the_shape_is_wrong(self, tmp_path: Path) -> None:
        """What is wrong in shape is said once, all else as well, in the order of the file."""
        text = changed(
            "runs: 0", "  ego: {on: ego, height_m: 1, pem: 3.5}", "  PEM: {units: [eg0, true]}", "show: {run: 9}"
        )
        assert without_logs(tmp_path, text) == [
            "3: runs: expected at least 1, found 0",
            "11: units.ego.pem: expected text, found 3.5",
            "15: configurations.PEM.units[1]: expected text, found true",
            "15: configurations.PEM.units[0]: no unit is named 'eg0'; did you mean ego?",
        ]

    @pytest.mark.parametrize(
        "text", ["units: 5", "units: [ego]", "measure: 3", "show: [1]", "pems: x", "configurations: [a]"]
    )
    def test_do_not_stumble_over_a_wrong_shape(self, tmp_path: Path, text: str) -> None:
        assert len(without_logs(tmp_path, f"version: 1\nlogs: [drive.mcap]\n{text}\n")) >= 1

    def test_log_that_matches_nothing(self, tmp_path: Path) -> None:
        assert without_logs(tmp_path, changed("logs: [drive.mcap, 'x*.mcap']")) == [
            "2: logs[1]: no file matches 'x*.mcap'"
        ]


class TestOneLog:
    def test_nothing_is_wrong(self, tmp_path: Path) -> None:
        drive(tmp_path / "drive.mcap")
        assert against_logs(tmp_path, TEXT) == []
        (recording,) = recordings_of(tmp_path, TEXT)
        assert recording.scene.log == "drive"
        assert recording.scene.object_ids[recording.scene.ego_ix] == "1"

    @pytest.mark.parametrize(
        ("host", "why"),
        [(None, "host_vehicle_id is not set"), (77, "its host_vehicle_id '77' is no moving object of it"),
         (3, "its host_vehicle_id '3' is no moving object of it")],
    )  # fmt: skip
    def test_no_ego_in_it(self, tmp_path: Path, host: int | None, why: str) -> None:
        drive(tmp_path / "drive.mcap", host=host)
        assert against_logs(tmp_path, TEXT) == [
            f"1: ego: drive.mcap: no ego vehicle in this log ({why}); give `ego: <object id>` or --ego ID ({CARS}), "
            "or `ego: none` with `distance_to: <unit>`"
        ]
        (recording,) = recordings_of(tmp_path, TEXT + "ego: 2\n")
        assert recording.scene.object_ids[recording.scene.ego_ix] == "2"

    def test_other_problems_are_said_beside_a_missing_ego(self, tmp_path: Path) -> None:
        drive(tmp_path / "drive.mcap", host=None)
        found = against_logs(tmp_path, changed("  mast: {on: 9, height_m: 1, pem: onboard}"))
        assert len(found) == 2
        assert found[1] == f"12: units.mast.on: drive.mcap: no object '9' in the log; there are {CARS}"

    HOUSE = "obstacles: [{{polygon_m: [[11.8, -9], [30, -9], [30, 9], [11.8, 9]], height_m: {height_m}}}]"

    @pytest.mark.parametrize(
        ("height_m", "place", "found"),
        [
            (12, "at: [12.0, -4.5], height_m: 5.0", "0.2 m inside obstacle 0 (z 0 … 12 m)"),
            (5.1, "at: [12.0, -4.5], height_m: 5.0", "0.2 m inside obstacle 0 (z 0 … 5.1 m)"),
            (12, "at: [11.0, 0.0], offset_m: [3.0, 0.0], height_m: 0.5", "2.2 m inside obstacle 0 (z 0 … 12 m)"),
            (12, "at: [20.0, 0.0], height_m: 2.0, ground_z_m: -15.0", "8.2 m inside obstacle 0 (z 0 … 12 m)"),
            (5, "at: [12.0, -4.5], height_m: 5.0", None),  # on its roof
            (4.9, "at: [12.0, -4.5], height_m: 5.0", None),
            (12, "at: [11.8, -4.5], height_m: 5.0", None),  # on its wall
            (12, "at: [11.6, -4.5], height_m: 5.0", None),
        ],
    )
    def test_a_unit_in_a_solid(self, tmp_path: Path, height_m: float, place: str, found: str | None) -> None:
        drive(tmp_path / "drive.mcap")
        text = changed(f"  mast: {{{place}, pem: onboard}}", self.HOUSE.format(height_m=height_m))
        said = (
            f"12: units.mast.at: drive.mcap: mast stands {found}: it would look through it; expected a place beside "
            "it, or `height_m` above its top"
        )
        assert against_logs(tmp_path, text) == ([said] if found else [])

    def test_a_unit_in_a_solid_of_the_log(self, tmp_path: Path) -> None:
        """It is 1 m from two faces of a triangle; (17, 0.5), in the other half of its box, is in the open."""
        corners = [(-1, -1), (9, -1), (-1, 9)]
        house = Obj(id=9, x=12, y=-4.5, z=4, length=20, width=20, height=8, stationary=True, polygon=corners)
        write_recording(tmp_path / "drive.mcap", [(0.1 * k, [Obj(id=1), house]) for k in range(3)], host=1)
        assert against_logs(tmp_path, TEXT) == [
            "12: units.mast.at: drive.mcap: mast stands 1 m inside object 9 (z 0 … 8 m): it would look through it; "
            "expected a place beside it, or `height_m` above its top"
        ]
        assert against_logs(tmp_path, changed("  mast: {at: [17.0, 0.5], height_m: 5.0, pem: onboard}")) == []

    @pytest.mark.parametrize("ego", ["9", "3", "''"])
    def test_ego_that_is_not_in_it_or_does_not_move(self, tmp_path: Path, ego: str) -> None:
        drive(tmp_path / "drive.mcap")
        text = changed("  mast: {on: 8, height_m: 1, pem: onboard}", f"ego: {ego}")
        assert against_logs(tmp_path, text) == [
            f"19: ego: drive.mcap: no moving object {ego.strip(chr(39))!r}; there are {CARS}",
            f"12: units.mast.on: drive.mcap: no object '8' in the log; there are {CARS}",
        ]

    def test_none(self, tmp_path: Path) -> None:
        drive(tmp_path / "drive.mcap")
        text = changed("ego: none", "measure: {onset: {kind: line_of_sight}}")
        assert against_logs(tmp_path, text) == [
            "17: measure.distance_to: drive.mcap: `ego: none` needs `distance_to: <unit>` to measure distances from",
            "11: units.ego.on: drive.mcap: no ego in this study to carry the unit",
            "17: measure.onset: drive.mcap: line_of_sight needs an ego; without one use line_of_sight_any",
        ]

    def test_none_with_a_mast(self, tmp_path: Path) -> None:
        drive(tmp_path / "drive.mcap")
        text = TEXT.replace("  ego: {on: ego, height_m: 1.8, pem: onboard}\n", "").replace("[ego]", "[mast]")
        text = text.replace("measure: {", "measure: {distance_to: mast, ") + "ego: none\n"
        (recording,) = recordings_of(tmp_path, text)
        assert recording.scene.ego_ix == -1

    @pytest.mark.parametrize(("on", "fine"), [("ego", True), ("1", True), ("2", False)])
    def test_line_of_sight_is_that_of_a_unit_on_the_ego(self, tmp_path: Path, on: str, fine: bool) -> None:
        drive(tmp_path / "drive.mcap")
        text = changed(f"  ego: {{on: {on}, height_m: 1, pem: onboard}}", "measure: {onset: {kind: line_of_sight}}")
        why = "17: measure.onset: drive.mcap: line_of_sight needs a unit on the ego; or use line_of_sight_any"
        assert against_logs(tmp_path, text) == ([] if fine else [why])

    def test_a_parked_car_may_carry_a_unit(self, tmp_path: Path) -> None:
        drive(tmp_path / "drive.mcap")
        assert against_logs(tmp_path, changed("  mast: {on: 3, height_m: 1, pem: onboard}")) == []

    def test_measured_ids(self, tmp_path: Path) -> None:
        drive(tmp_path / "drive.mcap")
        assert against_logs(tmp_path, changed("measure: {objects: {ids: [2, 3]}}")) == []
        assert against_logs(tmp_path, changed("measure: {objects: {ids: [2, 9, 1]}}")) == [
            f"17: measure.objects.ids[1]: no object '9' in any log; the first has {CARS}",
            "17: measure.objects.ids[2]: '1' is the ego vehicle, which is not measured",
        ]

    def test_shown_logs(self, tmp_path: Path) -> None:
        drive(tmp_path / "drive.mcap")
        assert against_logs(tmp_path, changed("show: {logs: [first, all, drive]}")) == []
        assert against_logs(tmp_path, changed("show: {logs: [first, dive, x]}")) == [
            "18: show.logs[1]: no log is named 'dive'; did you mean drive?",
            "18: show.logs[2]: no log is named 'x'; there are first, all, drive",
        ]

    def test_topic(self, tmp_path: Path) -> None:
        frames = [(0.1 * k, [Obj(id=1), Obj(id=2, x=9.0)]) for k in range(3)]
        topics = [truth_topic(frames, name=name, host=1) for name in ("a", "b")]
        write_mcap(tmp_path / "drive.mcap", topics)
        (found,) = against_logs(tmp_path, TEXT)
        assert found.startswith(
            "drive.mcap: true objects on several topics, a (osi3.GroundTruth), b (osi3.GroundTruth)"
        )
        assert recordings_of(tmp_path, TEXT + "read: {topic: b}\n")[0].topic == "b"
        (found,) = against_logs(tmp_path, TEXT + "read: {topic: c}\n")
        assert found.startswith("19: read.topic: drive.mcap: no true objects on topic 'c'; they are on a (")

    def test_a_topic_of_any_name_is_no_key(self, tmp_path: Path) -> None:
        for name in ("ego", "no true objects on topic"):
            write_mcap(tmp_path / "drive.mcap", [truth_topic([(0, [Obj(x=None)])], name=name)])
            (found,) = against_logs(tmp_path, TEXT + "ego: 1\n")
            assert found.startswith(f"drive.mcap: {name}: no usable object")


class TestUnreadableLogs:
    def test_absent(self, tmp_path: Path) -> None:
        text = changed("logs:\n  - drive.mcap\n  - none.mcap")
        drive(tmp_path / "drive.mcap")
        assert against_logs(tmp_path, text) == ["4: logs[1]: none.mcap: no such file"]

    @pytest.mark.parametrize("name", ["x" * 300, "a\0b"])
    def test_name_no_file_can_have(self, tmp_path: Path, name: str) -> None:
        text = changed('logs: ["' + name.replace("\0", "\\0") + '"]')
        assert against_logs(tmp_path, text) == [f"2: logs[0]: {name}: no such file"]

    def test_no_recordings(self, tmp_path: Path) -> None:
        (tmp_path / "empty.mcap").touch()
        (tmp_path / "text.mcap").write_text("hello")
        write_mcap(tmp_path / "nothing.mcap", [])
        write_mcap(tmp_path / "lidar.mcap", [Topic("points", "PointCloud", [(0, b"1")])])
        write_recording(tmp_path / "nobody.mcap", [(0.0, [])], host=1)
        found = against_logs(tmp_path, changed("logs: ['*.mcap', .]"))
        assert [line.partition(": ")[0] for line in found] == [
            "empty.mcap", "lidar.mcap", "nobody.mcap", "nothing.mcap", "text.mcap", str(tmp_path),
        ]  # fmt: skip
        assert all("\n" not in line for line in found)

    def test_path_that_is_not_utf8(self, tmp_path: Path) -> None:
        drive(tmp_path / "caf\udce9.mcap")
        (found,) = against_logs(tmp_path, changed("logs: ['*.mcap']"))
        assert found == "caf\udce9.mcap: its path is not UTF-8: results could not name it"


class TestSeveralLogs:
    def test_each_problem_is_said_for_each_log(self, tmp_path: Path) -> None:
        drive(tmp_path / "a.mcap")
        drive(tmp_path / "b.mcap", host=None)
        drive(tmp_path / "c.mcap", first=11, host=11)
        found = against_logs(tmp_path, changed("logs: ['?.mcap']", "  mast: {on: 2, height_m: 1, pem: onboard}"))
        assert len(found) == 2
        assert found[0].startswith("1: ego: b.mcap: no ego vehicle in this log")
        assert found[1] == "12: units.mast.on: c.mcap: no object '2' in the log; there are 11 (car), 12 (car)"

    def test_measured_ids_are_in_one_of_them(self, tmp_path: Path) -> None:
        drive(tmp_path / "a.mcap")
        drive(tmp_path / "b.mcap", first=2, host=2)
        text = changed("logs: [a.mcap, b.mcap]", "measure: {objects: {ids: [1, 2, 3, 4, 5]}}")
        assert against_logs(tmp_path, text) == [
            "17: measure.objects.ids[0]: '1' is the ego vehicle, which is not measured",
            f"17: measure.objects.ids[4]: no object '5' in any log; the first has {CARS}",
        ]

    def test_order_is_that_of_the_file(self, tmp_path: Path) -> None:
        for name in ("c", "a", "b"):
            drive(tmp_path / f"{name}.mcap")
        found = recordings_of(tmp_path, changed("logs: [b.mcap, '*.mcap']"))
        assert [recording.scene.log for recording in found] == ["b", "a", "c"]

    def test_the_same_file_is_read_once(self, tmp_path: Path) -> None:
        drive(tmp_path / "drive.mcap")
        (tmp_path / "again.mcap").symlink_to("drive.mcap")
        (tmp_path / "sub").mkdir()
        text = changed(f"logs: [drive.mcap, sub/../drive.mcap, '{tmp_path}/drive.mcap', again.mcap]")
        assert [recording.scene.log for recording in recordings_of(tmp_path, text)] == ["drive"]

    def test_names_do_not_depend_on_what_cannot_be_read(self, tmp_path: Path) -> None:
        """The experiment that is written holds only what was read: its logs must be called the same."""
        drive(tmp_path / "a" / "drive.mcap")
        (tmp_path / "b").mkdir()
        (tmp_path / "b" / "drive.mcap").touch()
        source = source_of(tmp_path, changed("logs: ['*/drive.mcap']"))
        experiment, _ = find_problems(source)
        assert experiment is not None
        (recording,), (refused,) = read_logs(experiment, log_paths(source)[0], source)
        assert recording.scene.log == "drive"
        assert refused.path == tmp_path / "b" / "drive.mcap"
        assert refused.reason == "the file is empty"


class TestLogNames:
    @pytest.mark.parametrize(
        ("paths", "names"),
        [
            (["/x/a.mcap"], ["a"]),
            (["/x/a.mcap", "/x/b.mcap"], ["a", "b"]),
            (["/x/a.mcap", "/y/a.mcap", "/y/b.mcap"], ["x/a", "y/a", "b"]),
            (["/x/1/a.mcap", "/y/1/a.mcap", "/y/2/a.mcap"], ["x/1/a", "y/1/a", "2/a"]),
            (["/a.mcap", "/x/a.mcap"], ["a", "x/a"]),
            (["/x/a.mcap", "/x/a.bag", "/x/b.mcap"], ["a.mcap", "a.bag", "b"]),
            (["/x/a", "/x/a.mcap"], ["a", "a.mcap"]),
            (["/x/a.osi.mcap", "/x/.mcap"], ["a.osi", ".mcap"]),
            (["/x/a.mcap", "/x/a.mcap"], ["x/a.mcap", "x/a.mcap"]),
        ],
    )
    def test_are_file_names_made_unique_by_folders(self, paths: list[str], names: list[str]) -> None:
        assert log_names([Path(path) for path in paths]) == names
        assert not any(name.startswith("/") for name in names)

    def test_a_link_keeps_its_own_name(self, tmp_path: Path) -> None:
        (tmp_path / "store").mkdir()
        for name in ("1", "2"):
            (tmp_path / "store" / name).touch()
            (tmp_path / f"night {name}").mkdir()
            (tmp_path / f"night {name}" / "drive.mcap").symlink_to(tmp_path / "store" / name)
        assert log_names(sorted(tmp_path.glob("night*/*"))) == ["night 1/drive", "night 2/drive"]
