"""The converters' command, and the formats that are text: CSV, SUMO, CommonRoad. All expected values by hand."""

from __future__ import annotations

import gzip
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from osi3.osi_object_pb2 import MovingObject

from copem_replay.experiment.draft.survey import survey_recording
from copem_replay.extras.convert import command as convert_command
from tests.extras.conversions import ROOT, Runner, convert, run

__all__ = ["run"]

HEADER = "time_s,id,class,x_m,y_m,yaw_deg,length_m,width_m"
CAR = "0,1,car,0,0,0,4,2"

# The command ------------------------------------------------------------------------------------------------


def test_the_file_is_whole_the_same_again_and_read_by_info(run: Runner) -> None:
    source = run.file("table.csv", f"{HEADER}\n{CAR}\n0.1,1,car,1,0,0,4,2\n")
    run("csv", source)
    first = run.output.read_bytes()
    run("csv", source)
    assert run.output.read_bytes() == first
    found = survey_recording(run.output)
    assert found.readable
    assert [topic.topic for topic in found.topics] == ["ground_truth"]


def test_it_runs_as_a_command(tmp_path: Path) -> None:
    command = [sys.executable, "-c", "from copem_replay.cli.main import main; main()"]
    source = tmp_path / "table.csv"
    source.write_text(f"{HEADER}\n{CAR}\n")
    words = ["convert", "csv", source, "--out", tmp_path / "a.mcap"]
    done = subprocess.run([*command, *words], capture_output=True, text=True, check=True)
    assert done.stdout.startswith(f"{tmp_path / 'a.mcap'}: 1 frame, 1 car\nnote: 1 row without height_m")
    shown = subprocess.run([*command, "info", tmp_path / "a.mcap"], capture_output=True, text=True, check=True)
    assert "moving: 1 car" in shown.stdout


def test_what_a_killed_conversion_left_goes_with_the_next(tmp_path: Path) -> None:
    """It ends where its file is whole and has no name yet; a conversion beside it leaves what is not its own."""
    (tmp_path / "table.csv").write_text(f"{HEADER}\n{CAR}\n")
    code = "import os\nfrom copem_replay.cli.main import main\nfrom copem_replay.core import files\n{}\nmain()\n"

    def convert_to(name: str, before: str = "") -> subprocess.CompletedProcess[str]:
        words = [sys.executable, "-c", code.format(before), "convert", "csv", "table.csv", "--out", name]
        return subprocess.run(words, capture_output=True, text=True, cwd=tmp_path)

    assert convert_to("a.mcap", "files.flush_file = lambda _: os._exit(9)").returncode == 9
    (left,) = tmp_path.glob(".a.mcap.*.tmp.mcap")
    assert convert_to("b.mcap").returncode == 0
    assert left.exists()
    done = convert_to("a.mcap")
    assert done.returncode == 0
    assert done.stderr == ""
    assert sorted(os.listdir(tmp_path)) == ["a.mcap", "b.mcap", "table.csv"]


def test_a_wrong_command_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    for words, what in (
        (["kitti", "a", "--out", "b.mcap"], "No such command 'kitti'"),
        (
            [],
            "expected a format, one of argoverse2, nuscenes, opv2v, v2xseq, openlabel, commonroad, sumo",
        ),
        (["csv", "a"], "Missing option '--out'"),
        (["openlabel", "a", "--out", "b.mcap", "--rate-hz", "0"], "--rate-hz: expected a number above 0, found 0"),
        (["nuscenes", "a", "--out", "b", "--ego-centre-m", "nan"], "--ego-centre-m: expected a number, found"),
    ):
        assert convert(*words) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert what in line


def test_every_format_has_a_command_and_its_help_says_the_defaults() -> None:
    from copem_replay.extras.convert import argoverse2, nuscenes, v2xseq
    from copem_replay.extras.convert.conversion import FORMATS

    commands = typer.main.get_group(convert_command.app).commands
    assert list(commands) == list(FORMATS)

    def default(command: str, option: str) -> list[float]:
        (found,) = [p.help for p in commands[command].params if p.name == option]
        return [float(number) for number in re.findall(r"\d+\.?\d*", found)]

    assert default("argoverse2", "ego_size_m") == list(argoverse2.EGO_SIZE_M)
    assert default("argoverse2", "centre_from_rear_axle_m") == list(argoverse2.CENTRE_FROM_REAR_AXLE_M)
    assert default("v2xseq", "ego_size_m") == list(v2xseq.EGO_SIZE_M)
    assert default("nuscenes", "ego_size_m") == list(nuscenes.EGO_SIZE_M)
    assert default("nuscenes", "ego_centre_m") == [nuscenes.EGO_CENTRE_M]
    assert default("nuscenes", "rate_hz") == [nuscenes.RATE_HZ]


