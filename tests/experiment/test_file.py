from __future__ import annotations

import math
import re
import shlex
import time
import tracemalloc
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel, ValidationError

from copem_replay.core import components
from copem_replay.core import yaml as plain_yaml
from copem_replay.core.components import Component
from copem_replay.core.errors import ExperimentError
from copem_replay.core.object_list import Entries
from copem_replay.core.tracks import Float
from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.experiment.file import (
    LIST_EXAMPLES,
    describe_by_key,
    log_paths,
    parse_experiment,
    place_identity,
    read_experiment_file,
)
from copem_replay.experiment.schema import Experiment
from copem_replay.fusion.interface import IdealFusion, Inbox, StepFusion
from copem_replay.fusion.tracker import Tracker
from copem_replay.perception.pem.detection import ConstantDetection, DetectionModel, VisibleShare
from copem_replay.perception.pem.error import ErrorModel
from tests.helpers.experiments import TEXT, changed, source_of

CONTRACT = """\
version: 1
logs: [tc016d.mcap]
ego: null
runs: 500
seed: 1
pems:
  onboard:
    - when: {range_m: [0, 100], azimuth_deg: [-180, 180], classes: [pedestrian, car, truck], visible_share: [0, 1]}
      detection: {kind: visible_share}
      error: {kind: gaussian, covariance_m2: [[1.0, 0.0], [0.0, 1.0]]}
  roadside:
    - detection: {kind: visible_share}
      error: {kind: gaussian, covariance_m2: [[1.0, 0.0], [0.0, 1.0]]}
units:
  ego:    {on: ego, height_m: 1.8, pem: onboard, rate_hz: null, phase_s: 0}
  rspu01: {at: [12.0, -4.5], yaw_deg: 90, height_m: 5.0, pem: roadside}
obstacles: [{polygon_m: [[0, 0], [4, 0], [4, 3], [0, 3]], height_m: 6.0}]
visibility: surface
configurations:
  GT:          {units: truth}
  PEM:         {units: [ego]}
  coPEM:0s:    {units: all, fusion: {kind: ideal}}
  coPEM:0.5s:  {units: all, fusion: {kind: ideal}, latency_s: 0.5}
  mixed:       {units: all, fusion: {kind: ideal}, latency_s: {ego: 0.0, default: 0.3}}
measure:
  objects: {classes: [pedestrian]}
  onset: {kind: starts_moving, speed_mps: 0.3, within_m: 20, from: front}
  count_earlier: false
  confirm: {hits: 1, of: 1}
  distance_to: ego
  horizon_s: 5
show: {logs: [first], run: 0}
"""
"""The contract's example, without what this version does not have."""


class Always(DetectionModel):
    sure: bool = True

    def probability(self, view: ViewGeometry) -> Float:
        return view.visible_share * 0 + 1


class NoModel(Component):
    pass


class Newest(StepFusion):
    """What the first unit says, and nobody else."""

    surely: bool = True

    def step(self, now_s: float, inbox: Inbox, memory: Any) -> tuple[Entries, Any]:
        return inbox.newest[0].entries, None


def experiment(folder: Path, text: str) -> Experiment:
    found, problems = parse_experiment(source_of(folder, text))
    assert problems == []
    assert found is not None
    return found


def problems(folder: Path, text: str) -> list[str]:
    """`line: key: message` of each problem."""
    source = source_of(folder, text)
    _, found = parse_experiment(source)
    start = f"{source.path}:"
    assert all(line.startswith(start) for line in found)
    return [line.removeprefix(start) for line in found]


def refusal(folder: Path, text: str | bytes) -> str:
    """`line: message` of a file that is no experiment file at all."""
    path = folder / "experiment.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ExperimentError) as error:
        read_experiment_file(path)
    (problem,) = error.value.problems
    assert problem.startswith(f"{path}:")
    return problem.removeprefix(f"{path}:")


WORDS = "on off yes no On NO y 1_000 1:30 2020-01-01 2020-13-45 = 1e 0b1 + . ..5 1.2.3 .e5 0o8 TRue nan"


class TestYaml:
    @pytest.mark.parametrize("word", WORDS.split())
    def test_is_text(self, word: str) -> None:
        assert plain_yaml.parse_yaml(f"key: {word}")[0] == {"key": word}
        assert plain_yaml.parse_yaml(f"{word}: 1")[0] == {word: 1}

    @pytest.mark.parametrize(
        ("word", "value"),
        [("~", None), ("", None), ("NULL", None), ("true", True), ("False", False), ("7", 7), ("-07", -7), ("0o17", 15),
         ("0x1F", 31), ("1.", 1.0), (".5", 0.5), ("-1e3", -1000.0), ("1E-2", 0.01), ("-.inf", -math.inf),
         ("!!int '7'", 7), ("!!str 7", "7"), ("'7'", "7"), ('"on"', "on"), ("!!float 7", 7)],
    )  # fmt: skip
    def test_is_not_text(self, word: str, value: object) -> None:
        (found,) = plain_yaml.parse_yaml(f"key: {word}")[0].values()
        assert found == value
        assert type(found) is type(value)

    def test_old_yaml_by_directive_reads_the_same(self) -> None:
        assert plain_yaml.parse_yaml("%YAML 1.1\n---\nkey: [on, 1_000, 010]")[0] == {"key": ["on", "1_000", 10]}

    def test_not_a_number_is_one(self) -> None:
        assert math.isnan(plain_yaml.parse_yaml("key: .NaN")[0]["key"])

    def test_a_number_longer_than_python_reads_is_text(self) -> None:
        assert isinstance(plain_yaml.parse_yaml("key: " + "9" * 5000)[0]["key"], str)

    def test_byte_order_mark(self, tmp_path: Path) -> None:
        assert experiment(tmp_path, "\ufeff" + TEXT) == experiment(tmp_path, TEXT)

    def test_windows_line_ends(self, tmp_path: Path) -> None:
        (tmp_path / "experiment.yaml").write_bytes(changed("runs: x").replace("\n", "\r\n").encode())
        assert "experiment.yaml:3: runs" in parse_experiment(read_experiment_file(tmp_path / "experiment.yaml"))[1][0]

    def test_every_key_has_its_line(self) -> None:
        data, lines, found = plain_yaml.parse_yaml("a:\n  - b: 1\n    c: 2\n  - [3,\n     4]\n")
        assert data == {"a": [{"b": 1, "c": 2}, [3, 4]]}
        assert found == []
        at_a = {("a",): 1, ("a", 0): 2, ("a", 0, "b"): 2, ("a", 0, "c"): 3, ("a", 1): 4, ("a", 1, 0): 4, ("a", 1, 1): 5}
        assert lines == {(): 1} | at_a

    def test_anchors(self, tmp_path: Path) -> None:
        text = TEXT.replace("  onboard:\n", "  roadside: &model\n").replace(
            "units:\n", "  onboard: *model\nunits:\n", 1
        )
        assert experiment(tmp_path, text).pems["onboard"] == experiment(tmp_path, text).pems["roadside"]

    def test_an_anchor_name_may_be_used_again(self) -> None:
        assert plain_yaml.parse_yaml("a: &x 1\nb: &x 2\nc: *x")[0] == {"a": 1, "b": 2, "c": 2}

    @given(st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
        max_leaves=8,
    ))  # fmt: skip
    def test_what_is_written_is_read(self, value: Any) -> None:
        data, _, found = plain_yaml.parse_yaml(plain_yaml.dump_yaml({"key": value}))
        assert found == []
        assert data == {"key": as_read(value)}

    def test_a_list_goes_on_in_the_next_line_past_110_characters(self) -> None:
        assert plain_yaml.dump_yaml({"a": [10] * 28}) == "a: [" + "10, " * 26 + "10,\n  10]\n"


