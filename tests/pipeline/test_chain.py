"""Units that fuse the lists of others: with ideal fusion a chain is the flat configuration, and it travels as one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import copem_replay as cr
from copem_replay.core.errors import ExperimentError
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import STATES
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import read_logs
from copem_replay.pipeline.one_run import tracks_of_run
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.run import run_experiment
from tests.helpers.recordings import Obj, pedestrian, write_recording
from tests.helpers.replays import study_rows
from tests.pipeline.test_knows_first import draw_pem, draw_unit, drive

KEY = ["object_id", "episode", "run", "configuration"]
SURE = {"couples": [{"detection": {"kind": "constant", "probability": 1.0}}]}
TWO = {"a": {"at": [0, 10], "height_m": 6, "pem": "p"}, "b": {"at": [0, -10], "height_m": 6, "pem": "p"}}


def run(path: Path, plan: dict[str, Any]) -> pd.DataFrame:
    experiment = Experiment.model_validate({"version": 1, "logs": [str(path)]} | plan)
    recordings, refused = read_logs(experiment, [path], None)
    assert not refused, refused
    return study_rows(run_experiment(experiment, recordings))


def tracks(path: Path, plan: dict[str, Any]) -> dict[str, FusedTracks]:
    experiment = Experiment.model_validate({"version": 1, "logs": [str(path)]} | plan)
    [log], _ = read_logs(experiment, [path], None)
    fused = tracks_of_run(prepare_log(log, experiment), experiment, 0)
    return {name: replace(one, scene=log.scene) for name, one in fused.items()}


def line(path: Path, *, from_s: float = 0.0) -> Path:
    """An ego that stands and a pedestrian that walks by, for two seconds at 20 Hz."""
    frames = [
        (k / 20, [Obj(id=1, x=-30.0)] + [pedestrian(2, 5 + k / 20, 1.0, vx=1.0)] * (k / 20 >= from_s))
        for k in range(41)
    ]
    return write_recording(path, frames, host=1)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_with_ideal_fusion_a_chain_is_the_flat_configuration(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    """Units of any rates, with ghosts and errors that last; nothing lies between them and the mast."""
    rng = np.random.default_rng(seed)
    path = drive(tmp_path_factory.mktemp("drawn") / "scene.mcap", rng, recorded=False)
    names = [f"u{k}" for k in range(rng.integers(2, 5))]
    units: dict[str, Any] = {name: draw_unit(rng, f"p{k}", sends=False) for k, name in enumerate(names)}
    for unit in units.values():
        unit.pop("clock", None)
        unit.pop("outages", None)  # what is out is too old for the mast first, and then for the receiver
    members, hits = rng.permutation(names)[:2].tolist(), int(rng.integers(1, 3))
    plan = {
        "runs": 2, "seed": int(rng.integers(1, 99)), "pems": {f"p{k}": draw_pem(rng) for k in range(len(names))},
        "units": units | {"mast": {"fuses": members}},
        "configurations": {"flat": {"units": names}, "chain": {"units": [*sorted({*names} - {*members}), "mast"]}},
        "measure": {"onset": {"kind": "in_range"}, "confirm": {"hits": hits, "of": hits}},
    }  # fmt: skip
    rows = run(path, plan)
    if not rows.empty and hits == 1:
        detection_s = rows.set_index(KEY)["detection_s"].unstack()
        np.testing.assert_allclose(detection_s["chain"], detection_s["flat"], rtol=0, atol=1e-12)
    fused = tracks(path, plan)
    one, other = (fused[name].fused for name in ("flat", "chain"))
    keys = [np.stack([of.frame_ix[of.valid[0]], of.row_object_ix[of.valid[0]]]) for of in (one, other)]
    np.testing.assert_array_equal(*keys)
    for name in STATES:
        a, b = (getattr(of, name) for of in (one, other))
        if a is not None:
            # A variance of 0 counts as 1e-9 at each step.
            atol = 1e-9 if "_var_" in name else 1e-12
            np.testing.assert_allclose(b[other.valid], a[one.valid], rtol=1e-12, atol=atol, err_msg=name)


def test_an_entry_is_as_old_as_the_list_it_is_from(tmp_path: Path) -> None:
    """The slow member had listed the pedestrian before it counts, the fast one has just been turned away.

    The mast's list of .1 s has the entry of 0 s: it does not make known who counts from .05 s on.
    """
    blind = {"couples": [{"detection": {"kind": "constant", "probability": 0.0}}]}
    units = {"a": TWO["a"] | {"rate_hz": 10, "pem": "blind"}, "b": TWO["b"] | {"rate_hz": 2}}
    path = line(tmp_path / "line.mcap")
    plan = {
        "pems": {"p": SURE, "blind": blind},
        "units": units | {"mast": {"fuses": ["a", "b"], "fusion": {"kind": "union"}}},
        "configurations": {
            "ideal": {"units": ["mast"]}, "union": {"units": ["mast"], "fusion": {"kind": "union"}},
            "flat": {"units": ["a", "b"]},
        },
        "measure": {"onset": {"kind": "in_range"}},
    }  # fmt: skip
    rows = run(path, plan).set_index(KEY)["detection_s"].unstack()
    assert rows.nunique(axis=1).eq(1).all()
    entries = tracks(path, plan)["union"].to_dataframe()
    assert (entries["available_s"] - entries["captured_s"]).round(9).isin([0.0, 0.1, 0.2, 0.3, 0.4]).all()
    assert entries["captured_s"].mul(2).round(9).mod(1).eq(0).all()  # those of the slow member


def test_a_list_travels_as_one_and_waits_for_the_rate_of_its_unit(tmp_path: Path) -> None:
    path = line(tmp_path / "line.mcap")
    units = {name: unit | {"rate_hz": 10} for name, unit in TWO.items()}
    mast = {"fuses": ["a", "b"], "rate_hz": 4, "ready": {"kind": "constant", "s": 0.03}}
    lost = {"latency": {"kind": "constant", "s": 0.02}, "reception": {"kind": "constant", "probability": 0.5}}
    plan = {
        "pems": {"p": SURE}, "units": units | {"mast": mast}, "links": {"air": lost}, "runs": 1,
        "configurations": {"by_air": {"units": ["mast"], "link": "air"}, "at_once": {"units": ["mast"]}},
    }  # fmt: skip
    fused = tracks(path, plan)
    whole, heard = (fused[name].to_dataframe() for name in ("at_once", "by_air"))
    instants = np.ceil(np.arange(21) / 10 * 4 - 1e-6) / 4 + 0.03  # what came since the instant before
    assert set(whole["available_s"].round(9)) == set(instants.round(9))
    assert 0 < heard["available_s"].nunique() < whole["available_s"].nunique()
    assert {*(heard["available_s"] - 0.02).round(9)} < {*whole["available_s"].round(9)}


def test_errors_of_pose_move_a_list_as_a_whole(tmp_path: Path) -> None:
    frames = [(k / 10, [Obj(id=1, x=-30.0)] + [pedestrian(o, 4.0 * o, 1.0) for o in (2, 3, 4)]) for k in range(11)]
    path = write_recording(tmp_path / "still.mcap", frames, host=1)
    mast = {"fuses": ["a", "b"], "placed": {"position_sigma_m": 0.7, "stated": True}}
    plan = {
        "pems": {"p": SURE}, "units": TWO | {"mast": mast}, "configurations": {"mast": {"units": ["mast"]}},
    }  # fmt: skip
    entries = tracks(path, plan)["mast"].to_dataframe()
    moved = entries["x_m"] - 4.0 * entries["object_id"].astype(int)
    by_list = moved.groupby(entries["available_s"])
    assert by_list.std().max() < 1e-9
    assert by_list.mean().std() > 0.1
    np.testing.assert_allclose(entries["cov_ee_m2"], 0.49, rtol=1e-6)


def test_a_heading_turns_a_list_about_the_first_member_where_it_is_at_the_capture(tmp_path: Path) -> None:
    """The ego drives at 10 m/s; its slow member, which is the first, lists from half a second on."""
    frames = [
        (k / 10, [Obj(id=1, x=-30.0 + k, vx=10.0), pedestrian(2, 20.0, 1.0), pedestrian(3, 15.0, -9.0)])
        for k in range(21)
    ]
    path = write_recording(tmp_path / "drive.mcap", frames, host=1)
    units = {
        "a": {"on": "ego", "pem": "p", "rate_hz": 1, "phase_s": 0.5, "offset_m": [1.5, 0.0]},
        "b": {"on": "ego", "pem": "p"},
    }
    fused = []
    for keys in ({}, {"placed": {"yaw_sigma_deg": 5.0}}):
        hub = {"fuses": ["a", "b"]} | keys
        plan = {"pems": {"p": SURE}, "units": units | {"hub": hub}, "configurations": {"x": {"units": ["hub"]}}}
        entries = tracks(path, plan)["x"].to_dataframe().set_index(["available_s", "object_id"])
        fused.append((entries["x_m"] + 1j * entries["y_m"]).unstack())
    true, listed = fused
    assert len(true) > 20
    unit = -30.0 + 10.0 * np.minimum(true.index.to_numpy(), 2.0) + 1.5
    turn = np.angle((listed["2"] - unit) / (true["2"] - unit))
    assert np.std(turn) > np.deg2rad(2.0)
    expected = unit[:, None] + (true - unit[:, None]) * np.exp(1j * turn)[:, None]
    np.testing.assert_allclose(listed, expected, rtol=0, atol=1e-4)  # lists of one instant are 2 µs apart


def test_sends_outages_and_clock_are_those_of_the_unit(tmp_path: Path) -> None:
    path = line(tmp_path / "line.mcap")
    mast = {"fuses": ["a", "b"], "fusion": {"kind": "gnn"}}
    more: dict[str, dict[str, Any]] = {
        "sends": {"sends": {"kind": "cpm", "interval_s": 0.1}},
        "outages": {"outages": {"down_share": 0.5, "lasts_s": 0.2}},
        "clock": {"clock": {"offset_sigma_s": 0.05}, "ready": {"kind": "constant", "s": 0.4}},
    }  # fmt: skip
    configurations = {name: {"units": [name], "fusion": {"kind": "gnn"}} for name in more}
    for name, keys in more.items():
        plan = {"pems": {"p": SURE}, "units": TWO | {name: mast | keys}, "configurations": {name: configurations[name]}}
        plain = {"pems": {"p": SURE}, "units": TWO | {name: mast}, "configurations": {name: configurations[name]}}
        with_it, without = (tracks(path, one)[name] for one in (plan, plain))
        entries, every = with_it.to_dataframe(), without.to_dataframe()
        if name == "clock":
            assert with_it.stated_s is not None
            assert np.ptp(with_it.stated_s - with_it.captured_s[0]) < 0.06
            assert np.abs(with_it.stated_s - with_it.captured_s[0]).max() > 0.001
        else:
            assert 0 < len(entries) < len(every)


def test_a_log_without_one_member_has_the_others(tmp_path: Path) -> None:
    one, none = (line(tmp_path / f"{name}.mcap", from_s=0.5) for name in ("one", "none"))
    logs = [{"file": str(one), "units": {"a": None}}, {"file": str(none), "units": {"a": None, "b": None}}]
    plan = {
        "version": 1, "logs": logs, "pems": {"p": SURE}, "units": TWO | {"mast": {"fuses": ["a", "b"]}},
        "configurations": {"mast": {"units": ["mast"]}, "truth": {"units": "truth"}},
    }  # fmt: skip
    rows = cr.run(plan).detections
    assert set(zip(rows["log"], rows["configuration"], strict=True)) == {
        ("one", "mast"), ("one", "truth"), ("none", "truth"),
    }  # fmt: skip
    assert rows["detection_s"].notna().all()


REFUSED = {
    "itself": ({"mast": {"fuses": ["mast", "a"]}}, "units.mast.fuses[0]: unit 'mast' cannot fuse itself"),
    "unknown": ({"mast": {"fuses": ["aa"]}}, "units.mast.fuses[0]: no unit is named 'aa'; did you mean a?"),
    "twice": ({"mast": {"fuses": ["a", "a"]}}, "units.mast.fuses[1]: unit 'a' is fused by 'mast' already"),
    "by two": ({"m": {"fuses": ["a"]}, "n": {"fuses": ["a", "b"]}},
               "units.n.fuses[0]: unit 'a' is fused by 'm' already"),
    "deeper": ({"m": {"fuses": ["a"]}, "mast": {"fuses": ["m", "b"]}},
               "units.mast.fuses[0]: unit 'm' fuses others itself"),
    "apart": ({"c": {"on": "ego", "pem": "p"}, "mast": {"fuses": ["c", "a"]}}, "moves apart from it"),
    "a fleet": ({"c": {"on": {"classes": ["car"]}, "pem": "p"}, "mast": {"fuses": ["c"]}},
                "is carried by several objects"),
    "a member that sends": (
        {"a": TWO["a"] | {"sends": {"kind": "cpm"}}, "mast": {"fuses": ["a", "b"]}},
        "units.a.sends: what 'a' lists leaves"
    ),
    "with a member": ({"mast": {"fuses": ["a", "b"]}}, "configurations.x.units[1]: unit 'a' comes by 'mast' already"),
    "a place": ({"mast": {"fuses": ["a"], "at": [0, 0]}},
                "units.mast.at: a unit that fuses is where its first member is"),
    "a pose, and a recorded member": (
        {"r": {"recorded": {"topic": "x"}}, "mast": {"fuses": ["a", "r"], "placed": {"yaw_sigma_deg": 1}}},
        "units.mast.placed: member 'r' is recorded; expected members with a PEM",
    ),
    "no members": ({"mast": {"fuses": []}}, "units.mast.fuses"),
    "a fusion alone": ({"a": TWO["a"] | {"fusion": {"kind": "gnn"}}},
                       "units.a.fusion: only for a unit that `fuses` others"),
}  # fmt: skip


@pytest.mark.parametrize("which", REFUSED)
def test_what_cannot_be_fused_is_refused_in_a_line(tmp_path: Path, which: str) -> None:

    units, message = REFUSED[which]
    of = ["mast", "a"] if which == "with a member" else ["b"]
    plan = {
        "version": 1, "logs": ["x.mcap"], "pems": {"p": SURE}, "units": TWO | units,
        "configurations": {"x": {"units": of}},
    }  # fmt: skip
    with pytest.raises(ExperimentError) as refused:
        cr.load_experiment(plan)
    assert any(message in line for line in str(refused.value).splitlines()), refused.value


def test_errors_are_not_drawn_again(tmp_path: Path) -> None:
    """`posterior` draws them from what a PEM says; what a unit fused, or recorded, in one log at least, has them."""
    mast, message = {"fuses": ["a", "b"]}, "posterior draws errors, and what unit {!r} lists has errors already"
    plan = {
        "version": 1, "logs": ["x.mcap", {"file": "y.mcap", "units": {"c": {"recorded": {"topic": "x"}}}}],
        "pems": {"p": SURE}, "units": TWO | {"mast": mast, "c": TWO["a"], "r": {"recorded": {"topic": "y"}}},
        "configurations": {"x": {"units": ["mast", "c", "r"], "fusion": {"kind": "ideal", "combine": "posterior"}}},
    }  # fmt: skip
    with pytest.raises(ExperimentError) as refused:
        cr.load_experiment(plan)
    found = [line for line in str(refused.value).splitlines() if "posterior" in line]
    expected = [f"configurations.x.fusion.combine: {message.format(name)}; use samples" for name in ("mast", "c", "r")]
    assert len(found) == 3
    assert all(line.endswith(one) for line, one in zip(sorted(found), sorted(expected), strict=True))


def test_exact_times_are_refused(tmp_path: Path) -> None:
    plan = {
        "version": 1, "logs": ["x.mcap"], "pems": {"p": SURE}, "units": TWO | {"mast": {"fuses": ["a", "b"]}},
        "configurations": {"x": {"units": ["mast"]}}, "measure": {"exact": True},
    }  # fmt: skip
    with pytest.raises(ExperimentError, match="unit 'mast' fuses the lists of others, which has no closed form"):
        cr.load_experiment(plan)


def test_another_fusion_gets_the_lists_of_a_hub_from_the_file(tmp_path: Path) -> None:
    path = line(tmp_path / "line.mcap", from_s=0.3)
    error = {"kind": "gaussian", "covariance_m2": [[0.2, 0.05], [0.05, 0.1]]}
    pem = {"couples": [{"detection": {"kind": "constant", "probability": 0.7}, "error": error}]}
    units = {"car": {"on": "ego", "pem": "p"}, "hub": {"fuses": ["a", "b"], "fusion": {"kind": "gnn"}}}
    gnn = {"gnn": {"units": ["car", "hub"], "fusion": {"kind": "gnn"}}}
    plan = {"version": 1, "logs": [str(path)], "pems": {"p": pem}, "units": TWO | units, "configurations": gnn}
    cr.run(plan).save(tmp_path / "r")
    again = {name: {"recorded": {"topic": f"copem/units/{name}/objects"}} for name in units}
    before, after = (
        tracks(log, {"pems": {"p": pem}, "units": of, "configurations": gnn})["gnn"].to_dataframe()
        for log, of in ((path, TWO | units), (tmp_path / "r/replay.mcap", again))
    )
    order, left_out = ["available_s", "x_m", "y_m"], ["track_id"]
    before, after = (of.drop(columns=left_out).sort_values(order, ignore_index=True) for of in (before, after))
    assert len(before) > 20
    pd.testing.assert_frame_equal(before, after, rtol=0, atol=1e-9)
