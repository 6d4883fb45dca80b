"""Ideal fusion that remembers, against a plain Kalman filter; what it has in common with the ideal."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from copem_replay.core.tracks import Tracks
from copem_replay.fusion.ideal import fuse_ideal
from copem_replay.fusion.ideal_memory import remember_states
from copem_replay.fusion.interface import ConstantVelocity, IdealFusion
from copem_replay.pipeline.run import run_experiment
from tests.helpers.replays import study_rows
from tests.helpers.scenes import Thing, driving, experiment, recording, standing
from tests.metrics.test_by_truth_id import World, tracks, worlds

Array = npt.NDArray[Any]
H = np.eye(2, 4)


def noisy(received: Tracks, seed: int) -> Tracks:
    """Rows with random states and covariances, other in each run."""
    rng, shape = np.random.default_rng(seed), received.valid.shape
    root = rng.normal(0, 1, (2, 2, *shape))
    cov = np.einsum("ik...,jk...->ij...", root, root) + 0.1 * np.eye(2)[..., None, None]
    states = {name: rng.normal(0, 5, shape) for name in ("x_m", "y_m", "vx_mps", "vy_mps")}
    return replace(received, cov_ee_m2=cov[0, 0], cov_en_m2=cov[0, 1], cov_nn_m2=cov[1, 1], **states)


def plain_filter(entries: list[tuple[float, Array, Array, Array]], now_s: float, motion: ConstantVelocity) -> Any:
    """State and covariance now, of entries (capture, position, velocity, R), in the order of capture."""
    time_s, position, velocity, R = entries[0]
    x = np.concatenate([position, velocity])
    P = np.zeros((4, 4))
    P[:2, :2], P[2:, 2:] = R, motion.speed_sigma_mps**2 * np.eye(2)

    def predicted(x: Array, P: Array, dt: float) -> tuple[Array, Array]:
        F = np.block([[np.eye(2), dt * np.eye(2)], [np.zeros((2, 2)), np.eye(2)]])
        Q = motion.acceleration_psd_m2ps3 * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2))
        return F @ x, F @ P @ F.T + Q

    for at_s, z, _, R in entries[1:]:
        x, P = predicted(x, P, at_s - time_s)
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        x, P, time_s = x + K @ (z - H @ x), (np.eye(4) - K @ H) @ P, at_s
    return predicted(x, P, now_s - time_s)


@settings(max_examples=200, deadline=None)
@given(
    world=worlds(), seed=st.integers(0, 2**32 - 1), q=st.sampled_from([0.2, 1.0, 5.0]),
    sigma=st.sampled_from([1.0, 3.0]), data=st.data(),
)  # fmt: skip
def test_a_plain_filter_over_all_that_has_been_taken_in(
    world: World, seed: int, q: float, sigma: float, data: Any
) -> None:
    """Late, lost and overtaken lists too; units whose lists were captured together count in their order."""
    received, motion = noisy(tracks(world), seed), ConstantVelocity(acceleration_psd_m2ps3=q, speed_sigma_mps=sigma)
    late_s = data.draw(st.lists(st.sampled_from([0.0, 0.0, 0.03, 0.12, np.inf]), min_size=len(received.stamp_ns),
                                max_size=len(received.stamp_ns)))  # fmt: skip
    received = replace(received, arrives_s=received.arrives_s + np.array(late_s).reshape(1, -1))
    fused = fuse_ideal(received, max_age_s=world.max_age / 1000).fused
    found = remember_states(received, fused, motion)
    for name in ("valid", "frame_ix", "object_ix", "z_m", "yaw_rad", "length_m"):
        np.testing.assert_array_equal(getattr(found, name), getattr(fused, name))
    arrives_s, rows = received.common_arrives_s, found.row_object_ix
    for s, p in np.argwhere(found.valid):
        now_s = found.common_arrives_s[found.frame_ix[p]]
        of = np.flatnonzero((received.row_object_ix == rows[p]) & received.valid[s])
        of = of[arrives_s[received.frame_ix[of]] <= now_s + 1e-6]
        first_s = np.round(arrives_s[received.frame_ix[of]], 6)
        of = of[np.lexsort((received.row_unit_ix[of], first_s, received.row_captured_s[of]))]
        x, y, vx, vy = (getattr(received, name)[s, of] for name in ("x_m", "y_m", "vx_mps", "vy_mps"))
        ee, en, nn = (c[s, of] for c in (received.cov_ee_m2, received.cov_en_m2, received.cov_nn_m2) if c is not None)
        entries = [
            (float(received.row_captured_s[r]), np.array([x[j], y[j]]), np.array([vx[j], vy[j]]),
             np.array([[ee[j], en[j]], [en[j], nn[j]]]))
            for j, r in enumerate(of)
        ]  # fmt: skip
        state, P = plain_filter(entries, now_s, motion)
        got = [getattr(found, name)[s, p] for name in ("x_m", "y_m", "vx_mps", "vy_mps")]
        np.testing.assert_allclose(got, state, rtol=1e-9, atol=1e-9)
        spread = (found.cov_ee_m2, found.cov_en_m2, found.cov_nn_m2, found.speed_var_m2ps2)
        expected = [P[0, 0], P[0, 1], P[1, 1], (P[2, 2] + P[3, 3]) / 2]
        np.testing.assert_allclose([c[s, p] for c in spread if c is not None], expected, rtol=1e-9, atol=1e-9)


def test_it_knows_what_the_ideal_knows_and_is_nearer_to_the_truth() -> None:
    """One unit, errors of 1 m, p = .7: the filter averages over time and moves lists that are .3 s late to now."""
    pem = {"couples": [{"detection": {"kind": "constant", "probability": 0.7},
                        "error": {"kind": "gaussian", "covariance_m2": [[1, 0], [0, 1]]}}]}  # fmt: skip
    fusions: dict[str, Any] = {"ideal": {}, "memory": {"memory": {"kind": "constant_velocity"}}}
    plan = experiment(
        runs=20, pems={"p": pem}, units={"ego": {"on": "ego", "height_m": 1.8, "pem": "p"}},
        configurations={name: {"units": "all", "latency_s": 0.3, "fusion": {"kind": "ideal"} | more}
                        for name, more in fusions.items()},
    )  # fmt: skip
    things = [Thing("ego", "car", standing(0, 0)), Thing("other", "car", driving(40, 3, -4))]
    result = run_experiment(plan, [recording(things, until_s=8.0)])
    ideal, memory = (study_rows(result)[study_rows(result)["configuration"] == name] for name in fusions)
    assert ideal["detection_s"].tolist() == memory["detection_s"].tolist()
    of = result.summary.set_index("configuration")
    assert of.loc["memory", "position_rmse_m"] < 1.0 < 1.5 < of.loc["ideal", "position_rmse_m"]
    assert of.loc["memory", "nees"] < 2.1  # the car never accelerates: the filter is careful


def test_a_posterior_is_no_measurement() -> None:
    with pytest.raises(ValidationError, match="memory: expected combine: samples"):
        IdealFusion(combine="posterior", memory=ConstantVelocity())
