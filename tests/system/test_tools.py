"""The tools: what they compute by hand, and that they run."""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from rerun.chunk import RrdReader
from scipy.stats import binom

from copem_replay.experiment.file import read_experiment_file
from copem_replay.experiment.validate import find_problems, read_logs
from copem_replay.pipeline.run import run_experiment
from tests.helpers.reports import inputs_of

ROOT = Path(__file__).parents[2]
DATA = ROOT.parent / "shared" / "data"
sys.path.insert(0, str(ROOT / "tools"))

import bench  # noqa: E402
import calibrate_tc016d  # noqa: E402
import knows_first  # noqa: E402
import lidar_visibility  # noqa: E402
import make_logs  # noqa: E402
import paper  # noqa: E402
from benches import common, fit, floor, fusion, long, memory, parts, peers, reading, scaling  # noqa: E402


def test_no_fusion_of_a_sample_knows_first() -> None:
    rows, sooner, unknown_s = knows_first.count_sooner(knows_first.fused_by_each(ROOT / "logs/crossing.mcap", 1))
    assert rows > 0
    assert sooner == dict.fromkeys(("gnn", "nms", "union", "tracker", "echo"), 0)
    assert unknown_s["echo"] == unknown_s["union"]


def test_rank_correlation_and_area_under_the_curve_by_hand() -> None:
    assert lidar_visibility.spearman(np.array([1.0, 2, 3]), np.array([10.0, 400, 5000])) == pytest.approx(1)
    # Ranks 1 2 3 and 2 1 3: 1 − 6 · (1 + 1 + 0) / (3 · 8) = 0.5
    assert lidar_visibility.spearman(np.array([1.0, 2, 3]), np.array([5.0, 4, 9])) == pytest.approx(0.5)
    # Of the pairs (positive, negative): .9 > .1, .9 > .5, .5 > .1, .5 = .5: 3.5 of 4
    score, positive = np.array([0.9, 0.5, 0.5, 0.1]), np.array([True, True, False, False])
    assert lidar_visibility.auc(score, positive) == pytest.approx(3.5 / 4)


def test_exponents_by_hand() -> None:
    assert scaling.exponent((10, 20, 40), (3.0, 7.0, 12.0)) == pytest.approx(1)
    assert scaling.exponent((60, 600), (0.5, 50.0)) == pytest.approx(2)


def test_bench_of_scaling_grows_one_thing_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[scaling.Size] = []

    def spent_on(size: scaling.Size, _folder: Path) -> common.Spent:
        asked.append(size)
        return common.Spent(1.0 + 0.01 * size.objects, 2.0, 100 + size.objects)

    monkeypatch.setattr(scaling, "spent_on", spent_on)
    *lines, exponents = scaling.grown("objects", common.Spent(1.0, 1.0, 100), tmp_path)
    assert [line["objects"] for line in lines] == [size.objects for size in asked] == list(scaling.SIZES["objects"])
    assert len({(size.runs, size.units, size.configurations, size.frames) for size in asked}) == 1
    assert (exponents["cpu_exponent"], exponents["seconds_exponent"], exponents["peak_exponent"]) == (1, 0, 1)


def test_the_experiment_of_scaling_runs(tmp_path: Path) -> None:
    few = scaling.Size(runs=2, units=2, objects=4, configurations=2, frames=4)
    assert scaling.spent_on(few, tmp_path).peak_mb > 0
    summary = pd.read_csv(tmp_path / "out" / "summary.csv")
    assert set(summary["configuration"]) == {"c0", "c1"}


def test_bench_of_memory_remembers_all_that_the_crossing_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, few in (("LISTS", 20), ("OBJECTS", 2), ("RUNS", 2)):
        monkeypatch.setattr(memory, name, few)
    assert all(number > 0 for number in memory.numbers().values())
    plain, found = find_problems(read_experiment_file(ROOT / "logs/crossing.yaml"))
    assert plain is not None, found
    lasting = memory.remembering(plain)
    assert all(pem.memory.keys() == {"detection", *(pem.asked() or ())} for pem in lasting.pems.values())
    assert lasting.configurations == plain.configurations


@pytest.mark.long
def test_bench_of_fitting_finds_what_it_put_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """60 of its drives: all rungs, and the share .6 of what lasts."""
    monkeypatch.setattr(fit, "PASSES", 60)
    fitted, checked = fit.fit()
    assert (fitted["rows"], fitted["rungs"], checked["runs"]) == (6000, 6, 500)
    assert fitted["share"] == pytest.approx(0.6, abs=0.1)


