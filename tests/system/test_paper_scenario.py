"""The paper's scenario through the whole chain: shares as given, times as probability says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from copem_replay.experiment.file import log_paths, read_experiment_file
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import find_problems, read_logs
from copem_replay.io.recording import Recording
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.run import run_experiment
from tests.helpers.replays import study_rows

FILE = Path(__file__).parents[2] / "logs/tc016d.yaml"
ONSET_S = 3.0
SHARES = {0.5: 0.0, 0.6: 0.18, 0.7: 0.37, 0.8: 0.56, 0.9: 0.75, 1.0: 0.93, 1.1: 1.0}
"""Visible share by seconds since the first step, flat; before 0.5 s it is 0, after 1.1 s it is 1."""


def loaded(visibility: str) -> tuple[Experiment, Recording]:
    source = read_experiment_file(FILE)
    source.data["visibility"] = visibility
    experiment, found = find_problems(source)
    assert experiment is not None, found
    (recording,), refused = read_logs(experiment, log_paths(source)[0], source)
    assert not refused
    return experiment, recording


@pytest.mark.parametrize("visibility", ["flat", "surface"])
def test_the_pedestrian_comes_out_from_behind_the_truck(visibility: str) -> None:
    experiment, recording = loaded(visibility)
    ready = prepare_log(recording, experiment)
    assert ready.episodes.onset_s == pytest.approx([ONSET_S])
    tracks, episode = ready.measured.tracks, ready.measured.view
    ego = tracks.row_unit_ix == tracks.units.index("ego")
    since = np.round(tracks.row_captured_s[ego] - ONSET_S, 3)
    share = episode.visible_share[ego]
    for t, expected in SHARES.items():
        assert share[since == t] == pytest.approx(expected, abs=0.005), t
    assert share[(since >= 0) & (since <= 0.5)].max() == 0
    assert share[since > 1.1].min() == 1
    masts = ~ego & (tracks.row_captured_s >= ONSET_S) & (tracks.row_captured_s < ONSET_S + 1.9)
    assert episode.visible_share[masts].min() > 0.95, "the roadside units have a view of the crossing"


def test_times_follow_the_closed_form() -> None:
    """Independent detection per list: P(T > t) = Π (1 − share). The 500 runs stay within the DKW band at 10⁻⁶."""
    experiment, recording = loaded("flat")
    result = run_experiment(experiment, [recording])
    table = study_rows(result).set_index("configuration")
    missed, exact = 1.0, {}
    for t, share in SHARES.items():
        missed *= 1 - share
        exact[t] = 1 - missed
    times = table.loc["PEM", "time_to_detection_s"].to_numpy()
    band = np.sqrt(np.log(2 / 1e-6) / (2 * len(times)))
    for t, expected in exact.items():
        assert abs(np.mean(times <= t + 1e-6) - expected) < band + 0.01, t  # the shares are given to two digits
    assert set(np.round(times, 6)) <= set(SHARES)
    for name, latency in (("GT", 0.0), ("coPEM:0s", 0.0), ("coPEM:0.5s", 0.5), ("coPEM:1s", 1.0), ("coPEM:1.5s", 1.5)):
        assert table.loc[name, "time_to_detection_s"].to_numpy() == pytest.approx(latency), name


def test_latency_costs_the_way_driven_meanwhile() -> None:
    """The ego drives 10 m/s towards his line: 22.3 m ahead of its centre at the onset, 3 m beside, he steps nearer."""
    experiment, recording = loaded("surface")
    table = study_rows(run_experiment(experiment, [recording])).set_index("configuration")
    for name, late in (("coPEM:0s", 0.0), ("coPEM:0.5s", 0.5), ("coPEM:1s", 1.0), ("coPEM:1.5s", 1.5)):
        expected = np.hypot(22.3 - 10 * late, 3.0 - late)
        assert table.loc[name, "distance_at_detection_m"].to_numpy() == pytest.approx(expected, abs=1e-6), name
