"""The tools: what they compute by hand, and that they run."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
DATA = ROOT.parent / "shared" / "data"
sys.path.insert(0, str(ROOT / "tools"))

import bench  # noqa: E402
import lidar_visibility  # noqa: E402


def test_rank_correlation_and_area_under_the_curve_by_hand() -> None:
    assert lidar_visibility.spearman(np.array([1.0, 2, 3]), np.array([10.0, 400, 5000])) == pytest.approx(1)
    # Ranks 1 2 3 and 2 1 3: 1 − 6 · (1 + 1 + 0) / (3 · 8) = 0.5
    assert lidar_visibility.spearman(np.array([1.0, 2, 3]), np.array([5.0, 4, 9])) == pytest.approx(0.5)
    # Of the pairs (positive, negative): .9 > .1, .9 > .5, .5 > .1, .5 = .5: 3.5 of 4
    score, positive = np.array([0.9, 0.5, 0.5, 0.1]), np.array([True, True, False, False])
    assert lidar_visibility.auc(score, positive) == pytest.approx(3.5 / 4)


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


@pytest.mark.parametrize(
    ("name", "keys"),
    [
        ("paper", {"paper_draw_ratio"}),
        ("reading", {"read_ratio"}),
        pytest.param("writing", {"mcap_objects_per_s", "rrd_boxes_per_s"}, marks=pytest.mark.long),
    ],
)
def test_benchmarks_print_json_lines(name: str, keys: set[str], capsys: pytest.CaptureFixture[str]) -> None:
    bench.main([name])
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    printed = {key for line in lines for key in line}
    assert keys <= printed
    assert all(value > 0 for line in lines for value in line.values())


def test_the_benchmarks_plain_loop_reads_what_the_reader_reads(tmp_path: Path) -> None:
    """The ratio compares like with like: as many object states."""
    from copem_replay.read import read

    world = bench.boxes(5, 7)
    bench._write_truth(tmp_path / "b.mcap", world)
    recording = read(tmp_path / "b.mcap", name="b")
    assert bench._plain_loop(tmp_path / "b.mcap") == len(recording.truth.frame_ix) == 35
    assert recording.truth.x_m[0] == pytest.approx(world.x_m[0])