def test_the_table_of_the_page_about_memory_is_what_its_tool_prints() -> None:
    """Exact and sampled; by hand .7^6, .7^11, … of 6, 11, … lists within a second."""
    done = subprocess.run(
        [sys.executable, "tools/memory_table.py"], cwd=ROOT, check=True, capture_output=True, text=True
    )
    assert done.stdout in (ROOT / "docs/guide/perception-models.md").read_text(encoding="utf-8")
    rows = [line.split("|")[1:-1] for line in done.stdout.splitlines()[2:6]]
    for rate_hz, fresh, sampled, held, held_sampled in (map(float, row) for row in rows):
        assert fresh == pytest.approx(0.7 ** (rate_hz + 1), abs=6e-5)
        assert sampled == pytest.approx(fresh, abs=0.02)
        assert held == pytest.approx(0.7 * (np.exp(-1 / rate_hz) + 0.7 * -np.expm1(-1 / rate_hz)) ** rate_hz, abs=6e-5)
        assert held_sampled == pytest.approx(held, abs=0.03)


@pytest.mark.skipif(not DATA.is_dir(), reason="shared/data with recordings is not beside the project")
def test_visible_share_tells_what_lidar_sees() -> None:
    """Floors from a spike (.765, .908); without heights the share tells less."""
    command = [sys.executable, "tools/lidar_visibility.py", str(DATA / "av2_3b3570b4.mcap")]
    done = subprocess.run(
        [*command, str(DATA / "av2_3b3570b4.lidar_points.csv")], cwd=ROOT, check=True, capture_output=True, text=True
    )
    (line,) = done.stdout.splitlines()
    found = json.loads(line)
    assert list(found) == ["n", "surface_spearman", "surface_auc", "flat_spearman", "flat_auc"]
    assert found["n"] > 500
    assert found["surface_spearman"] >= 0.74
    assert found["surface_auc"] >= 0.88
    assert found["flat_spearman"] < found["surface_spearman"]
    assert found["flat_auc"] < found["surface_auc"]