def test_input_and_output_are_checked_first(run: Runner, capsys: pytest.CaptureFixture[str]) -> None:
    source = run.file("table.csv", f"{HEADER}\n{CAR}\n")
    assert "no such file or folder" in run.refused("csv", run.folder / "none.csv")
    assert convert("csv", source, "--out", source) == 2  # swapped or forgotten: it would be overwritten
    assert "--out: expected another name, found that of an input of this command" in capsys.readouterr().err
    assert source.read_text().startswith(HEADER)
    (run.folder / "folder.mcap").mkdir()
    assert convert("csv", source, "--out", run.folder / "folder.mcap") == 2
    assert "folder.mcap: expected a name for a file, found a folder" in capsys.readouterr().err
    assert "cannot be opened: Is a directory" in run.refused("csv", run.folder)


def test_a_failure_midway_leaves_the_old_file_alone(run: Runner) -> None:
    step = '<timestep time="{}"><vehicle id="a" x="1" y="0" angle="90"/></timestep>'
    good = run.file("good.xml", f"<fcd-export>{step.format(0)}</fcd-export>")
    bad = run.file("bad.xml", f"<fcd-export>{step.format(0)}{step.format(0)}</fcd-export>")
    run("sumo", good)
    before = run.output.read_bytes()
    assert convert("sumo", bad, "--out", run.output, "--overwrite") == 2
    assert run.output.read_bytes() == before
    assert list(run.output.parent.iterdir()) == [run.output]


def test_what_is_there_already_is_replaced_only_when_that_is_asked_for(
    run: Runner, capsys: pytest.CaptureFixture[str]
) -> None:
    source = run.file("table.csv", f"{HEADER}\n{CAR}\n")
    there = run.file("there.mcap", "of another day")
    words = ["csv", source, "--out", there]
    assert convert(*words) == 2
    assert capsys.readouterr().err == f"{there}: is there already; give another name, or --overwrite\n"
    assert there.read_text() == "of another day"
    assert convert(*words, "--overwrite") == 0
    assert survey_recording(there).readable
    assert sorted(path.name for path in run.folder.iterdir()) == ["table.csv", "there.mcap"]


# CSV --------------------------------------------------------------------------------------------------------


def test_csv_every_column(run: Runner) -> None:
    source = run.file(
        "table.csv",
        "\ufefftime_s,id,class,x_m,y_m,z_m,yaw_rad,length_m,width_m,height_m,vx_mps,vy_mps,moving,host\r\n"
        "1.1,7,car,1,2,3,-4,4,2,1.6,5,6,true,1\r\n"  # −4 + 2π = 2.2832
        "1,7,car,0.5,1.4,3,3,4,2,1.6,5,6,,1\r\n"
        "1,8,bicycle,9,9,0.85,0,1.8,0.6,1.7,,,1,\r\n"
        "1,9,pedestrian,-9,9,0.9,0,0.5,0.5,1.8,0,0,0,\r\n"
        "\r\n",
    )
    found = run("csv", source)
    assert found.stamps_ns == [1_000_000_000, 1_100_000_000]
    names = ("x_m", "y_m", "z_m", "yaw_rad", "length_m", "width_m", "height_m", "vx_mps", "vy_mps")
    first, second = found.values("7", *names)
    assert first == [0.5, 1.4, 3, 3, 4, 2, 1.6, 5, 6]
    assert second == pytest.approx([1, 2, 3, 2.2831853, 4, 2, 1.6, 5, 6])
    assert [found.class_of(ident) for ident in "789"] == ["car", "bicycle", "other"]
    assert [found.moves(ident) for ident in "789"] == [True, True, False]
    assert found.recording.host_id == "7"
    assert found.recording.scene.object_ids[found.recording.scene.ego_ix] == "7"
    bicycle = next(moving for moving in found.messages[0].moving_object if moving.id.value == 8)
    assert not bicycle.base.HasField("velocity")
    assert found.names == {"7": "7", "8": "8", "9": "9"}


