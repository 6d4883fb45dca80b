"""Fusions that go by lists, in whole replays: what must not matter, and scenes one can compute in the head."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from copem_replay.cli import main as cli
from copem_replay.communication.link import ConstantLink, UnitLinks, transmit
from copem_replay.core.object_list import ENTRY, ObjectLists
from copem_replay.experiment.schema import Experiment
from copem_replay.fusion.inputs import make_inputs
from copem_replay.fusion.interface import ListFusion, ask_fusion
from copem_replay.io.recording import Recording
from copem_replay.pipeline import replay as blocks_module
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.receiver import ReceiverOutput, remove_truth_ids
from copem_replay.pipeline.run import StudyTables, run_experiment
from tests.helpers.experiments import changed, drive
from tests.helpers.replays import outputs_of, study_accuracy, study_rows, world_of
from tests.helpers.reports import inputs_of
from tests.helpers.scenes import EGO_UNIT, Thing, driving, experiment, recording, standing

FUSIONS: dict[str, dict[str, Any]] = {
    "union": {"kind": "union"},
    "nms": {"kind": "nms", "by": "centre"},
    "gnn": {"kind": "gnn"},
    "gnn ci": {"kind": "gnn", "combine": "covariance_intersection"},
    "gnn fci": {"kind": "gnn", "combine": "fast_covariance_intersection"},
    "tracker": {"kind": "tracker"},
    "tracker stale": {"kind": "tracker", "late": "stale"},
    "tracker replay": {"kind": "tracker", "late": "replay"},
}
AT_ONCE = ("union", "nms", "gnn", "gnn ci", "gnn fci")
"""Those that remember nothing."""


def configurations(*names: str, **more: Any) -> dict[str, Any]:
    """GT, ideal fusion and the fusions named (none: all)."""
    ours = {name: {"units": "all", "fusion": FUSIONS[name]} | more for name in names or FUSIONS}
    return {"GT": {"units": "truth"}, "ideal": {"units": "all"} | more} | ours


def pems(probability: float = 1.0, sigma_m: float = 0.0, **more: Any) -> dict[str, Any]:
    couple: dict[str, Any] = {"detection": {"kind": "constant", "probability": probability}} | more
    if sigma_m:
        couple["error"] = {"kind": "gaussian", "covariance_m2": [[sigma_m**2, 0.0], [0.0, sigma_m**2]]}
    return {"p": [couple]}


MAST = {"at": [30, 10], "height_m": 5.0, "pem": "p"}
UNITS = {"ego": EGO_UNIT | {"pem": "p"}, "mast": MAST, "v2v": {"on": "car", "height_m": 1.8, "pem": "p"}}
APPEARS: dict[str, Any] = {"onset": {"kind": "appears"}}


def crowd(log: str = "crowd") -> Recording:
    """The ego drives past a car and three pedestrians, two of them 2 m apart; 1.5 s at 10 Hz."""
    things = [
        Thing("ego", "car", driving(0, 0, 5)), Thing("car", "car", driving(45, 6, -5), yaw_rad=np.pi),
        Thing("a", "pedestrian", driving(20, 8, 0, -1)), Thing("b", "pedestrian", standing(25, -6)),
        Thing("c", "pedestrian", standing(25, -8)),
    ]  # fmt: skip
    return recording(things, until_s=1.5, log=log)


def noisy(**changes: Any) -> Experiment:
    plan = {"pems": pems(0.7, 0.5), "units": UNITS, "configurations": configurations(), "measure": APPEARS}
    return experiment(**(plan | changes))


def of(result: StudyTables, configuration: str) -> pd.DataFrame:
    return study_rows(result)[study_rows(result)["configuration"] == configuration]


def figures(result: StudyTables, configuration: str) -> pd.Series:
    return result.summary.set_index("configuration").loc[configuration]


def same_sets(
    one: ObjectLists, other: ObjectLists, names: tuple[str, ...], others: tuple[str, ...], *, whose: bool
) -> None:
    """The same entries in every list, but for rounding; tracks may be numbered otherwise."""
    assert np.diff(one.start).tolist() == np.diff(other.start).tolist()
    number: dict[int, int] = {}
    for s, k in np.ndindex(len(one.start), one.start.shape[1] - 1):
        a, b = (each.of(s, k)[np.lexsort((each.of(s, k)["y_m"], each.of(s, k)["x_m"]))] for each in (one, other))
        for name in set(ENTRY.names or ()) - {"unit_ix", "track_id"}:
            np.testing.assert_allclose(a[name], b[name], rtol=1e-9, atol=1e-9, err_msg=name)
        if whose:
            assert [names[u] for u in a["unit_ix"]] == [others[u] for u in b["unit_ix"]]
        for mine, its in zip(a["track_id"].tolist(), b["track_id"].tolist(), strict=True):
            assert number.setdefault(mine, its) == its


class TestWhatDoesNotMatter:
    @pytest.mark.parametrize("latency_s", [0.0, {"mast": 0.04, "v2v": 0.33}])
    def test_the_order_of_entries_lists_and_units(self, latency_s: Any) -> None:
        """Told in another order: the same sets. Which unit was first is open where all lists arrive together."""
        plan, runs = noisy(), np.arange(3)
        world = world_of(prepare_log(crowd(), plan), plan, runs)
        seen, lists = world.sent("sampled"), remove_truth_ids(world)[0]
        received = transmit(seen, [UnitLinks("link", ConstantLink(latency_s=latency_s))])
        told = make_inputs(received, lists, max_age_s=1.0)
        rng = np.random.default_rng(0)
        names = tuple(told.units[k] for k in (2, 0, 1))
        order = rng.permutation(len(told.unit_ix))
        other = inputs_of(
            [[rng.permutation(lists.of(s, f)) for f in order] for s in range(3)],
            [told.units[told.unit_ix[f]] for f in order],
            told.captured_s[order].tolist(), told.arrives_s[order].tolist(), names=names,
        )  # fmt: skip
        for name in FUSIONS:
            fusion = plan.configurations[name].fusion
            assert isinstance(fusion, ListFusion)
            one, again = ask_fusion(fusion, told, name), ask_fusion(fusion, other, name)
            assert len(one.entries) > 100
            same_sets(one, again, told.units, names, whose=isinstance(latency_s, dict))

    def test_the_other_runs(self) -> None:
        plan = noisy()
        replay = prepare_log(crowd(), plan)
        batch = outputs_of(replay, plan, np.arange(5))
        for s in (0, 3):
            for name, alone in outputs_of(replay, plan, [s]).items():
                assert entries_of_run(alone, 0) == entries_of_run(batch[name], s if name != "GT" else 0), name

    def test_jobs_and_blocks(self, monkeypatch: pytest.MonkeyPatch) -> None:
        plan = noisy(runs=7)
        logs = [crowd(), crowd("again")]
        one = run_experiment(plan, logs)
        for jobs, size in ((3, 200_000_000), (1, 400 * 3 * 200), (2, 1)):
            monkeypatch.setattr(blocks_module, "BLOCK_BYTES", size)
            assert len(blocks_module.cut_blocks(one.logs[0].replay(), plan, jobs)) > 1
            other = run_experiment(plan, logs, jobs=jobs)
            pd.testing.assert_frame_equal(study_rows(one), study_rows(other), check_exact=True)
            pd.testing.assert_frame_equal(one.summary, other.summary, check_exact=True)
            for name, table in study_accuracy(one).items():
                assert table.equals(study_accuracy(other)[name]), name

    def test_lists_of_the_same_captures_are_made_once_for_all_latencies(self) -> None:
        names = {"at once": {}, "later": {"latency_s": 0.25}, "latest": {"latency_s": 1 / 3}}
        each = {name: {"units": "all"} | more for name, more in names.items()}
        log = crowd()
        plan = noisy(configurations=each)
        together = outputs_of(prepare_log(log, plan), plan, runs=(0, 1, 2))
        assert together["later"].lists is together["at once"].lists
        assert together["latest"].lists is together["at once"].lists
        for name, configuration in each.items():
            alone = noisy(configurations={name: configuration})
            lists = outputs_of(prepare_log(log, alone), alone, runs=(0, 1, 2))[name].lists
            assert lists.start.tobytes() == together[name].lists.start.tobytes()
            assert lists.entries.tobytes() == together[name].lists.entries.tobytes()

    def test_entries_whose_first_list_may_be_another_are_not_shared(self) -> None:
        plan = noisy(configurations={"ideal": {"units": "all"}})
        output = outputs_of(prepare_log(crowd(), plan), plan)["ideal"]
        once, received = output.fused_once, output.received
        assert once is not None
        later = replace(received, arrives_s=received.arrives_s + 0.5)
        again = once.lists_arriving(later)
        assert again is not None
        assert again.lists is output.lists
        for of_mast in (received.frame_unit_ix == 1, np.arange(len(received.stamp_ns)) == 4):
            assert once.lists_arriving(replace(received, arrives_s=received.arrives_s + 0.01 * of_mast)) is None
            lost = np.where(of_mast, np.inf, received.arrives_s)
            assert once.lists_arriving(replace(received, arrives_s=lost)) is None


def entries_of_run(output: ReceiverOutput, s: int) -> tuple[list[int], bytes]:
    lists = output.lists
    first, last = lists.start[s, 0], lists.start[s, -1]
    return (lists.start[s] - first).tolist(), lists.entries[first:last].tobytes()


def still(*others: Thing, until_s: float = 2.0) -> Recording:
    """The ego and a pedestrian stand, 20 m apart; and `others`."""
    return recording([Thing("ego", "car", standing(0, 0)), Thing("a", "pedestrian", standing(20, 5)), *others],
                     until_s=until_s)  # fmt: skip


FROM_500_MS: dict[str, Any] = {"onset": {"kind": "at", "time_s": 0.5}, "objects": {"ids": ["a"]}}
ONE_UNIT = {"ego": EGO_UNIT | {"pem": "p"}}


def replayed(log: Recording, units: Any = ONE_UNIT, measure: Any = FROM_500_MS, **more: Any) -> StudyTables:
    plan = {"pems": pems(), "units": units, "configurations": configurations()} | more
    return run_experiment(experiment(measure=measure, **plan), [log])


class TestInTheHead:
    def test_latency_moves_detections_of_what_stands_by_exactly_itself(self) -> None:
        log = still(Thing("b", "pedestrian", standing(30, -5)), Thing("c", "truck", standing(40, 9)))
        common: dict[str, Any] = {"units": UNITS | {"v2v": MAST | {"at": [25, 0]}}, "pems": pems(0.3, 0.4), "runs": 20}
        common["measure"] = {"onset": {"kind": "at", "time_s": 0.5}}
        now = replayed(log, configurations=configurations(*AT_ONCE), **common)
        late = replayed(log, configurations=configurations(*AT_ONCE, latency_s=0.37), **common)
        for name in ("ideal", *AT_ONCE):
            expected_s = of(now, name)["detection_s"] + 0.37
            np.testing.assert_allclose(of(late, name)["detection_s"], expected_s.where(expected_s <= 2.0), atol=1e-9)
            kept = of(late, name)["detected"]
            np.testing.assert_allclose(of(late, name)["captured_s"][kept], of(now, name)["captured_s"][kept])
            assert kept.any()

    def test_what_is_late_is_known_by_the_instant_it_tells_of(self) -> None:
        """20 m/s times 0.3 s is 6 m. An entry that tells of its capture was right then. Tracks, once they are
        confirmed, tell of now: that is right where they predict, and 6 m off where they take the old for the new."""
        log = still(Thing("fast", "car", driving(10, 10, 20)))
        result = replayed(log, measure=APPEARS | {"objects": {"ids": ["fast"]}},
                          configurations=configurations(latency_s=0.3))  # fmt: skip
        for name in ("ideal", *FUSIONS):
            detection_s = of(result, name)["detection_s"].iloc[0]
            expected_s = {"tracker": 0.4, "tracker replay": 0.4, "tracker stale": None}.get(name, 0.3)
            assert detection_s == pytest.approx(expected_s) if expected_s else np.isnan(detection_s), name
            if name in ("ideal", *AT_ONCE):
                found = figures(result, name)
                per_min = 18 / (1.7 / 60)
                assert found["false_positives_per_min"] == 0.0, "it is about somebody"
                assert found["stale_false_positives_per_min"] == pytest.approx(per_min), "one in each list, 0.3 to 2 s"
                assert found["position_rmse_m"] == pytest.approx(6.0)
                assert found["position_rmse_captured_m"] == pytest.approx(0.0, abs=1e-6)
                assert found["longest_gap_s"] == pytest.approx(2.0), "now it is never where it is said to be"

    def test_whose_word_it_was(self) -> None:
        """The ego's unit is 0.4 s late, the mast's 0.15 s: at 0.65 s there is 0.5 s from the mast, 0.2 s from the ego.

        The mast's is the newest list since the onset that holds the car, whatever a fusion makes of the two: the ego's
        is of before.
        """
        late = configurations("union", "nms", "gnn", latency_s={"ego": 0.4, "mast": 0.15})
        surer = {"p": pems()["p"], "q": pems(existence=0.95)["p"]}
        for pem in ("p", "q"):
            units = ONE_UNIT | {"mast": MAST | {"pem": pem}}
            result = replayed(still(), units, configurations=late, pems=surer)
            for name in ("ideal", "union", "nms", "gnn"):
                found = of(result, name)[["detection_s", "captured_s", "first_unit"]].iloc[0].tolist()
                assert found == [pytest.approx(0.65), pytest.approx(0.5), "mast"], (name, pem)

    @pytest.mark.parametrize(("hits", "n", "at_s"), [(1, 1, 4.0), (2, 3, 4.2), (2, 2, 5.0), (3, 10, 4.9), (3, 9, 5.0)])
    def test_confirmed(self, hits: int, n: int, at_s: float) -> None:
        """From 100 m at 10 m/s, listed at 60, 58, 51 and 50 m only: at 4.0, 4.2, 4.9 and 5.0 s."""
        surely = {"kind": "constant", "probability": 1.0}
        bands = [[59.5, 60.5], [57.5, 58.5], [49.5, 51.5]]
        result = replayed(
            still(Thing("a2", "car", driving(100, 0, -10)), until_s=6.0),
            pems={"p": [{"when": {"range_m": band}, "detection": surely} for band in bands]},
            configurations=configurations("gnn", "union"),
            measure={"onset": {"kind": "appears"}, "objects": {"ids": ["a2"]}, "confirm": {"hits": hits, "of": n}},
        )
        for name in ("ideal", "gnn", "union"):
            assert of(result, name)["detection_s"].tolist() == [pytest.approx(at_s)]

    def test_the_perceived_conflict(self) -> None:
        """Exact lists of one unit imply the same, whatever is made of them."""
        log = recording([Thing("ego", "car", driving(0, 0, 10)), Thing("a", "pedestrian", standing(50, 0))], until_s=4)
        measure = FROM_500_MS | {"conflict": {"horizon_s": 3.0, "margin_m": 0.5}}
        result = replayed(log, measure=measure, configurations=configurations("gnn", "union", "nms"))
        ideal_s = of(result, "ideal")["conflict_detection_s"]
        assert ideal_s.iloc[0] > 1.0
        for name in ("gnn", "union", "nms"):
            np.testing.assert_array_equal(of(result, name)["conflict_detection_s"], ideal_s)

    def test_a_sweep_of_latency(self) -> None:
        result = replayed(
            still(), configurations=configurations("gnn"), sweep={"configurations": ["gnn"], "latency_s": [0.0, 0.3]}
        )
        assert result.sweep is not None
        rows = result.sweep[result.sweep["configuration"] == "gnn"]
        assert rows[["value", "ttd_median_s"]].to_numpy().tolist() == [[0.0, 0.0], [0.3, pytest.approx(0.3)]]


OWN = """
import numpy as np
from copem_replay.fusion.interface import StepFusion