def test_lidar_visibility_says_what_is_wrong() -> None:
    command = [sys.executable, "tools/lidar_visibility.py", "nowhere.mcap", "points.csv"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode != 0
    assert done.stderr.splitlines() == ["nowhere.mcap: no such file"]


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "keys"),
    [
        ("paper", {"paper_draw_ratio"}),
        ("reading", {"read_ratio"}),
        ("writing", {"mcap_objects_per_s", "rrd_boxes_per_s"}),
    ],
)
def test_benchmarks_print_json_lines(
    name: str, keys: set[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """How fast does not matter here: each is called once."""
    monkeypatch.setattr(common, "best", lambda work, times=5: common.timed(work).seconds)
    bench.main(["--alone", name])
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    printed = {key for line in lines for key in line}
    assert keys <= printed
    skipped = {key for line in lines if "skipped" in line for key, value in line.items() if value is None}
    assert skipped <= {"rrd_first_picture_s"}, "where there is nothing to draw with"
    numbers = [
        value for line in lines for key, value in line.items() if key not in skipped and not isinstance(value, str)
    ]
    assert all(value > 0 for value in numbers)


def test_a_benchmark_that_there_is_not() -> None:
    with pytest.raises(SystemExit, match=r"^expected some of floor, compile, .*; found writting$"):
        bench.main(["paper", "writting"])


def test_the_benchmarks_plain_loop_reads_what_the_reader_reads(tmp_path: Path) -> None:
    """The ratio compares like with like: as many object states."""
    from copem_replay.io.recording import read_log

    world = common.boxes(5, 7)
    common.write_truth(tmp_path / "b.mcap", world)
    recording = read_log(tmp_path / "b.mcap", name="b")
    assert reading.plain_loop(tmp_path / "b.mcap") == len(recording.truth.frame_ix) == 35
    assert recording.truth.x_m[0] == pytest.approx(world.x_m[0])


@pytest.fixture
def once(monkeypatch: pytest.MonkeyPatch) -> None:
    """How fast does not matter: each is called once."""
    monkeypatch.setattr(common, "best", lambda work, _times: common.timed(work).seconds)


def test_the_crossing_is_fused_by_each_configuration(once: None) -> None:
    experiment, recordings = common.loaded("crossing")
    some = {name: experiment.configurations[name] for name in ("ideal", "union", "tracker:replay:mixed")}
    short = experiment.model_copy(update={"runs": 2, "configurations": some})
    lines = list(fusion.crossing(short, recordings[0]))
    assert [line["algorithm"] for line in lines] == list(some)
    for line in lines:
        assert line["fusion_lists_per_s"] * line["us_per_list"] == pytest.approx(1e6, rel=0.01)
        assert line["lists_per_s_two_threads"] > 0


def test_what_units_report_in_fusion_benchmarks() -> None:
    """The same as from its lists one by one; eight of ten objects are in each."""
    told, truth = fusion.scene(50, 4, 20)
    lists = [told.lists.of(0, f) for f in range(80)]
    units = [told.units[u] for u in told.unit_ix]
    plain = inputs_of([lists], units, told.captured_s.tolist(), told.arrives_s.tolist())
    for name in ("unit_ix", "captured_s", "arrives_s", "issue_s", "newest", "arrived", "arrived_start"):
        assert getattr(told, name).tolist() == getattr(plain, name).tolist(), name
    assert told.lists.start.tolist() == plain.lists.start.tolist()
    assert told.lists.entries.tobytes() == plain.lists.entries.tobytes()
    assert told.lists.start[0, -1] == pytest.approx(0.8 * 4000, abs=4 * np.sqrt(4000 * 0.8 * 0.2))
    assert truth[0].max() < 10 * np.sqrt(50)


def test_only_equal_results_are_raced(once: None, monkeypatch: pytest.MonkeyPatch) -> None:
    (line,) = fusion.gnn_vs_numpy((5,))
    assert line["gnn_vs_numpy"] > 0
    assert 0 <= line["max_dx_m"] < 1e-9
    plain = fusion.gnn_oracle.fuse
    monkeypatch.setattr(fusion.gnn_oracle, "fuse", lambda told, gate: plain(told, gate=0.5))
    with pytest.raises(AssertionError):
        list(fusion.gnn_vs_numpy((5,)))


def test_stone_soup_is_a_peer_where_it_is_installed(once: None) -> None:
    """GOSPA is equal; tracks are alike: about as many as objects, and near them."""
    pytest.importorskip("stonesoup")
    (line,) = peers.gospa_vs_stonesoup(5)
    assert line["gospa_vs_stonesoup"] > 0
    assert line["max_difference_m"] < 1e-9
    (line,) = peers.tracker_vs_stonesoup(1, 3)  # how many times faster: not here, a first call compiles
    for who in ("", "stonesoup_"):
        assert 14 <= line[f"{who}tracks"] <= 20
        assert 0 < line[f"{who}nearest_rmse_m"] < 1
        assert line[f"{who}nearest_rmse_m"] < line[f"{who}gospa_m"]


def test_without_peers_lines_say_why(monkeypatch: pytest.MonkeyPatch) -> None:
    libraries = {"stonesoup", "norfair", "filterpy", "motmetrics", "trackeval", "mcap_ros2", "mcap_ros2_support_fast"}
    for name in [name for name in sys.modules if name.partition(".")[0] in libraries]:
        monkeypatch.delitem(sys.modules, name)
    for library in libraries:
        monkeypatch.setitem(sys.modules, library, None)
    found = list(peers.peers())
    assert len(found) == 8
    assert {line["peer"] for line in found} == libraries
    for line in found:
        assert line["ratio"] is None
        missing, _, rest = str(line["found"]).partition(" ")
        assert missing.partition(".")[0] == line["peer"]
        assert rest == "is not installed: see tools/benches/peers.py"


def test_paper_counts_and_what_stands_beside_them() -> None:
    """The six counts of the paper's table, and its intervals as in the published rates (Wilson, four digits)."""
    assert paper.PASSED == {"GT": 500, "PEM": 426, "coPEM:0s": 499, "coPEM:0.5s": 474, "coPEM:1s": 323, "coPEM:1.5s": 0}
    ours = pd.DataFrame({"configuration": list(paper.PASSED), "pass_share": 0.5, "pass_share_exact": 0.86})
    table = paper.beside(ours)
    assert table["paper"].tolist() == pytest.approx([1.0, 0.852, 0.998, 0.948, 0.646, 0.0])
    assert table["paper 95 %"].tolist() == [
        "[0.9924, 1.0000]", "[0.8182, 0.8804]", "[0.9888, 0.9996]", "[0.9249, 0.9643]", "[0.6031, 0.6867]",
        "[0.0000, 0.0076]",
    ]  # fmt: skip
    assert table["exact within"].tolist() == ["no", "yes", "no", "no", "no", "no"]


@given(st.integers(1, 2000), st.data())
def test_wilson_limits_solve_the_equation_that_defines_them(n: int, data: st.DataObject) -> None:
    successes = data.draw(st.integers(0, n))
    # Quantiles of the normal distribution as tabulated.
    for confidence, z in ((0.90, 1.6448536269514722), (0.95, 1.959963984540054), (0.99, 2.5758293035489004)):
        low, high = paper.wilson_limits(successes, n, confidence=confidence)
        assert low <= successes / n <= high
        for p in (low, high):
            assert (successes / n - p) ** 2 == pytest.approx(z * z * p * (1 - p) / n, abs=1e-13)


def test_misfit_by_hand() -> None:
    """None at the paper's own rates; at .5 everywhere 2 n log 2 for each of the three with all or none."""
    rates = {name: passed / paper.RUNS for name, passed in paper.PASSED.items()}
    assert calibrate_tc016d.misfit(rates) == pytest.approx(0.0, abs=1e-6)
    halved = calibrate_tc016d.misfit(rates | {"GT": 0.5, "coPEM:1.5s": 0.5})
    assert halved == pytest.approx(2 * 2 * 500 * np.log(2))


@pytest.mark.long
def test_calibration_is_what_the_page_says_and_the_experiment_has() -> None:
    """The fit again: the same page; its parameters are those of the experiment and of the recording."""
    page = calibrate_tc016d.page()
    assert page == (ROOT / "docs/reference/calibration.md").read_text(encoding="utf-8")
    experiment, _ = find_problems(read_experiment_file(ROOT / "logs/tc016d.yaml"))
    assert experiment is not None
    assert experiment.braking is not None
    driver = experiment.braking.driver.model_dump()
    assert f"| `a_max_mps2`, full braking | {driver['a_max_mps2']:g} m/s² |" in page
    assert f"shape of the gamma distribution | {driver['reaction']['shape']:g} |" in page
    assert f"| reaction, mean | {driver['reaction']['mean_s']:g} s |" in page
    assert f"| road side of the truck | y = {make_logs.TC016D_TRUCK_EDGE_M:g} m |" in page


def test_the_table_is_the_papers() -> None:
    """Each exact rate within the paper's Wilson interval, in its order; the sample within 99 % of its own."""
    experiment, _ = find_problems(read_experiment_file(ROOT / "logs/tc016d.yaml"))
    assert experiment is not None
    assert (experiment.runs, experiment.seed) == (500, 1)
    recordings, _ = read_logs(experiment, [ROOT / "logs/tc016d.mcap"], None)
    times = experiment.measure.model_copy(update={"accuracy": False})
    rows = run_experiment(experiment.model_copy(update={"measure": times}), recordings).summary.set_index(
        "configuration"
    )
    exact = rows["pass_share_exact"]
    for name, passed in paper.PASSED.items():
        low, high = paper.wilson_limits(passed, paper.RUNS)
        assert low <= exact[name] <= high, name
        at_least, at_most = binom.interval(0.99, 500, exact[name]) if exact[name] > 0 else (0, 0)
        assert at_least <= rows["pass_share"][name] * 500 <= at_most, name
    order = ["GT", "coPEM:0s", "coPEM:0.5s", "PEM", "coPEM:1s", "coPEM:1.5s"]
    assert (np.diff([exact[name] for name in order]) <= 1e-12).all()


@pytest.mark.long
def test_a_long_recording_is_timed(tmp_path: Path) -> None:
    """Here it is short: what grows how is for the benchmark to say."""
    short, longer, slope = long.grown(tmp_path, minutes=(0.05, 0.1), objects=8)
    assert (short["object_states"], longer["object_states"]) == (240, 480)
    assert all(value > 0 for line in (short, longer, slope) for value in line.values())
    written = (tmp_path / "e.yaml").read_text()
    assert "# Written by `copem-replay init`, as a starting point." in written
    assert "\nruns: 20 " in written
    assert all(value > 0 for value in long.stayed(tmp_path, 0.02, 3).values())


@pytest.mark.long
def test_a_crowd_is_timed(tmp_path: Path) -> None:
    common.write_truth(tmp_path / "crowd.mcap", common.boxes(5, 4))
    line = long.crowded(tmp_path, 5, 4)
    assert line["crowd_views"] == 5 * 4 * 3
    assert all(value > 0 for value in line.values())


def test_each_second_is_of_one_part(monkeypatch: pytest.MonkeyPatch) -> None:
    """By hand: 1 s until reading, 2 s of reading and 4 s of replay in it, 8 s at the end."""
    clock = [10.0]
    monkeypatch.setattr(parts.time, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(parts.time, "process_time", lambda: (clock[0] - 10) / 2)

    def take(seconds: float) -> None:
        clock[0] += seconds

    found = parts.Parts(10.0)
    take(1)
    with found.of(parts.READ):
        take(2)
        found.counted(take, parts.REPLAY)(4)
        with found.of(parts.NOT_COUNTED), found.of(parts.READ):
            take(100)
    found.go_on(parts.END)
    take(8)
    found.go_on(parts.END)
    took = {part: seconds for part, (seconds, _) in found.took.items()}
    assert took == {parts.START: 1, parts.READ: 2, parts.REPLAY: 4, parts.NOT_COUNTED: 100, parts.END: 8}
    assert [cpu_s * 2 for _, cpu_s in found.took.values()] == list(took.values())


def test_a_floor_reads_and_writes_the_same(tmp_path: Path) -> None:
    world, out = common.boxes(5, 7), tmp_path / "out"
    common.write_truth(tmp_path / "b.mcap", world)
    assert parts.read_plainly(tmp_path / "b.mcap") == 35
    parts.keep_messages(tmp_path / "b.mcap", tmp_path / "messages")
    parts.write_plainly(tmp_path / "messages", out)
    said = []
    for path in (tmp_path / "b.mcap", out):
        with path.open("rb") as file:
            said.append([(s.name, c.topic, m) for s, c, m in make_reader(file).iter_messages()])
    assert len(said[0]) == 5
    assert said[0] == said[1]
    (tmp_path / "first").mkdir()
    centres = np.arange(21, dtype=np.float32).reshape(7, 3)
    columns = [("/a", np.arange(3).astype("timedelta64[ns]"), np.array([2, 0, 5]), centres, centres, centres[:, 0] / 9)]
    (tmp_path / "first/columns").write_bytes(pickle.dumps(columns))
    parts.send_plainly(tmp_path / "first", out)
    (chunk,) = (one for one in RrdReader(str(out)).stream() if one.entity_path == "/a")
    row = chunk.to_record_batch().to_pydict()
    assert [len(boxes) for boxes in row["Boxes3D:centers"]] == [2, 0, 5]
    assert np.concatenate(row["Boxes3D:centers"][::2]).tolist() == centres.tolist()


def test_ratios_to_the_floor_by_hand() -> None:
    several = [{"read": (2.0, 3.0), "all": (9.0, 9.0)}, {"read": (4.0, 1.0), "end": (5.0, 5.0), "all": (9.0, 8.0)}]
    assert floor.least(several) == {"read": [2.0, 1.0], "all": [9.0, 8.0], "end": [5.0, 5.0]}
    job = next(one for one in floor.JOBS if one.name == "drive")
    took = {
        "": {"read": (2.0, 1.0), "replay": (7.0, 7.0), "all": (9.0, 8.0)},
        "floor_": {"read": (0.5, 0.5), "all": (3.0, 4.0)},
    }
    read, replay, together = floor.lines(job, took)
    assert (read["ratio"], read["cpu_ratio"], read["goal"]) == (4, 2, None)
    assert (replay["s"], replay["floor_s"], replay["ratio"]) == (7, 0, None)
    assert (together["ratio"], together["cpu_ratio"], together["goal"]) == (3, 2, 1.6)
    assert bench.tabulate([{"section": "a"}, {"a": 1, "b": None}, {"c": 2}, {"a": 3, "b": "x"}]) == [
        "| a | b |", "|---|---|", "| 1 |  |", "| 3 | x |", "", "| c |", "|---|", "| 2 |",
    ]  # fmt: skip


@pytest.mark.long
def test_commands_are_held_against_their_floors() -> None:
    """Each part of `run`; and of `report`, whose floor draws the figures."""
    lines = {(line["job"], line["part"]): line for line in floor.floor(("demo", "report"), times=1)}
    asked = (parts.START, parts.READ, parts.REPLAY, parts.TABLES, parts.MCAP, parts.RRD, parts.END)
    assert [part for job, part in lines if job == "demo"] == [*asked, "all"]
    for line in lines.values():
        assert line["cpu_s"] >= 0
    for part in (parts.START, parts.MCAP, "all"):
        assert lines["demo", part]["floor_cpu_s"] > 0
    assert lines["report", parts.WORK]["floor_cpu_s"] > 0