def test_csv_degrees_wrap_and_what_is_not_given_is_said(run: Runner) -> None:
    found = run("csv", run.file("t.csv", f"{HEADER}\n0,bus 4,bus,0,0,270,12,2.5\n0,ped,pedestrian,5,0,90,0.5,0.5\n"))
    assert found.names == {"1": "bus 4", "2": "ped"}
    ((yaw_rad, z_m, height_m),) = found.values("1", "yaw_rad", "z_m", "height_m")
    assert (yaw_rad, z_m, height_m) == (pytest.approx(-1.5707963), 1.5, 3.0)
    assert "note: 2 rows without height_m: the typical height of the class taken\n" in found.printed
    assert "note: 2 rows without z_m: stood on z = 0\n" in found.printed
    assert "note: objects are numbered" in found.printed
    assert found.recording.host_id is None


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("", "t.csv:1: expected the columns time_s, id, class, x_m, y_m, length_m, width_m, too, found 'nothing'"),
        (HEADER.replace("x_m", "x"), "t.csv:1: expected the columns x_m, too"),
        (HEADER.replace(",", ";"), "t.csv:1: expected the columns time_s"),
        (HEADER.replace("yaw_deg", "host"), "t.csv:1: expected either yaw_deg or yaw_rad, found none"),
        (f"{HEADER},yaw_rad", "t.csv:1: expected either yaw_deg or yaw_rad, found both"),
        (f"{HEADER},colour", "found 'colour'"),
        (f"{HEADER},id", "t.csv:1: expected each column once, found id 2 times"),
        (f"{HEADER},vx_mps", "t.csv:1: expected both vx_mps and vy_mps or none, found one"),
        (f"{HEADER},vx_mps,vy_mps\n{CAR},1,", "t.csv:2: vy_mps: expected a number beside the other, found nothing"),
        (f"{HEADER}\n{CAR},9", "t.csv:2: expected 8 cells, as in the header, found 9"),
        (f"{HEADER}\n{CAR}\n0.1,1,car,a,0,0,4,2", "t.csv:3: x_m: expected a number, found 'a'"),
        (f"{HEADER}\n-1,1,car,0,0,0,4,2", "t.csv:2: time_s: expected a time of 0 to 4000000000 s, found '-1'"),
        (f"{HEADER}\n1e99999,1,car,0,0,0,4,2", "t.csv:2: time_s: expected a time"),
        (f"{HEADER}\n0,1,,0,0,0,4,2", "t.csv:2: class: expected one of car, van, truck"),
        (f"{HEADER}\n0,,car,0,0,0,4,2", "t.csv:2: id: expected a name or number, found nothing"),
        (f"{HEADER}\n{CAR}\n{CAR}", "t.csv:3: id: expected each object once at a time, found 1 in line 2"),
        (f"{HEADER},host\n{CAR},1\n0,2,car,9,0,0,4,2,1", "t.csv:3: host: expected one object, found '2' besides '1'"),
        (f"{HEADER},host,moving\n{CAR},1,0", "t.csv:2: host: expected an object that moves, found '1'"),
        (f"{HEADER},host\n{CAR},yes", "t.csv:2: host: expected 0, 1, false or true, found 'yes'"),
        (HEADER, "t.csv: no object to convert in 0 frames"),
        (f'{HEADER}\n"0', "t.csv: expected comma-separated UTF-8 text, found something else"),
    ],
)
def test_csv_refuses(run: Runner, text: str, line: str) -> None:
    assert line in run.refused("csv", run.file("t.csv", text))


def test_csv_of_another_encoding(run: Runner) -> None:
    assert "expected comma-separated UTF-8 text" in run.refused("csv", run.file("t.csv", b"\xff\xfe\x00t"))


def test_the_page_shows_commands_that_are_understood_and_a_table_that_converts(run: Runner) -> None:
    from copem_replay.extras.convert import csv_rows
    from copem_replay.extras.convert.conversion import KINDS

    group = typer.main.get_group(convert_command.app)
    page = (ROOT / "docs/guide/data-sets.md").read_text(encoding="utf-8")
    commands = re.findall(r"`copem-replay convert (.*?)`", page)
    assert {command.split()[0] for command in commands} == set(group.commands)
    for command in commands:
        name, *words = shlex.split(command)
        group.commands[name].make_context(name, words)  # raises where an option is unknown or missing
    (table,) = re.findall(r"```csv\n(.*?)```", page, re.DOTALL)
    found = run("csv", run.file("table.csv", table))
    assert found.names == {"1": "ego", "2": "anna"}
    assert found.recording.host_id == "1"
    assert found.values("2", "vx_mps", "vy_mps")[0] == pytest.approx([0, 1])
    described = [re.findall(r"`(.*?)`", row)[:2] for row in re.findall(r"^\| (`.*?) \|", page, re.MULTILINE)]
    names = {name for pair in described for name in pair}
    assert names == {*csv_rows.REQUIRED, *csv_rows.YAW, *csv_rows.OPTIONAL}
    (classes,) = re.findall(r"^\| `class` \| required \| (.*?) \|", page, re.MULTILINE)
    assert re.split(r"[,;] ", classes.replace("never moving: ", "")) == list(KINDS)


# SUMO -------------------------------------------------------------------------------------------------------

TYPES = """<?xml version="1.0"?>
<additional>
  <vType id="long" vClass="truck" length="10" color="red"/>
  <vTypeDistribution id="mix"><vType id="small" length="3" width="1.5" height="1.4"/></vTypeDistribution>
  <vType id="rider" vClass="bicycle"/>
</additional>
"""