class Mine(StepFusion):
    wrong: str = ""
    value: float | None = None

    def step(self, now_s, inbox, memory):
        fused = np.concatenate([one.entries for one in inbox.newest])
        if self.wrong:
            fused[self.wrong] = np.nan if self.value is None else self.value
        return (fused["x_m"] if self.value == 13 else fused), memory
"""


class TestCommand:
    @pytest.fixture
    def here(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
        monkeypatch.chdir(tmp_path)
        monkeypatch.syspath_prepend(tmp_path)
        (tmp_path / "own_fusion.py").write_text(OWN)
        drive(tmp_path / "drive.mcap")
        return tmp_path

    def run(self, here: Path, monkeypatch: pytest.MonkeyPatch, *options: str, fusion: str, show: str = "null") -> int:
        (here / "e.yaml").write_text(changed(f"  coPEM: {{units: all, fusion: {fusion}}}", f"show: {show}"))
        monkeypatch.setattr(sys, "argv", ["copem-replay", "run", "e.yaml", *options])
        return cli._run_to_exit_code()

    @pytest.mark.parametrize(
        ("wrong", "said"),
        [
            ("place_m", "ValueError: no field of name place_m ("),
            ("x_m", "x_m: expected numbers, found NaN or infinity"),
            ("cov_nn_m2, value: 0", "cov_*_m2: expected positive definite covariances"),
            ("existence, value: 90", "existence: expected probabilities, found 90 … 90"),
            ("captured_s, value: 9", "captured_s: expected the capture of a list that has arrived, found 9 s"),
            ("track_id, value: 7", "track_id: expected each once in a list, found one twice (−1: no track is kept)"),
            ("unit_ix, value: 2", "unit_ix: expected −1 … 1, found 2 … 2"),
            ("x_m, value: 13", "step: expected a list"),
        ],
    )
    def test_what_an_own_fusion_does_wrong_is_one_line(
        self, here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], wrong: str, said: str
    ) -> None:
        assert self.run(here, monkeypatch, fusion=f"{{kind: 'own_fusion:Mine', wrong: {wrong}}}") == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"configurations.coPEM.fusion: own_fusion:Mine: {said}")
        assert re.search(r"\.py:\d+\)$", line)
        assert not (here / "out").exists()

    def test_the_same_bytes_again(self, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        for fusion in ("{kind: 'own_fusion:Mine'}", "{kind: tracker}"):
            written = []
            for jobs in ("1", "2"):
                options = ("--out", f"out/{jobs}", "--jobs", jobs, "--overwrite")
                assert self.run(here, monkeypatch, *options, fusion=fusion, show="{run: 1}") == 0
                files = [
                    path for path in sorted((here / "out" / jobs).iterdir()) if path.suffix not in (".rrd", ".jsonl")
                ]
                written.append({path.name: path.read_bytes() for path in files})
            assert {"detections.parquet", "accuracy.parquet", "bands.csv", "replay.mcap"} < written[0].keys()
            assert written[0] == written[1]