def as_read(value: Any) -> Any:
    """Keys that are numbers are text, whichever way they were written: there is nothing else to expect."""
    if isinstance(value, dict):
        return {str(name): as_read(inner) for name, inner in value.items()}
    return [as_read(inner) for inner in value] if isinstance(value, list) else value


class TestNotAnExperimentFile:
    @pytest.mark.parametrize(
        ("text", "expected"),
        [
            ("", "1: expected keys and values such as `version: 1`, found an empty file"),
            ("# nothing\n", "1: expected keys and values such as `version: 1`, found an empty file"),
            ("- version: 1\n", "1: expected keys and values such as `version: 1`, found a list"),
            ("version 1\n", "1: expected keys and values such as `version: 1`, found text"),
            ("version: 1\n\tlogs: []\n", "2: not YAML: found a tab where only spaces may stand; indent with spaces"),
            ("a:\n  b: 1\n\tc: 2\n", "3: not YAML: found a tab where only spaces may stand; indent with spaces"),
            ("a: [1, 2\nb: 3\n", "2: not YAML: expected ',' or ']', but got ':'"),
            ("a: 'x\n", "2: not YAML: found unexpected end of stream"),
            ("a: *b\n", "1: not YAML: found undefined alias 'b'"),
            ("a: b: c\n", "1: not YAML: mapping values are not allowed here"),
            ("a: 1\n---\nb: 2\n", "2: not YAML: expected a single document in the stream but found another document"),
            ("a: 1\nb: \x07\n", r"2: not YAML: character '\x07' is not allowed"),
            (b"\x89MCAP0\r\n", "1: expected YAML text in UTF-8, found byte 0x89"),
            ("a: 1\nb: ü\n".encode("latin-1"), "2: expected YAML text in UTF-8, found byte 0xfc"),
            ("version: 1".encode("utf-16"), "1: expected YAML text in UTF-8, found byte 0xff"),
            ("[" * 5000, "1: not YAML: nested too deeply"),
        ],
    )  # fmt: skip
    def test_is_said_in_a_line(self, tmp_path: Path, text: str | bytes, expected: str) -> None:
        assert refusal(tmp_path, text) == expected

    def test_absent(self, tmp_path: Path) -> None:
        with pytest.raises(ExperimentError, match=r"^.*/none\.yaml: no such file$"):
            read_experiment_file(tmp_path / "none.yaml")

    @pytest.mark.parametrize("name", ["my drive.mcap", "drive.osi", "bag"])
    def test_recording(self, tmp_path: Path, name: str) -> None:
        """Of a command that takes experiments: it is said what makes one."""
        path = tmp_path / name
        if name == "bag":
            path.mkdir()
            (path / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
        else:
            path.write_bytes(b"\x89MCAP0\r\n")
        with pytest.raises(ExperimentError) as refused:
            read_experiment_file(path)
        (problem,) = refused.value.problems
        makes = f"`copem-replay init {shlex.quote(str(path))} > experiment.yaml` makes one that replays it"
        assert problem.endswith(f"; {makes}")
        assert "expected an experiment file (YAML)" in problem

    def test_folder(self, tmp_path: Path) -> None:
        with pytest.raises(ExperimentError, match="is a folder; expected an experiment file"):
            read_experiment_file(tmp_path)

    def test_name_that_is_too_long(self, tmp_path: Path) -> None:
        with pytest.raises(ExperimentError, match=r"cannot be read: File name too long$"):
            read_experiment_file(tmp_path / ("x" * 300))


class TestStrangeYaml:
    """Legal YAML that has no place in an experiment file: the rest of the file is checked all the same."""

    def test_key_twice(self, tmp_path: Path) -> None:
        text = TEXT.replace("seed: 1\n", "seed: 1\nruns: 5\n").replace("  PEM:", "  GT:")
        assert problems(tmp_path, text) == ["5: runs: key given twice", "16: configurations.GT: key given twice"]

    def test_key_twice_as_number_and_text(self, tmp_path: Path) -> None:
        text = TEXT.replace("  PEM:", "  1: {units: truth}\n  '1':")
        assert problems(tmp_path, text) == ["16: configurations.1: key given twice"]

    def test_merge_key(self, tmp_path: Path) -> None:
        text = TEXT.replace("ego: {on", "ego: &e {on").replace("mast: {", "mast: {<<: *e, ")
        (problem,) = problems(tmp_path, text)
        assert problem == "12: units.mast.<<: not in YAML 1.2: write out the keys, or use an alias for all of them"

    def test_something_that_holds_itself(self, tmp_path: Path) -> None:
        found = problems(tmp_path, changed("logs: &logs [*logs]"))
        assert found[0] == "2: logs[0]: an alias of something that holds it"

    @pytest.mark.parametrize(
        "inner", ["[*{0}, *{0}, *{0}, *{0}, *{0}, *{0}, *{0}, *{0}, *{0}, *{0}]", "{{a: *{0}, b: *{0}}}"]
    )
    def test_aliases_of_aliases_of_aliases(self, tmp_path: Path, inner: str) -> None:
        """Ten of ten, ten times over, are ten thousand million values; two of two, forty times, a million million."""
        depth = 10 if inner.startswith("[") else 40
        bomb = "".join(f"a{k + 1}: &a{k + 1} {inner.format(f'a{k}')}\n" for k in range(depth))
        tracemalloc.start()
        try:
            said = refusal(tmp_path, "a0: &a0 [lol]\n" + bomb)
            assert tracemalloc.get_traced_memory()[1] < 200e6
        finally:
            tracemalloc.stop()
        assert re.fullmatch(
            r"\d+: expected aliases that stand for at most 200000 characters and values in all, found more .*", said
        )

    def test_a_long_text_that_is_repeated(self, tmp_path: Path) -> None:
        said = refusal(tmp_path, f"a: &a {'x' * 50_000}\nb: [*a, *a, *a, *a]\n")
        assert said.startswith("1: expected aliases that stand for at most 200000 characters")

    def test_a_couple_that_a_hundred_pems_share(self, tmp_path: Path) -> None:
        first, _, rest = TEXT.partition("units:")
        pems = "".join(f"  p{k}: *shared\n" for k in range(100))
        shared = first.replace("  onboard:\n", "  onboard: &shared\n") + pems + "units:" + rest
        found = experiment(tmp_path, shared)
        assert len(found.pems) == 101
        assert found.pems["p99"] == found.pems["onboard"]

    @pytest.mark.parametrize("key", ["[1, 2]", "{a: 1}"])
    def test_key_that_is_no_scalar(self, tmp_path: Path, key: str) -> None:
        expected = "19: expected text or a number as a key, found a list or keys and values"
        assert problems(tmp_path, TEXT + f"? {key}\n: 1\n") == [expected]

    @pytest.mark.parametrize("tag", ["!mine", "!!binary", "!!python/object:os.system"])
    def test_unknown_tag(self, tmp_path: Path, tag: str) -> None:
        (problem,) = problems(tmp_path, TEXT + f"ego: {tag} abcd\n")
        assert problem.startswith("19: ego: tag ")

    def test_half_a_character(self, tmp_path: Path) -> None:
        """It can be written in YAML, and nowhere else."""
        assert problems(tmp_path, TEXT + 'ego: "\\ud83d"\n') == ["19: ego: half a character (a surrogate)"]

    def test_a_path_of_half_a_character_is_itself(self) -> None:
        assert place_identity(Path("\ud83d")) == "\ud83d"

    @pytest.mark.parametrize("tag", ["int", "float", "bool", "null", "timestamp"])
    def test_tag_that_does_not_fit_its_text(self, tmp_path: Path, tag: str) -> None:
        assert experiment(tmp_path, TEXT + f"ego: !!{tag} abcd\n").ego == "abcd"


class TestIds:
    def test_numbers_are_text(self, tmp_path: Path) -> None:
        text = changed("  ego: {on: 67, height_m: 1.8, pem: 5}", "  mast: {at: [0, 0], height_m: 1, pem: '5'}")
        text = text.replace("onboard:", "5:").replace("[ego]", "[ego, 8]")
        text = text.replace("configurations:", "  8: {on: 12, height_m: 1, pem: 5}\nconfigurations:", 1)
        text += "ego: 18446744073709551615\n"
        text = text.replace("measure: {", "measure: {objects: {ids: [7, '12']}, distance_to: 8, ")
        found = experiment(tmp_path, text)
        assert found.ego == "18446744073709551615"
        assert found.units["ego"].on == "67"
        assert found.units["8"].pem == "5"
        assert list(found.pems) == ["5"]
        assert found.configurations["PEM"].units == ("ego", "8")
        assert found.measure.objects.ids == ("7", "12")
        assert found.measure.distance_to == "8"

    @pytest.mark.parametrize(("value", "said"), [("1.0", "1.0"), ("true", "true"), ("[1]", "[1]")])
    def test_are_nothing_else(self, tmp_path: Path, value: str, said: str) -> None:
        assert problems(tmp_path, TEXT + f"ego: {value}\n") == [f"19: ego: expected text, found {said}"]


TOP = "%s", ""
WHEN = "    - when: {%s}", "7: pems.onboard[0].when"
DETECTION = "      detection: {%s}", "8: pems.onboard[0].detection"
ERROR = "      error: {%s}", "9: pems.onboard[0].error"
EXISTENCE = (
    "      error: {kind: gaussian, covariance_m2: [[1, 0], [0, 1]]}\n      existence: %s",
    "10: pems.onboard[0].existence",
)
UNIT = "  ego: {%s}", "11: units.ego"
MAST = "  mast: {%s}", "12: units.mast"
PEM = "  PEM: %s", "15: configurations.PEM"
COPEM = "  coPEM: {units: all, %s}", "16: configurations.coPEM"
MEASURE = "measure: {%s}", "17: measure"
SHOW = "show: %s", "18: show"
OBSTACLES = "obstacles: %s", "19: obstacles"
BRAKING = "braking: %s", "19: braking"
DRIVER = "braking: {driver: {%s}}", "19: braking.driver"
SWEEP = "sweep: %s", "19: sweep"
"""What a line looks like, and how a problem with it begins."""

KEYS = (
    "areas, braking, configurations, criteria, ego, frame, links, logs, maps, max_gap_s, measure, obstacles, pems, "
    "read, runs, seed, show, sweep, tags, units, version, visibility, window_s"
)
CLASSES = "pedestrian, bicycle, motorcycle, car, van, truck, bus, trailer, animal, other, vehicle, vru, vehicles"
FUSIONS = "ideal, union, nms, gnn, tracker"
ONSETS = "starts_moving, appears, in_range, line_of_sight, line_of_sight_any, at"
KINDS = "expected {kind: …}, kind one of visible_share, constant, table; found "
CORNERS = "expected the corners in order around an area, each once"
IN_PLANE = "expected two numbers, in the plane"
HOW_MANY = "expected how many units beside the ego's, such as 2 (a count, no names)"
SEEDS = st.integers(-(2**63), 2**64 - 1)
SEED = "4: seed: expected a whole number of 64 bits (-2^63 … 2^64 - 1), found "
A_TURN = "expected degrees from -360 to 360"
EITHER = "expected one of `pem: <name>`, `recorded: {topic: …}` and `fuses: [<unit>, …]`"
RECORDED = "recorded: goes with one place, `on` an object or `at` a point, and without rate_hz"
PLACE = (
    "expected one of `on: ego`, `on: <object id>`, `on: {classes, penetration_rate}`, `at: [x, y]` and "
    "`at_wgs84: [latitude, longitude]`"
)
CASES = [
    (TOP, "version: 2", "1: version: expected 1, found 2"),
    (TOP, "version: '1'", "1: version: expected 1, found '1'"),
    (TOP, "version: true", "1: version: expected 1, found true"),
    (TOP, "logs: drive.mcap", "2: logs: expected a list, found 'drive.mcap'; such as `logs: [drive.mcap]`"),
    (TOP, "logs: []", "2: logs: expected at least 1 in the list, found []"),
    (TOP, "logs: [drive.mcap, 5]", "2: logs[1]: expected text, found 5"),
    (TOP, "runs: 0", "3: runs: expected at least 1, found 0"),
    (TOP, "runs: 1000000000000", "3: runs: expected at most 1e+09, found 1000000000000"),
    (TOP, "runs: 2.0", "3: runs: expected a whole number, found 2.0"),
    (TOP, "runs: yes", "3: runs: expected a whole number, found 'yes'"),
    (TOP, "runs: true", "3: runs: expected a whole number, found true"),
    (TOP, "runs:", "3: runs: expected a whole number, found nothing"),
    (TOP, "seed: 1_000", "4: seed: expected a whole number, found '1_000'"),
    (TOP, "seed: 18446744073709551616", SEED + "18446744073709551616"),
    (TOP, "seed: -9223372036854775809", SEED + "-9223372036854775809"),
    (TOP, "read: {topic: 5}", "19: read.topic: expected text, found 5"),
    (TOP, "window_s: [2, 1]", "19: window_s: expected [from, to], found one that ends (1 s) before it begins (2 s)"),
    (TOP, "window_s: [-1, 1]", "19: window_s[0]: expected at least 0, found -1"),
    (TOP, "window_s: [0, .inf]", "19: window_s[1]: expected a finite number, found inf"),
    (TOP, "window_s: [0, '9']", "19: window_s[1]: expected a number, found '9'"),
    (TOP, "window_s: [0]", "19: window_s[1]: missing"),
    (TOP, "window_s: [0, 1, 2]", "19: window_s: expected at most 2 in the list, found [0, 1, 2]"),
    (TOP, "window_s: 5", "19: window_s: expected a list, found 5; such as `window_s: [0, 20]`"),
    (TOP, "max_gap_s: 0", "19: max_gap_s: expected more than 0, found 0"),
    (TOP, "max_gap_s: .inf", "19: max_gap_s: expected a finite number, found inf"),
    (TOP, "max_gap_s: .nan", "19: max_gap_s: expected a finite number, found nan"),
    (TOP, "max_gap_s: 1e300", "19: max_gap_s: expected at most 1e+12, found 1e+300"),
    (TOP, "visibility: curved", "19: visibility: expected 'surface' or 'flat', found 'curved'"),
    (TOP, "unit: {}", "19: unit: unknown key; did you mean units?"),
    (TOP, "Runs: 5", "19: Runs: unknown key; did you mean runs?"),
    (TOP, "on: 5", f"19: on: unknown key; known here: {KEYS}"),
    (TOP, "'': 5", f"19: '': unknown key; known here: {KEYS}"),
    (WHEN, "range_m: [5, 1]", ".range_m: expected [from, to] with from ≤ to, found [5.0, 1.0]"),
    (WHEN, "range_m: [-1, 1]", ".range_m[0]: expected at least 0, found -1"),
    (WHEN, "range_m: [0, 1, 2]", ".range_m: expected at most 2 in the list, found [0, 1, 2]"),
    (WHEN, "range: [0, 1]", ".range: unknown key; did you mean range_m?"),
    (WHEN, "azimuth_deg: [1]", ".azimuth_deg[1]: missing"),
    (WHEN, "azimuth_deg: [-400, 60]", f".azimuth_deg: {A_TURN}, found -400 (through 0: [350, 10])"),
    (WHEN, "azimuth_deg: [0, 360.5]", f".azimuth_deg: {A_TURN}, found 360.5 (through 0: [350, 10])"),
    (WHEN, "range_m: 80", ".range_m: expected a list, found 80; such as `range_m: [0, 80]`"),
    (WHEN, "classes: car", ".classes: expected a list, found 'car'; such as `classes: [vru]`"),
    (WHEN, "classes: []", ".classes: expected at least 1 in the list, found []"),
    (WHEN, "classes: [car, cow]", f".classes[1]: expected one of {CLASSES}; found 'cow'"),
    (WHEN, "visible_share: [0, 2]", ".visible_share[1]: expected at most 1, found 2"),
    (DETECTION, "", f": {KINDS}{{}}"),
    (DETECTION, "kind: 5", f": {KINDS}{{'kind': 5}}"),
    (DETECTION, "kind: sure",
     ": kind: expected one of visible_share, constant, table, or package.module:Class; found 'sure'"),
    (DETECTION, "kind: constant", ".probability: missing"),
    (DETECTION, "kind: constant, probability: 2", ".probability: expected at most 1, found 2"),
    (DETECTION, "kind: constant, probability: 1, p: 2", ".p: unknown key; known here: kind, probability"),
    (DETECTION, "kind: table, range_m: [9, 0], probability: [[1], [0]]",
     ": range_m: expected increasing values, found [9.0, 0.0]"),
    (DETECTION, "kind: table, range_m: [0, 9], probability: [[1]]",
     ": probability: expected 2 rows (range_m) of 1 values (visible_share), found 1 rows of [1]"),
    (DETECTION, "kind: table, range_m: [], probability: [[1]]",
     ".range_m: expected at least 1 in the list, found []"),
    (DETECTION, "kind: table, probability: []",
     ": probability: expected 1 rows (range_m) of 1 values (visible_share), found 0 rows of []"),
    (ERROR, "kind: gaussian", ".covariance_m2: missing"),
    (ERROR, "kind: gaussian, covariance_m2: [[1, 0], [0, 1]], sigma_m: 0.5",
     ".sigma_m: unknown key; `covariance_m2: [[0.25, 0], [0, 0.25]]` says it"),
    (ERROR, "kind: gaussian, sigma_m: [1, 2]",
     ".covariance_m2: missing",
     ".sigma_m: unknown key; `covariance_m2: [[σ², 0], [0, σ²]]` says it"),
    (ERROR, "kind: gaussian, covariance_m2: [1, 2]",
     ".covariance_m2[0]: expected a list, found 1",
     ".covariance_m2[1]: expected a list, found 2"),
    (ERROR, "kind: gaussian, covariance_m2: [[1, 2], [0, 1]]",
     ".covariance_m2: expected a symmetric matrix, found 2.0 and 0.0 off the diagonal"),
    (ERROR, "kind: gaussian, covariance_m2: [[1, 2], [2, 1]]",
     ".covariance_m2: expected a positive semi-definite matrix, found [[1.0, 2.0], [2.0, 1.0]]"),
    (ERROR, "kind: gaussian, covariance_m2: [[1e308, 0], [0, 1]]",
     ".covariance_m2[0][0]: expected at most 1e+12, found 1e+308"),
    (ERROR, "kind: gaussian, covariance_m2: [[1, 0], [0, 1]], frame: body",
     ".frame: expected 'absolute' or 'line_of_sight', found 'body'"),
    (EXISTENCE, "1.5", ": expected at most 1, or 'visible_share', found 1.5"),
    (EXISTENCE, "sure", ": expected a number, or 'visible_share', found 'sure'"),
    (UNIT, "on: ego", f": {EITHER}"),
    (UNIT, "on: ego, pem: onboard, recorded: {topic: lists}", f": {EITHER}"),
    (UNIT, "recorded: {topic: lists}, rate_hz: 5", f": {RECORDED}"),
    (UNIT, "recorded: {topic: lists}, on: ego, at: [1, 2]", f": {RECORDED}"),
    (UNIT, "recorded: {topic: lists}, on: {classes: [car], penetration_rate: 0.5}", f": {RECORDED}"),
    (UNIT, "recorded: lists", ".recorded: expected keys and values, found 'lists'"),
    (UNIT, "recorded: {}", ".recorded.topic: missing"),
    (UNIT, "recorded: {topic: lists, delay: 1}", ".recorded.delay: unknown key; did you mean delay_s?"),
    (UNIT, "recorded: {topic: lists, delay_s: -1, existence: 1.5, covariance_m2: [[1, 2], [2, 1]]}",
     ".recorded.delay_s: expected at least 0, found -1",
     ".recorded.covariance_m2: expected a positive semi-definite matrix, found [[1.0, 2.0], [2.0, 1.0]]",
     ".recorded.existence: expected at most 1, found 1.5"),
    (UNIT, "recorded: {topic: lists, existence: visible_share}",
     ".recorded.existence: expected a number, found 'visible_share'"),
    (UNIT, "height_m: 1, pem: onboard", f": {PLACE}"),
    (UNIT, "on: ego, at: [0, 0], height_m: 1, pem: onboard", f": {PLACE}"),
    (UNIT, "on: ego, height_m: 1, pem: onboard, ground_z_m: 0",
     ": ground_z_m: only for a unit `at` a place; a carrier brings its own ground"),
    (UNIT, "on: ego, height_m: 1, pem: onboard, phase_s: 1",
     ": phase_s: needs rate_hz (without it there is one list per frame of the truth)"),
    (UNIT, "on: ego, height_m: 1, pem: onboard, rate_hz: 0", ".rate_hz: expected at least 0.001, found 0"),
    (UNIT, "on: ego, height_m: 1, pem: onboard, rate_hz: 1e9", ".rate_hz: expected at most 1000, found 1000000000.0"),
    (UNIT, "on: ego, height: 1, pem: onboard", ".height: unknown key; did you mean height_m?"),
    (UNIT, "at: [0, 0], pem: onboard",
     ": height_m: needed for a unit `at` a place; only a carried one is on a roof by default"),
    (UNIT, "on: {classes: [cra], penetration_rate: 2}, pem: onboard",
     ".on.classes[0]: expected one of pedestrian, bicycle, motorcycle, car, van, truck, bus, trailer, animal, other, "
     "vehicle, vru, vehicles; found 'cra'",
     ".on.penetration_rate: expected at most 1, found 2"),
    (UNIT, "on: {classes: [car]}, pem: onboard", ".on.penetration_rate: missing"),
    (UNIT, "on: {classes: [car], penetration_rate: 30}, pem: onboard",
     ".on.penetration_rate: expected at most 1, found 30; a fraction: 30 % is 0.3"),
    (UNIT, "on: {classes: [car], penetration_rate: 300}, pem: onboard",
     ".on.penetration_rate: expected at most 1, found 300"),
    (UNIT, "on: [1], pem: onboard", ".on: expected text, found [1]"),
    (UNIT, "on: ego, height_m: -1, pem: onboard", ".height_m: expected at least 0, found -1"),
    (UNIT, "on: ego, height_m: '1', pem: onboard", ".height_m: expected a number, found '1'"),
    (MAST, "at: [0], height_m: 1, pem: onboard", ".at[1]: missing"),
    (MAST, "at: [12.0, -4.5, 5.0], height_m: 1, pem: onboard",
     f".at: {IN_PLANE}, found [12.0, -4.5, 5.0]; the height above ground is `height_m`"),
    (UNIT, "on: ego, offset_m: [1, 0, 2], pem: onboard",
     f".offset_m: {IN_PLANE}, found [1, 0, 2]; the height above ground is `height_m`"),
    (MAST, "at: [1, 2, 3, 4], height_m: 1, pem: onboard", ".at: expected at most 2 in the list, found [1, 2, 3, 4]"),
    (MAST, "at: [a, 1e300], height_m: 1, pem: onboard",
     ".at[0]: expected a number, found 'a'",
     ".at[1]: expected at most 1e+12, found 1e+300"),
    (MAST, "at: 5, height_m: 1, pem: onboard", ".at: expected a list, found 5; such as `at: [0, 0]`"),
    (BRAKING, "{}", ".driver: missing"),
    (BRAKING, "{driver: hard}",
     ".driver: expected {kind: …}, kind one of constant_deceleration; found 'hard'"),
    (BRAKING, "{driver: {kind: constant_deceleration, a_max_mps2: 8}, margin: 1}",
     ".margin: unknown key; did you mean margin_m?"),
    (BRAKING, "{driver: {kind: constant_deceleration, a_max_mps2: 8}, ego: frozen}",
     ".ego: expected 'recorded' or 'constant_speed', found 'frozen'"),
    (DRIVER, "kind: constant_deceleration", ".a_max_mps2: missing"),
    (DRIVER, "kind: constant_deceleration, a_max_mps2: 0", ".a_max_mps2: expected at least 0.01, found 0"),
    (DRIVER, "kind: constant_deceleration, a_max_mps2: 8, build_up_s: 0.01",
     ".build_up_s: expected 0, or at least 0.05 s (braking is worked out every 10 ms), found 0.01"),
    (BRAKING, "{driver: {kind: constant_deceleration, a_max_mps2: 8}, margin_m: 1000}",
     ".margin_m: expected at most 100, found 1000"),
    (DRIVER, "kind: constant_deceleration, a_max_mps2: 8, reaction: {kind: gama, shape: 1, mean_s: 1}",
     ".reaction: kind: expected one of constant, gamma, lognormal, or package.module:Class; found 'gama'; "
     "did you mean gamma?"),
    (DRIVER, "kind: constant_deceleration, a_max_mps2: 8, reaction: {kind: gamma, shape: 1}",
     ".reaction.mean_s: missing"),
    (MEASURE, "conflict: {horizon_s: 0}", ".conflict.horizon_s: expected more than 0, found 0"),
    (MEASURE, "exact: yes", ".exact: expected true or false, found 'yes'"),
    (SWEEP, "{}",
     ": expected values of latency_s, rate_hz, units, penetration_rate, correlation_s, ghosts_in_list, loss or "
     "burst_s, such as `latency_s: [0, 0.5, 1]`"),
    (SWEEP, "{latency_s: 1}", ".latency_s: expected a list, found 1"),
    (SWEEP, "{units: [1.5, -1]}",
     ".units[0]: expected a whole number, found 1.5",
     ".units[1]: expected at least 0, found -1"),
    (SWEEP, "{units: [ego, 2]}", f".units[0]: {HOW_MANY}, found 'ego'"),
    (SWEEP, "{units: [1, [ego, mast]]}", f".units[1]: {HOW_MANY}, found ['ego', 'mast']"),
    (SWEEP, "{penetration_rate: [0, 50]}",
     ".penetration_rate[1]: expected at most 1, found 50; a fraction: 50 % is 0.5"),
    (SWEEP, "{latency: [1]}", ".latency: unknown key; did you mean latency_s?"),
    (PEM, "", ": expected keys and values, found nothing"),
    (PEM, "{}", ": units: missing (or `recorded: {topic: …}`, a stack's own output)"),
    (PEM, "{units: ego}", ".units: expected 'truth' or 'all', or a list, found 'ego'"),
    (PEM, "{units: []}", ".units: expected 'truth' or 'all', or at least 1 in the list, found []"),
    (PEM, "{units: [ego, {a: 1}]}", ".units[1]: expected text, found {'a': 1}"),
    (COPEM, "latency_s: soon", ".latency_s: expected a number, or keys and values, found 'soon'"),
    (COPEM, "latency_s: -1", ".latency_s: expected at least 0, or keys and values, found -1"),
    (COPEM, "latency_s: 1e9", ".latency_s: expected at most 86400, or keys and values, found 1000000000.0"),
    (COPEM, "latency_s: {ego: -1, mast: x}",
     ".latency_s.ego: expected at least 0, found -1",
     ".latency_s.mast: expected a number, found 'x'"),
    (COPEM, "latncy_s: 1", ".latncy_s: unknown key; did you mean latency_s?"),
    (COPEM, "latency_ms: 500", ".latency_ms: unknown key; did you mean latency_s? (in s, not ms)"),
    (COPEM, "fusion: ideal", f".fusion: expected {{kind: …}}, kind one of {FUSIONS}; found 'ideal'"),
    (COPEM, "fusion: {kind: real}",
     f".fusion: kind: expected one of {FUSIONS}, or package.module:Class; found 'real'; did you mean ideal?"),
    (COPEM, "fusion: {combine: mean}", ".fusion.combine: expected 'samples' or 'posterior', found 'mean'"),
    (COPEM, "fusion: {colour: red}", ".fusion.colour: unknown key; known here: combine, kind, memory"),
    (COPEM, "fusion: {kind: ideal, colour: red}", ".fusion.colour: unknown key; known here: combine, kind, memory"),
    (COPEM, "fusion: {kind: 5}", f".fusion: expected {{kind: …}}, kind one of {FUSIONS}; found {{'kind': 5}}"),
    (COPEM, "fusion: null", f".fusion: expected {{kind: …}}, kind one of {FUSIONS}; found nothing"),
    (COPEM, "fusion: {kind: union, combine: samples}",
     ".fusion.combine: unknown key; known here: kind, min_existence"),
    (COPEM, "fusion: {kind: union, min_existence: 2}", ".fusion.min_existence: expected at most 1, found 2"),
    (COPEM, "fusion: {kind: nms, by: size}", ".fusion.by: expected 'iou' or 'centre', found 'size'"),
    (COPEM, "fusion: {kind: nms, radius: 2}", ".fusion.radius: unknown key; did you mean radius_m?"),
    (COPEM, "fusion: {kind: gnn, combine: samples}",
     ".fusion.combine: expected 'inverse_variance', 'covariance_intersection', 'fast_covariance_intersection', "
     "'inverse_covariance_intersection', 'split_covariance_intersection', 'cross_covariance' or 'covariance_union', "
     "found 'samples'"),
    (COPEM, "fusion: {kind: gnn, correlation: 0.5}",
     ".fusion: correlation: expected only with combine: cross_covariance, found with inverse_variance"),
    (COPEM, "fusion: {kind: gnn, combine: cross_covariance, correlation: 1}",
     ".fusion.correlation: expected less than 1, found 1"),
    (COPEM, "fusion: {kind: tracker, common_share: 2}", ".fusion.common_share: expected at most 1, found 2"),
    (COPEM, "fusion: {kind: gnn, gate: 1}", ".fusion.gate: expected less than 1, found 1"),
    (COPEM, "fusion: {kind: tracker, late: never}",
     ".fusion.late: expected 'stale', 'predict' or 'replay', found 'never'"),
    (COPEM, "fusion: {kind: tracker, forget_s: 0, publish: 2, confirm_s: -1}",
     ".fusion.forget_s: expected more than 0, found 0",
     ".fusion.publish: expected at most 1, found 2",
     ".fusion.confirm_s: expected at least 0, found -1"),
    (COPEM, "fusion: {kind: tracker, publish: 0.1, drop: 0.5}",
     ".fusion: drop: expected at most publish (0.1), found 0.5"),
    (TOP, "measure: []", "17: measure: expected keys and values, found []"),
    (MEASURE, "objects: {classes: [car], ids: [1]}", ".objects: expected either classes or ids, found both"),
    (MEASURE, "objects: {ids: []}", ".objects.ids: expected at least 1 in the list, found []"),
    (MEASURE, "onset: in_range", f".onset: expected {{kind: …}}, kind one of {ONSETS}; found 'in_range'"),
    (MEASURE, "onset: {}", f".onset: expected {{kind: …}}, kind one of {ONSETS}; found {{}}"),
    (MEASURE, "onset: {kind: soon}", f".onset: kind: expected one of {ONSETS}, or package.module:Class; found 'soon'"),
    (MEASURE, "onset: {kind: at}", ".onset.time_s: missing"),
    (MEASURE, "onset: {kind: in_range, range: 5}", ".onset.range: unknown key; did you mean range_m?"),
    (MEASURE, "onset: {kind: at, time_s: 1, colour: 5}", ".onset.colour: unknown key; known here: kind, time_s"),
    (MEASURE, "onset: {kind: starts_moving, from: side}", ".onset.from: expected 'centre' or 'front', found 'side'"),
    (MEASURE, "onset: {kind: starts_moving, from_: front}", ".onset.from_: unknown key; did you mean from?"),
    (MEASURE, "onset: {kind: line_of_sight, visible_share: 0}",
     ".onset.visible_share: expected more than 0, found 0"),
    (MEASURE, "count_earlier: yes", ".count_earlier: expected true or false, found 'yes'"),
    (MEASURE, "confirm: {hits: 3, of: 2}", ".confirm: expected hits ≤ of, found 3 of 2"),
    (MEASURE, "confirm: {hits: 0}", ".confirm.hits: expected at least 1, found 0"),
    (MEASURE, "began: [crossd]",
     ".began[0]: no way to begin is named 'crossd'; did you mean crossed? (of log_start, appeared, crossed)"),
    (MEASURE, "began: [crossed, appeared, crossed]", ".began: expected each word once, found crossed 2 times"),
    (MEASURE, "began: []", ".began: expected at least 1 in the list, found []"),
    (MEASURE, "began: crossed", ".began: expected a list, found 'crossed'"),
    (MEASURE, "began: [1]", ".began[0]: expected 'log_start', 'appeared' or 'crossed', found 1"),
    (MEASURE, "horizon_s: 0", ".horizon_s: expected more than 0, found 0"),
    (MEASURE, "match: 3", ".match: expected keys and values, found 3"),
    (MEASURE, "match: {gate_m: 0}", ".match.gate_m: expected more than 0, found 0"),
    (MEASURE, "match: {gate: 3}", ".match.gate: unknown key; did you mean gate_m?"),
    (MEASURE, "match: {always: true}", ".match.always: unknown key; known here: gate_m"),
    (MEASURE, "accuracy: yes", ".accuracy: expected true or false, found 'yes'"),
    (MEASURE, "gospa: {power: 0.5}", ".gospa.power: expected at least 1, found 0.5"),
    (MEASURE, "gospa: {power: 11, cutoff_m: 0}",
     ".gospa.cutoff_m: expected more than 0, found 0",
     ".gospa.power: expected at most 10, found 11"),
    (MEASURE, "gospa: {p: 2}", ".gospa.p: unknown key; known here: cutoff_m, power"),
    (OBSTACLES, "{}", ": expected a list, found {}"),
    (OBSTACLES, "[{polygon_m: [[0, 0], [1, 1]], height_m: 1}]",
     "[0].polygon_m: expected at least 3 in the list, found [[0, 0], [1, 1]]"),
    (OBSTACLES, "[{polygon_m: [[0, 0], [1, 1], a], height_m: 1}]", "[0].polygon_m[2]: expected a list, found 'a'"),
    (OBSTACLES, "[{polygon_m: [[0, 0], [1, 1], [1, 0], [0, 1]], height_m: 1}]",
     f"[0]: polygon_m: {CORNERS}, found edges that cross or overlap at [0.5, 0.5]"),
    (OBSTACLES, "[{polygon_m: [[0, 0], [4, 0], [4, 4], [2, 0], [0, 4]], height_m: 1}]",
     f"[0]: polygon_m: {CORNERS}, found edges that meet at [2, 0]"),
    (OBSTACLES, "[{polygon_m: [[0, 0], [0, 0], [0, 0]], height_m: 1}]",
     f"[0]: polygon_m: {CORNERS}, found corners without an area between them"),
    (SHOW, "3", ": expected keys and values, found 3"),
    (SHOW, "{logs: first}", ".logs: expected a list, found 'first'"),
    (SHOW, "{logs: []}", ".logs: expected at least 1 in the list, found []"),
    (SHOW, "{run: mean}", ".run: expected a whole number, or 'median', 'worst' or 'best', or a list, found 'mean'"),
    (SHOW, "{run: []}",
     ".run: expected a whole number, or 'median', 'worst' or 'best', or at least 1 in the list, found []"),
    (SHOW, "{run: [best, mean]}", ".run[1]: expected a whole number, or 'median', 'worst' or 'best', found 'mean'"),
    (SHOW, "{run: [1, null]}", ".run[1]: expected a whole number, or 'median', 'worst' or 'best', found nothing"),
    (SHOW, "{run: [best, 3, best]}", ".run: expected each run once, found best twice"),
    (SHOW, "{configurations: GT}", ".configurations: expected a list, found 'GT'"),
    (SHOW, "{configurations: []}", ".configurations: expected at least 1 in the list, found []"),
    (SHOW, "{configuration: [GT]}", ".configuration: unknown key; did you mean configurations?"),
    (SHOW, "{units: some}", ".units: expected true or false, found 'some'"),
    (SHOW, "{units: [ego]}", ".units: expected true or false, found ['ego']"),
    (SHOW, "{truth: maybe}", ".truth: expected true or false, found 'maybe'"),
    (SHOW, "{map: 1}", ".map: expected true or false, found 1"),
    (SHOW, "{run: -1}", ".run: expected at least 0, or 'median', 'worst' or 'best', or a list, found -1"),
]  # fmt: skip


def at(place: tuple[str, str], text: str) -> str:
    """A line of the file at a place."""
    return place[0] % text


class TestProblems:
    @pytest.mark.parametrize("case", CASES, ids=[at(place, text).strip() for place, text, *_ in CASES])
    def test_line_key_and_what_was_expected(self, tmp_path: Path, case: tuple[tuple[str, str], str, str]) -> None:
        place, text, *expected = case
        assert problems(tmp_path, changed(at(place, text))) == [place[1] + problem for problem in expected]

    @pytest.mark.parametrize("name", ["default", "truth", "all", "''"])
    def test_names_that_are_taken(self, tmp_path: Path, name: str) -> None:
        text = TEXT.replace("configurations:", f"  {name}: {{at: [0, 0], height_m: 1, pem: onboard}}\nconfigurations:")
        plain = name.strip("'")
        assert problems(tmp_path, text) == [f"13: units.{name}: {plain!r} cannot be a unit's name"]

    def test_keys_that_must_be_there(self, tmp_path: Path) -> None:
        found = problems(tmp_path, "runs: 1\n")
        assert found == ["1: version: missing", "1: logs: missing", "1: configurations: missing"]

    def test_no_configuration(self, tmp_path: Path) -> None:
        text = TEXT[: TEXT.index("configurations:")] + "configurations: {}\n"
        assert problems(tmp_path, text) == ["13: configurations: expected at least one, found none"]

    def test_a_key_that_must_be_there_and_is_misspelt(self, tmp_path: Path) -> None:
        """One line, at what is written."""
        text = TEXT.replace("detection:", "detektion:")
        line = "8: pems.onboard[0].detektion: unknown key; did you mean detection?"
        assert problems(tmp_path, text) == [line]
        both = ["2: log: unknown key; did you mean logs?", line]
        assert sorted(problems(tmp_path, text.replace("logs:", "log:"))) == both
        for section in ("pems", "units", "configurations"):  # the names in it are known all the same
            (line,) = problems(tmp_path, re.sub(f"^{section}:", f"{section[:-1]}:", TEXT, flags=re.MULTILINE))
            assert line.endswith(f": {section[:-1]}: unknown key; did you mean {section}?")
        misnamed = TEXT.replace("detection:", "what:")
        assert problems(tmp_path, misnamed)[0] == "7: pems.onboard[0].detection: missing"

    def test_pem_that_is_no_list(self, tmp_path: Path) -> None:
        text = TEXT.replace("    - when:", "      when:")
        assert problems(tmp_path, text)[0].startswith("6: pems.onboard: expected a list, found {'when': {'range_m'")

    @pytest.mark.parametrize("number", [30, 20_000])
    def test_each_key_is_looked_at_once(self, number: int) -> None:
        """Time grows with the number of problems: 20 000 take seconds, and took a quarter of an hour."""

        class Sizes(BaseModel):
            of: dict[str, int]
            deeper: dict[str, dict[str, int]] = {}

        data = {"of": {f"k{k}": "x" for k in range(number)}, "deeper": {"a": {"b": "x"}}}
        with pytest.raises(ValidationError) as wrong:
            Sizes.model_validate(data)
        began_s = time.process_time()
        found = list(describe_by_key(wrong.value, data))
        assert time.process_time() - began_s < 10
        assert [key for key, _ in found] == [*(("of", f"k{k}") for k in range(number)), ("deeper", "a", "b")]

    def test_ten_thousand_unknown_keys(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """Which keys there are is known without the JSON Schema, which takes 0.1 s to make."""
        monkeypatch.setattr(Experiment, "model_json_schema", None)
        units = "".join(f"  u{k}: {{on: ego, pem: onboard, heigth_m: 1}}\n" for k in range(10_000))
        found = problems(tmp_path, TEXT.replace("configurations:", f"{units}configurations:"))
        assert found == [f"{13 + k}: units.u{k}.heigth_m: unknown key; did you mean height_m?" for k in range(10_000)]

    def test_examples_of_lists_are_those_of_the_page_of_keys(self) -> None:
        page = (Path(__file__).parents[2] / "docs/reference/keys.md").read_text(encoding="utf-8")
        assert [key for key, example in LIST_EXAMPLES.items() if f"`{key}: {example}`" not in page] == []

    @pytest.mark.parametrize("name", ["a/b", "''", '"a\\nb"', '"\\e[31m"'])
    def test_name_of_a_configuration(self, tmp_path: Path, name: str) -> None:
        (problem,) = problems(tmp_path, TEXT.replace("  PEM:", f"  {name}:"))
        assert problem.startswith("15: configurations.")
        assert "expected a printable name without '/', found" in problem

    def test_all_problems_of_a_file_at_once(self, tmp_path: Path) -> None:
        text = changed(
            "runs: many", "  mast: {at: [0, 0], height_m: -1, pem: onboard}", "colour: red", "seed: 1\nseed: 2"
        )
        found = problems(tmp_path, text)
        assert sorted(found, key=lambda line: int(line.partition(":")[0])) == [
            "3: runs: expected a whole number, found 'many'",
            "5: seed: key given twice",
            "13: units.mast.height_m: expected at least 0, found -1",
            found[-1],
        ]
        assert found[-1].startswith("20: colour: unknown key")

    def test_a_long_value_is_cut_short(self, tmp_path: Path) -> None:
        (problem,) = problems(tmp_path, changed(f"visibility: {'x' * 500}"))
        assert len(problem) < 120


class TestComponents:
    def test_built_in(self, tmp_path: Path) -> None:
        (couple,) = experiment(tmp_path, TEXT).pems["onboard"].couples
        assert couple.detection == ConstantDetection(kind="constant", probability=0.5)

    def test_class_of_a_module(self, tmp_path: Path) -> None:
        kind = f"{__name__}:Always"
        (couple,) = experiment(tmp_path, changed(at(DETECTION, f"kind: '{kind}', sure: false"))).pems["onboard"].couples
        assert couple.detection == Always(kind=kind, sure=False)
        (problem,) = problems(tmp_path, changed(at(DETECTION, f"kind: '{kind}', sur: false")))
        assert (
            problem == "8: pems.onboard[0].detection.sur: unknown key; did you mean sure?" or "unknown key" in problem
        )

    def test_entry_point(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        installed(monkeypatch, always=f"{__name__}:Always", broken="no.such.module:Thing")
        (couple,) = experiment(tmp_path, changed(at(DETECTION, "kind: always"))).pems["onboard"].couples
        assert couple.detection == Always(kind="always")
        (problem,) = problems(tmp_path, changed(at(DETECTION, "kind: alway")))
        assert (
            "kind: expected one of visible_share, constant, table, always, broken, or package.module:Class" in problem
        )
        (problem,) = problems(tmp_path, changed(at(DETECTION, "kind: broken")))
        assert "kind: 'broken' cannot be imported: ModuleNotFoundError: No module named 'no' (" in problem

    def test_entry_points_are_in_the_schema(self, monkeypatch: pytest.MonkeyPatch) -> None:
        installed(monkeypatch, always=f"{__name__}:Always", broken="no.such.module:Thing")
        couple = Experiment.model_json_schema()["$defs"]["Couple"]["properties"]
        kinds = [one["properties"]["kind"].get("const") for one in couple["detection"]["anyOf"]]
        assert kinds == ["visible_share", "constant", "table", "always", None]

    @pytest.mark.parametrize(
        ("kind", "why"),
        [
            ("nomodule:X", "cannot be imported: ModuleNotFoundError: No module named 'nomodule'"),
            ("os:nothing", "cannot be imported: AttributeError: module 'os' has no attribute 'nothing'"),
            ("os:path", "is no kind of copem_replay.perception.pem.detection.DetectionModel"),
            (f"{__name__}:NoModel", "is no kind of copem_replay.perception.pem.detection.DetectionModel"),
            (
                "copem_replay.perception.pem.error:Gaussian",
                "is no kind of copem_replay.perception.pem.detection.DetectionModel",
            ),
            (
                "copem_replay.perception.pem.detection:DetectionModel",
                "is no kind of copem_replay.perception.pem.detection.DetectionModel",
            ),
            ("..relative:X", "cannot be imported: TypeError: "),
            (":", "cannot be imported: ValueError: Empty module name"),
            ("broken_module_of_a_user:X", "cannot be imported: SyntaxError: "),
            ("failing_module_of_a_user:X", "cannot be imported: ZeroDivisionError: division by zero"),
        ],
    )
    def test_kind_that_cannot_be(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, why: str) -> None:
        (tmp_path / "broken_module_of_a_user.py").write_text("class X(\n")
        (tmp_path / "failing_module_of_a_user.py").write_text("1 / 0\n")
        monkeypatch.syspath_prepend(tmp_path)
        (problem,) = problems(tmp_path, changed(at(DETECTION, f"kind: '{kind}'")))
        assert problem.startswith(f"8: pems.onboard[0].detection: kind: '{kind}' {why}")
        assert "\n" not in problem

    def test_error_slot_takes_error_models_only(self, tmp_path: Path) -> None:
        (problem,) = problems(
            tmp_path, changed(at(ERROR, "kind: 'copem_replay.perception.pem.detection:VisibleShare'"))
        )
        assert f"is no kind of {ErrorModel.__module__}.ErrorModel" in problem

    def test_fusion(self, tmp_path: Path) -> None:
        """Ideal fusion needs no name; a class of one's own is named like that of a model."""
        kind = f"{__name__}:Newest"
        for text, expected in (
            ("", IdealFusion()),
            ("fusion: {}", IdealFusion()),
            ("fusion: {combine: posterior}", IdealFusion(combine="posterior")),
            ("fusion: {kind: tracker, late: replay}", Tracker(late="replay")),
            (f"fusion: {{kind: '{kind}', surely: false}}", Newest(kind=kind, surely=False)),
        ):
            assert experiment(tmp_path, changed(at(COPEM, text))).configurations["coPEM"].fusion == expected
        (problem,) = problems(tmp_path, changed(at(COPEM, f"fusion: {{kind: '{__name__}:Always'}}")))
        assert "is no kind of copem_replay.fusion.interface.Fusion" in problem

    def test_the_schema_asks_for_the_kind_of_all_but_ideal_fusion(self) -> None:
        fusion = Experiment.model_json_schema()["$defs"]["Configuration"]["properties"]["fusion"]
        kinds = {one["properties"]["kind"].get("const"): "kind" in one.get("required", ()) for one in fusion["anyOf"]}
        assert kinds == {"ideal": False, "union": True, "nms": True, "gnn": True, "tracker": True, None: True}

    def test_a_component_can_be_given_as_it_is(self) -> None:
        model = VisibleShare()
        data = {"version": 1, "logs": ["a"], "configurations": {"GT": {"units": "truth"}}}
        found = Experiment.model_validate(data | {"pems": {"p": [{"detection": model}]}})
        assert found.pems["p"].couples[0].detection is model


def installed(monkeypatch: pytest.MonkeyPatch, **points: str) -> None:
    def entry_points(group: str) -> list[EntryPoint]:
        if group != "copem_replay.detection":
            return []
        return [EntryPoint(name, value, group) for name, value in points.items()]

    monkeypatch.setattr(components, "entry_points", entry_points)


class TestLogs:
    def paths(self, folder: Path, *patterns: str) -> tuple[list[str], list[str]]:
        source = source_of(folder, plain_yaml.dump_yaml({"version": 1, "logs": list(patterns)}))
        found, wrong = log_paths(source)
        return [str(path.relative_to(folder)) for path in found], [line.rpartition("yaml:")[2] for line in wrong]

    def test_globs_are_sorted_and_relative_to_the_file(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        for name in ("b.mcap", "a.mcap", "sub/c.mcap", "sub/deep/d.mcap", "e.bag"):
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).touch()
        monkeypatch.chdir("/")
        assert self.paths(tmp_path, "*.mcap") == (["a.mcap", "b.mcap"], [])
        assert self.paths(tmp_path, "**/*.mcap")[0] == ["a.mcap", "b.mcap", "sub/c.mcap", "sub/deep/d.mcap"]
        assert self.paths(tmp_path, "b.mcap", "?.mcap")[0] == ["b.mcap", "a.mcap"]
        assert self.paths(tmp_path, str(tmp_path / "s*/*.mcap"))[0] == ["sub/c.mcap"]

    def test_a_file_may_be_named_like_a_glob(self, tmp_path: Path) -> None:
        folder = tmp_path / "[1] night"
        folder.mkdir()
        for name in ("a[1].mcap", "a1.mcap"):
            (folder / name).touch()
        assert self.paths(folder, "a[1].mcap") == (["a[1].mcap"], [])
        assert self.paths(folder, "a?.mcap") == (["a1.mcap"], [])

    def test_glob_that_matches_nothing(self, tmp_path: Path) -> None:
        found, wrong = self.paths(tmp_path, "*.mcap", "[")
        assert found == []
        assert wrong == ["3: logs[0]: no file matches '*.mcap'", "4: logs[1]: no file matches '['"]

    @pytest.mark.parametrize("name", ["none.mcap", "x" * 300, "a\0b"])
    def test_a_name_stands_for_itself(self, tmp_path: Path, name: str) -> None:
        assert self.paths(tmp_path, name) == ([name], [])


LOGS = Path(__file__).parents[2] / "logs"


class TestRoundTrip:
    @pytest.mark.parametrize(
        "text",
        [TEXT, CONTRACT, *((LOGS / f"{name}.yaml").read_text("utf-8") for name in ("tc016d", "crossing"))],
    )
    def test_written_with_all_defaults_it_is_the_same(self, tmp_path: Path, text: str) -> None:
        first = experiment(tmp_path, text)
        written = plain_yaml.dump_yaml(first.as_written())
        again = experiment(tmp_path, written)
        assert again == first
        assert plain_yaml.dump_yaml(again.as_written()) == written

    def test_every_kind_of_key(self, tmp_path: Path) -> None:
        more = "frame: line_of_sight, mean_m: [1, -1], yaw_sigma_deg: 5"
        table = "range_m: [0, 50.5], visible_share: [0, 0.5, 1], probability: [[1, 0.5, 1e-7], [0, 0, 1]]"
        own_rate = "offset_m: [2, -0.5], rate_hz: 12.5, phase_s: 0.01, yaw_deg: -90"
        late = "fusion: {combine: posterior}, latency_s: {ego: 0, default: 0.25}, max_age_s: 3"
        onset = "onset: {kind: starts_moving, from: front, within_m: 20}"
        matched = "match: {gate_m: 2.5}, accuracy: false, gospa: {cutoff_m: 7, power: 1}"
        recorded = "topic: /lists, delay_s: 0.07, covariance_m2: [[0.5, 0.1], [0.1, 0.5]], existence: 0.8"
        tracker = "{kind: tracker, late: replay, buffer_s: 1.5, publish: 0.6}"
        text = changed(
            at(DETECTION, f"kind: table, {table}"),
            at(ERROR, f"kind: gaussian, covariance_m2: [[0.3, 0.1], [0.1, 0.4]], {more}")
            + "\n      existence: visible_share",
            at(UNIT, f"on: ego, height_m: 1.8, pem: onboard, {own_rate}"),
            at(MAST, "at: [1e5, -2.25], height_m: 5, pem: onboard, ground_z_m: 31.4"),
            at(COPEM, late),
            at(PEM, f"{{units: [ego, cameras], fusion: {tracker}}}"),
            at(MEASURE, f"{onset}, confirm: {{hits: 2, of: 3}}, horizon_s: 5, count_earlier: true, {matched}"),
            at(OBSTACLES, "[{polygon_m: [[0, 0], [4, 0], [4, 3]], height_m: 6, ground_z_m: -1}]"),
            at(SHOW, "{logs: [first, 7], run: median, configurations: [GT, coPEM]}"),
            "ego: 'on'",
            "read: {topic: /a b/ü}",
        ).replace("configurations:", f"  cameras: {{on: 67, recorded: {{{recorded}}}}}\nconfigurations:", 1)
        first = experiment(tmp_path, text)
        assert experiment(tmp_path, plain_yaml.dump_yaml(first.as_written())) == first
        assert first.ego == "on"
        assert first.show is not None
        assert first.show.logs == ("first", "7")
        assert list(first.shown()) == ["GT", "coPEM"]
        assert list(first.recorded) == ["cameras"]
        assert list(first.modelled) == ["ego", "mast"]
        assert first.units_of(first.configurations["coPEM"]) == ("ego", "mast"), "recorded ones are named"
        assert first.units_of(first.configurations["PEM"]) == ("ego", "cameras")

    def test_own_component(self, tmp_path: Path) -> None:
        first = experiment(tmp_path, changed(at(DETECTION, f"kind: '{__name__}:Always', sure: false")))
        again = experiment(tmp_path, plain_yaml.dump_yaml(first.as_written()))
        assert again == first

    @given(st.lists(st.text(min_size=1, max_size=90), min_size=1, max_size=4, unique=True), SEEDS, st.text())
    def test_any_names(self, names: list[str], seed: int, ego: str) -> None:
        names = [name for name in names if name not in ("default", "truth", "all")]
        shown = [name for name in names if name.isprintable() and "/" not in name] or ["GT"]
        first = Experiment.model_validate(
            {
                "version": 1,
                "logs": names or ["a"],
                "seed": seed,
                "ego": ego,
                "pems": {name: [{"detection": {"kind": "visible_share"}}] for name in names},
                "units": {name: {"on": name, "height_m": 1.0, "pem": name} for name in names},
                "configurations": {name: {"units": names or "truth", "latency_s": {"default": 0.1}} for name in shown},
            }
        )
        text = plain_yaml.dump_yaml(first.as_written())
        assert Experiment.model_validate(plain_yaml.parse_yaml(text)[0]) == first

    def test_reads_well(self, tmp_path: Path) -> None:
        text = plain_yaml.dump_yaml(experiment(tmp_path, CONTRACT).as_written())
        assert text.startswith("version: 1\nlogs: [tc016d.mcap]\n")
        assert "  coPEM:0.5s:\n" in text
        assert "!!" not in text