def fcd(*steps: str) -> str:
    inside = "".join(f'<timestep time="{k / 10:.2f}">\n{step}\n</timestep>' for k, step in enumerate(steps))
    return f'<?xml version="1.0"?>\n<!-- made by hand -->\n<fcd-export>{inside}</fcd-export>'


def test_sumo_front_bumper_and_angle(run: Runner) -> None:
    east = '<vehicle id="e" x="10" y="2" angle="90" speed="5" type="DEFAULT_VEHTYPE" z="1"/>'
    north = '<vehicle id="n" x="0" y="10" angle="0" speed="5" type="DEFAULT_VEHTYPE" z="1"/>'
    west = '<vehicle id="w" x="-10" y="0" angle="270" speed="5" type="DEFAULT_VEHTYPE" z="1"/>'
    walker = '<person id="e" x="3" y="4" angle="180" speed="1" type="DEFAULT_PEDTYPE" z="1"/>'
    found = run("sumo", run.file("fcd.xml", fcd(east + north + west + walker)))
    assert found.names == {"1": "vehicle e", "2": "vehicle n", "3": "vehicle w", "4": "person e"}
    names = ("x_m", "y_m", "z_m", "yaw_rad", "vx_mps", "vy_mps", "length_m", "width_m", "height_m")
    car = [5.0, 1.8, 1.5]
    # The front bumper at 10 m, half of 5 m behind it the centre; the ground at 1 m, half of 1.5 m above it.
    assert found.values("1", *names) == [pytest.approx([7.5, 2, 1.75, 0, 5, 0, *car])]
    assert found.values("2", *names) == [pytest.approx([0, 7.5, 1.75, 1.5707963, 0, 5, *car])]
    (row,) = found.values("3", *names)
    assert [row[0], abs(row[3]), row[4]] == pytest.approx([-7.5, 3.1415927, -5])
    assert found.values("4", *names) == [
        pytest.approx([3, 4, 1 + 1.719 / 2, -1.5707963, 0, -1, 0.215, 0.478, 1.719], abs=1e-6)
    ]
    assert found.class_of("4") == "pedestrian"
    assert found.recording.host_id is None


def test_sumo_packed(run: Runner) -> None:
    step = '<vehicle id="a" x="5" y="0" angle="90" type="t" speed="1"/>'
    plain = run("sumo", run.file("fcd.xml", fcd(step)))
    packed = gzip.compress(fcd(step).encode())
    found = run("sumo", run.file("fcd.xml.gz", packed))
    assert found.values("1", "x_m", "y_m") == plain.values("1", "x_m", "y_m")
    for content in (packed[:-12], b"<fcd-export/>", packed[:15] + b"zzzz" + packed[19:]):
        line = run.refused("sumo", run.file("fcd.xml.gz", content))
        assert "fcd.xml.gz: expected a file that gzip has packed, found something else or its end: " in line


def test_sumo_types_and_host(run: Runner) -> None:
    step = (
        '<vehicle id="a" x="0" y="0" angle="90" type="long"/>'
        '<vehicle id="b" x="0" y="9" angle="90" type="small@b"/>'
        '<vehicle id="c" x="0" y="18" angle="90" type="rider"/>'
        '<vehicle id="d" x="0" y="27" angle="90" type="unheard of"/>'
        '<person id="p" x="0" y="0" angle="90" vehicle="a"/><container id="k"/>'
    )
    found = run("sumo", run.file("f.xml", fcd(step, step)), "--types", run.file("t.add.xml", TYPES), "--host", "b")
    assert found.id_of("vehicle b") == "1"
    assert found.recording.host_id == "1"
    assert found.stamps_ns == [0, 100_000_000]
    sizes = {
        name: found.values(found.id_of(f"vehicle {name}"), "length_m", "width_m", "height_m")[0] for name in "abcd"
    }
    assert sizes == {"a": [10, 2.4, 2.4], "b": [3, 1.5, 1.4], "c": [1.6, 0.65, 1.7], "d": [5, 1.8, 1.5]}
    assert [found.class_of(found.id_of(f"vehicle {name}")) for name in "abcd"] == ["truck", "car", "bicycle", "car"]
    assert not found.messages[0].moving_object[0].base.HasField("velocity")
    assert "note: no z: the ground is z = 0\n" in found.printed
    assert (
        "note: 2 vehicle states of type 'unheard of', which is not among --types: car of 5×1.8×1.5 m taken\n"
        in found.printed
    )
    assert "note: 2 persons in a vehicle at a time step: skipped\n" in found.printed
    assert "note: 2 elements <container>: skipped\n" in found.printed


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("<routes/>", "f.xml:1: expected <fcd-export>, found <routes>"),
        ("time;x", "f.xml:1: expected XML, found something else or its end"),
        ("<fcd-export><timestep time='0'>", "f.xml:1: expected XML, found something else or its end: no element found"),
        (
            fcd('<vehicle id="a" y="0" angle="0"/>'),
            "f.xml:4: expected <vehicle> with the attribute x, found id, y, angle",
        ),
        (fcd('<vehicle id="a" x="1" y="b" angle="0"/>'), "f.xml:4: y: expected a number, found 'b'"),
        (fcd("<vehicle/>"), "f.xml:4: expected <vehicle> with the attribute id, found none"),
        (fcd("").replace("0.00", "inf"), "f.xml:3: time: expected a time of 0"),
        (fcd("", ""), "f.xml: no object to convert in 2 frames"),
        (fcd("", "").replace("0.10", "0"), "f.xml: frame 2: expected a time after 0.000000 s"),
    ],
)
def test_sumo_refuses(run: Runner, text: str, line: str) -> None:
    assert line in run.refused("sumo", run.file("f.xml", text))


