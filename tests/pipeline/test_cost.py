"""What is said of the time a run takes: on the terminal alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from copem_replay.cli import main as cli
from copem_replay.pipeline.cost import RunCost
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.replay import replay_outcomes
from tests.helpers.experiments import changed, drive
from tests.helpers.scenes import experiment, oncoming_car

NOTE = "% of the "


def test_share_of_the_run() -> None:
    """16 of 20 s in blocks, in which two workers spent 24 of 30 s on accuracy: 0.8 of 0.8."""
    cost = RunCost(total_s=20.0, in_blocks_s=16.0, worked_s=30.0, accuracy_s=24.0)
    assert cost.notes() == (
        "accuracy took 64 % of the 20 s of this replay; `measure: {accuracy: false}` leaves it out",
    )


@pytest.mark.parametrize(
    "cost",
    [
        RunCost(total_s=20.0, in_blocks_s=16.0, worked_s=30.0, accuracy_s=18.75),  # half of it
        RunCost(total_s=10.0, in_blocks_s=10.0, worked_s=10.0, accuracy_s=10.0),  # not long
        RunCost(total_s=20.0, in_blocks_s=16.0, worked_s=30.0, accuracy_s=24.0, compiled=True),
        RunCost(total_s=20.0),  # no run at all
    ],
)
def test_nothing_to_say(cost: RunCost) -> None:
    assert cost.notes() == ()


@pytest.mark.parametrize("fusion", ["ideal", "gnn"])
def test_what_accuracy_costs_is_in_its_blocks(fusion: str) -> None:
    """Of fusions that are judged by match the lists are needed all the same: not all of the time is accuracy's."""
    configurations = {"it": {"units": ["ego"], "fusion": {"kind": fusion}}}
    for accuracy in (True, False):
        wanted = experiment(measure={"accuracy": accuracy}, configurations=configurations)
        [found] = replay_outcomes(prepare_log(oncoming_car(), wanted), wanted, np.arange(3))
        assert found.worked_s > 0
        assert (0 < found.accuracy_s < found.worked_s) if accuracy else found.accuracy_s == 0


def test_the_terminal_alone_says_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    drive(tmp_path / "drive.mcap")
    (tmp_path / "e.yaml").write_text(changed("show: null"))

    def said(out: str) -> str:
        monkeypatch.setattr("sys.argv", ["copem-replay", "run", "e.yaml", "--out", out])
        assert cli._run_to_exit_code() == 0
        return capsys.readouterr().err

    assert NOTE not in said("quick")
    monkeypatch.setattr("copem_replay.pipeline.cost.LONG_S", 0.0)
    monkeypatch.setattr("copem_replay.pipeline.cost.MOSTLY", 0.0)
    [line] = [line for line in said("slow").splitlines() if NOTE in line]
    assert line.startswith("note: accuracy took ")
    assert line.endswith("; `measure: {accuracy: false}` leaves it out")
    files = [{path.name: path.read_bytes() for path in (tmp_path / out).iterdir()} for out in ("quick", "slow")]
    assert files[0] == files[1]
    (tmp_path / "e.yaml").write_text(changed("show: null", "measure: {accuracy: false}"))
    assert NOTE not in said("without")