def test_sumo_refuses_hosts_and_types_that_are_none(run: Runner) -> None:
    source = run.file("f.xml", fcd('<vehicle id="a" x="0" y="0" angle="0"/><person id="p" x="0" y="0" angle="0"/>'))
    assert "f.xml: --host: no vehicle 'p'; there are a" in run.refused("sumo", source, "--host", "p")
    types = run.file("t.xml", '<routes>\n<vType id="t" vClass="lorry"/></routes>')
    assert "t.xml:2: vClass: expected one of passenger" in run.refused("sumo", source, "--types", types)
    types = run.file("t.xml", '<routes><vType id="t" length="0"/></routes>')
    assert "t.xml:1: length: expected a number above 0, found '0'" in run.refused("sumo", source, "--types", types)
    types = run.file("t.xml", "<routes><trip/></routes>")
    assert "t.xml: expected vehicle types (<vType>), found no further one" in run.refused(
        "sumo", source, "--types", types
    )
    assert "no.xml: cannot be opened" in run.refused("sumo", source, "--types", run.folder / "no.xml")


@pytest.mark.parametrize("kind", ["sumo", "commonroad"])
def test_xml_with_entities_is_refused(run: Runner, kind: str) -> None:
    root = {"sumo": "fcd-export", "commonroad": "commonRoad"}[kind]
    bomb = (
        f'<?xml version="1.0"?>\n<!DOCTYPE a [<!ENTITY b "{"b" * 99}"><!ENTITY c "&b;&b;&b;">]>\n<{root}>&c;</{root}>'
    )
    line = run.refused(kind, run.file("bomb.xml", bomb))
    assert "bomb.xml:2: expected no DOCTYPE, found one: refused" in line


def test_sumo_is_read_time_step_by_time_step(run: Runner) -> None:
    from copem_replay.extras.convert.conversion import ConversionReport
    from copem_replay.extras.convert.sumo import frames

    step = '<vehicle id="a" x="1" y="0" angle="90"/>' + " " * 70_000  # each more than a block
    source = run.file("f.xml", fcd(step, step)[: -len("</timestep></fcd-export>")])
    reading = frames(source, ConversionReport())
    assert [box.id for box in next(reading).boxes] == [1]  # though the end of the file is missing


# CommonRoad -------------------------------------------------------------------------------------------------


def state(tag: str, step: str, x: str, y: str, more: str = "", turned: str = "<exact>0</exact>") -> str:
    return (
        f"<{tag}><position><point><x>{x}</x><y>{y}</y></point></position>"
        f"<orientation>{turned}</orientation><time>{step}</time>{more}</{tag}>"
    )


def obstacle(tag: str, ident: str, kind: str, shape: str, states: str) -> str:
    return f'<{tag} id="{ident}"><type>{kind}</type><shape>{shape}</shape>{states}</{tag}>\n'


def scenario(*parts: str, step: str = "0.04") -> str:
    inside = "".join(parts)
    return f'<?xml version="1.0"?>\n<commonRoad commonRoadVersion="2020a" timeStepSize="{step}">\n{inside}</commonRoad>'


BOX = "<rectangle><length>4</length><width>2</width></rectangle>"
AT_0 = state("initialState", "<exact>0</exact>", "0", "0")


def test_commonroad_boxes_in_steps(run: Runner) -> None:
    speed = "<velocity><exact>10</exact></velocity>"
    fast = "<velocity><intervalStart>8</intervalStart><intervalEnd>12</intervalEnd></velocity>"
    moved = state("state", "<exact>3</exact>", "0", "5", fast, "<exact>1.5707963267948966</exact>")
    shifted = (
        "<rectangle><length>4</length><width>2</width><orientation>0</orientation>"
        "<center><x>1</x><y>0</y></center></rectangle>"
    )
    beginning = state("initialState", "<intervalStart>1</intervalStart><intervalEnd>2</intervalEnd>", "0", "0", speed)
    found = run(
        "commonroad",
        run.file(
            "s.xml",
            scenario(
                "<lanelet id='5'/>",
                obstacle("dynamicObstacle", "42", "car", shifted, f"{beginning}<trajectory>{moved}</trajectory>"),
                obstacle("dynamicObstacle", "43", "pedestrian", "<circle><radius>0.3</radius></circle>", AT_0),
                obstacle(
                    "staticObstacle", "44", "parkedVehicle", BOX, AT_0.replace("<time><exact>0</exact></time>", "")
                ),
                "<planningProblem id='9'/>",
            ),
        ),
    )
    assert found.stamps_ns == [0, 40_000_000, 120_000_000]
    names = ("x_m", "y_m", "z_m", "yaw_rad", "vx_mps", "vy_mps", "length_m", "width_m", "height_m")
    first, second = found.values("42", *names)
    # The box is centred 1 m ahead of the obstacle's position: east of it first, north of it later.
    assert first == pytest.approx([1, 0, 0.75, 0, 10, 0, 4, 2, 1.5])
    assert second == pytest.approx([0, 6, 0.75, 1.5707963, 0, 10, 4, 2, 1.5])
    assert found.values("43", "length_m", "width_m", "height_m", "z_m") == [[0.6, 0.6, 1.75, 0.875]]
    assert not found.messages[0].moving_object[0].base.HasField("velocity")
    assert found.values("44", "x_m", "height_m") == [[0, 1.5]] * 3
    assert [found.moves(ident) for ident in ("42", "43", "44")] == [True, True, False]
    assert found.recording.host_id is None
    assert "note: 1 value of velocity given as an interval: the middle taken\n" in found.printed
    assert "note: 1 planningProblem has no body: no ego vehicle" in found.printed
    assert "note: flat world: boxes stand on z = 0, with the typical height of their class\n" in found.printed


def test_commonroad_what_is_skipped_is_said(run: Runner) -> None:
    corners = "".join(f"<point><x>{x}</x><y>{y}</y></point>" for x, y in ((0, 0), (6, 0), (6, 1), (0, 1)))
    region = (
        "<initialState><position><rectangle><length>1</length><width>1</width><orientation>0</orientation>"
        "<center><x>7</x><y>8</y></center></rectangle></position></initialState>"
    )
    nowhere = "<initialState><position><lanelet ref='5'/></position></initialState>"
    found = run(
        "commonroad",
        run.file(
            "s.xml",
            scenario(
                obstacle("staticObstacle", "1", "building", f"<polygon>{corners}</polygon>", AT_0),
                obstacle("staticObstacle", "2", "pillar", BOX, region),
                obstacle("staticObstacle", "3", "dragon", BOX, nowhere),
                obstacle("dynamicObstacle", "4", "car", BOX + BOX, AT_0),
                obstacle("dynamicObstacle", "5", "car", BOX, AT_0 + "<occupancySet/>"),
                "<environmentObstacle id='6'/><phantomObstacle id='7'/>",
            ),
        ),
    )
    assert found.stamps_ns == [0]
    assert found.values("1", "x_m", "y_m", "length_m", "width_m") == [[3, 0.5, 6, 1]]
    assert found.values("2", "x_m", "y_m", "yaw_rad") == [[7, 8, 0]]
    assert sorted(found.recording.scene.object_ids) == ["1", "2", "5"]
    for note in (
        "1 obstacle with a polygon as shape: the box around it taken",
        "1 state with a region as position: its centre taken",
        "1 state without orientation: 0 taken",
        "1 obstacle of the class name 'dragon', which says nothing: taken as other; --class 'dragon=car' says what it "
        "is",
        "1 state without a point as position: skipped",
        "1 obstacle with another shape than one rectangle, circle or polygon (rectangle, rectangle): skipped",
        "1 obstacle with an occupancySet: only its initial state taken",
        "1 environmentObstacle has no pose: skipped",
        "1 phantomObstacle is nowhere in particular: skipped",
    ):
        assert f"note: {note}\n" in found.printed


def lanelet(ident: str, left: str, right: str, *types: str) -> str:
    """Bounds as "x,y x,y"."""
    bounds = "".join(
        f"<{side}>{''.join('<point><x>{}</x><y>{}</y></point>'.format(*at.split(',')) for at in line.split())}</{side}>"
        for side, line in (("leftBound", left), ("rightBound", right))
    )
    return f'<lanelet id="{ident}">{bounds}{"".join(f"<laneletType>{one}</laneletType>" for one in types)}</lanelet>'


def test_commonroad_lanelets_are_lanes_and_crosswalks_are_areas(run: Runner) -> None:
    """Two lanelets of one street, driven against each other; 7 is a crossing by its intersection alone."""
    parts = (
        lanelet("5", "0,0 50,0", "0,-3 20,-4 50,-3", "urban"),
        lanelet("6", "50,0 0,0", "50,3 0,3"),
        lanelet("7", "10,3 10,-3", "8,3 8,-3", "sidewalk"),
        lanelet("8", "30,3 30,-3", "28,3 28,-3", "urban", "crosswalk"),
        lanelet("9", "0,3 50,3", "0,3 50,3", "bicycleLane"),
        lanelet("10", "0,3", "0,3 50,3"),
        '<intersection id="90"><incoming/><crossing><crossingLanelet ref="7"/></crossing></intersection>',
        obstacle("dynamicObstacle", "42", "car", BOX, AT_0),
    )
    found = run("commonroad", run.file("s.xml", scenario(*parts)))
    lanes = {lane.id: lane for lane in found.recording.lanes}
    assert {name: lane.kind for name, lane in lanes.items()} == {
        "5": "driving", "6": "driving", "7": "walking", "8": "walking", "9": "bicycle",
    }  # fmt: skip
    assert lanes["5"].right_m.tolist() == [[0, -3, 0], [20, -4, 0], [50, -3, 0]]
    assert lanes["6"].left_m.tolist() == [[50, 0, 0], [0, 0, 0]]
    areas = {area.name: set(area.rings_m[0]) for area in found.recording.scene.areas}
    assert areas == {
        "crosswalk 7": {(10, 3), (10, -3), (8, -3), (8, 3)}, "crosswalk 8": {(30, 3), (30, -3), (28, -3), (28, 3)},
    }  # fmt: skip
    for note in (
        "5 lanes of the scenario",
        "2 crosswalks among its lanes",
        "1 lanelet without two bounds of two points: left out",
    ):
        assert f"note: {note}\n" in found.printed


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (
            scenario(lanelet("5", "0,0 1e9,0", "0,-3 9,-3")),
            "s.xml:3: <lanelet>: expected numbers of at most 1e+08, found 1e+09",
        ),
        (
            scenario(lanelet("a", "0,0 9,0", "0,-3 9,-3")),
            "s.xml:3: expected <lanelet> with a whole number as id, found 'a'",
        ),
        (
            scenario("<intersection><crossing><crossingLanelet/></crossing></intersection>"),
            "s.xml:3: expected <crossingLanelet> with the attribute ref, found none",
        ),
        ("<fcd-export/>", "s.xml:1: expected <commonRoad>, found <fcd-export>"),
        (scenario(step="0"), "s.xml:2: expected timeStepSize in seconds (1e-6 to 1000), found '0'"),
        (scenario(step="x"), "s.xml:2: expected timeStepSize in seconds (1e-6 to 1000), found 'x'"),
        (scenario(), "s.xml: no object to convert in 1 frame"),
        (scenario("<obstacle id='1'/>"), "1 obstacle of a version before 2018b: skipped"),
        (
            scenario(obstacle("dynamicObstacle", "-1", "car", BOX, AT_0)),
            "s.xml:3: expected <dynamicObstacle> with a whole number as id, found '-1'",
        ),
        (
            scenario(obstacle("dynamicObstacle", "1", "car", BOX, "")),
            "s.xml:3: expected <dynamicObstacle> with an <initialState>, found none",
        ),
        (
            scenario(obstacle("dynamicObstacle", "1", "car", BOX.replace("4", "0"), AT_0)),
            "s.xml:3: length: expected a number above 0, found '0'",
        ),
        (
            scenario(obstacle("dynamicObstacle", "1", "car", "<circle/>", AT_0)),
            "s.xml:3: expected <circle> with <radius>, found nothing",
        ),
        (
            scenario(obstacle("dynamicObstacle", "1", "car", "<polygon/>", AT_0)),
            "s.xml:3: expected a polygon of at least 3 points, found 0",
        ),
        (
            scenario(obstacle("dynamicObstacle", "1", "car", BOX, AT_0.replace("<x>0", "<x>?"))),
            "s.xml:3: x: expected a number, found '?'",
        ),
        (
            scenario(
                obstacle("dynamicObstacle", "1", "car", BOX, state("initialState", "<exact>0.5</exact>", "0", "0"))
            ),
            "s.xml:3: time: expected a step of 0 to 10000000, found '0.5'",
        ),
    ],
)
def test_commonroad_refuses(run: Runner, text: str, line: str) -> None:
    assert line in run.refused("commonroad", run.file("s.xml", text))


SKIPPED = "1 object state with a number that is none: skipped"
NO_SIZE = "1 object state without a size, or with one that is none: that of its class taken"


@pytest.mark.parametrize("none", ["nan", "inf", "-inf", "1e308"])
@pytest.mark.parametrize(
    ("column", "note"), [("x_m", SKIPPED), ("y_m", SKIPPED), ("yaw_deg", SKIPPED), ("length_m", NO_SIZE)]
)
def test_csv_a_number_that_is_none_is_left_out_or_completed(run: Runner, none: str, column: str, note: str) -> None:
    cells = dict(zip(HEADER.split(","), ["0.2", "2", "car", "5", "0", "0", "4", "2"], strict=True)) | {column: none}
    found = run("csv", run.file("t.csv", f"{HEADER}\n{CAR}\n{','.join(cells.values())}\n"))
    assert f"note: {note}\n" in found.printed
    if note == NO_SIZE:
        assert found.values("2", "length_m", "width_m") == [[4.5, 2.0]]
    else:
        assert set(found.recording.scene.object_ids) == {"1"}


@pytest.mark.parametrize("none", ["nan", "inf", "-inf", "1e308"])
@pytest.mark.parametrize("leaf", ["x", "y", "angle", "z"])
def test_sumo_a_number_that_is_none_is_left_out(run: Runner, none: str, leaf: str) -> None:
    cells = {"x": "10", "y": "2", "angle": "90", "z": "0"}
    one, other = ('<vehicle id="{}" x="{x}" y="{y}" angle="{angle}" z="{z}"/>'.format(ident, **of)
                  for ident, of in (("a", cells), ("b", cells | {leaf: none})))  # fmt: skip
    found = run("sumo", run.file("f.xml", fcd(one + other)))
    assert f"note: {SKIPPED}\n" in found.printed
    assert set(found.names.values()) >= {"vehicle a"}
    assert len(found.recording.scene.object_ids) == 1


@pytest.mark.parametrize("none", ["nan", "inf", "-inf", "1e308"])
@pytest.mark.parametrize("leaf", ["x", "y", "turned", "speed"])
def test_commonroad_a_number_that_is_none_is_left_out_or_not_said(run: Runner, none: str, leaf: str) -> None:
    cells = {"x": "3", "y": "2", "turned": "0", "speed": "1"} | {leaf: none}
    speed = f"<velocity><exact>{cells['speed']}</exact></velocity>"
    turned = f"<exact>{cells['turned']}</exact>"
    odd = state("state", "<exact>1</exact>", cells["x"], cells["y"], speed, turned)
    text = scenario(obstacle("dynamicObstacle", "1", "car", BOX, f"{AT_0}<trajectory>{odd}</trajectory>"))
    found = run("commonroad", run.file("s.xml", text))
    assert (f"note: {SKIPPED}\n" in found.printed) == (leaf != "speed")
    assert len(found.values("1", "x_m")) == (2 if leaf == "speed" else 1)
    assert not any(m.moving_object[0].base.HasField("velocity") for m in found.messages if m.moving_object)


def test_csv_sizes_and_names_by_the_rules_of_all_that_is_read(run: Runner) -> None:
    table = f"{HEADER}\n0,1,Zorb,0,0,0,-4,2\n0,2,fire_truck,9,0,0,0,2\n0,3,bicycle_rack,9,9,0,4,2\n"
    found = run("csv", run.file("t.csv", table), "--class", "Zorb=van")
    assert [found.class_of(ident) for ident in "123"] == ["van", "truck", "other"]
    assert found.values("1", "length_m") == [[4.0]]
    assert found.values("2", "length_m") == [[8.0]]  # typical of a truck
    assert not found.moves("3")
    assert "note: 1 object state with a negative size: its amount taken\n" in found.printed
    assert "note: 1 object state without a size, or with one that is none: that of its class taken\n" in found.printed
    assert "Zorb" not in found.printed


@pytest.mark.parametrize("word", ["Zorb", "=car", "Zorb=zorb"])
def test_a_class_that_cannot_be_given(run: Runner, word: str) -> None:
    line = run.refused("csv", run.file("t.csv", f"{HEADER}\n{CAR}\n"), "--class", word)
    assert "--class: expected NAME=CLASS with a class of car, van, " in line
    assert line.endswith(f"found {word!r}")


# What all share ---------------------------------------------------------------------------------------------


def test_every_kind_is_of_the_class_its_name_says() -> None:
    from copem_replay.core.tracks import CLASSES
    from copem_replay.extras.convert.conversion import KINDS
    from copem_replay.io.schemas.osi_ground_truth import osi_class_index

    found = {name: CLASSES[osi_class_index(kind.type, kind.vehicle)] for name, kind in KINDS.items() if kind.moving}
    others = {
        "tractor": "truck",
        "scooter": "bicycle",
        "wheelchair": "pedestrian",
        "tram": "other",
        "train": "other",
        "work machine": "truck",
    }
    assert found == {name: others.get(name, name) for name in found}
    assert set(CLASSES) <= set(found)
    assert KINDS["vehicle"].type == MovingObject.TYPE_VEHICLE
