"""What else a unit gets wrong: simulated plainly, found again, or said to be untold."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import expon

from copem_replay.core.tracks import CLASSES
from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.core.yaml import strip_comments
from copem_replay.extras.fitting.errors import build_series
from copem_replay.extras.fitting.estimate import Estimate
from copem_replay.extras.fitting.false_positives import estimate_duration, fit_ghosts, garwood_interval
from copem_replay.extras.fitting.pose import fit_pose
from copem_replay.extras.fitting.rest import fit_classes, fit_existence, fit_list_times, fit_rest
from copem_replay.extras.fitting.rows import FitLists, FitRows, OtherEntries
from copem_replay.perception.config import Outages, PoseError
from copem_replay.perception.pem.model import Pem
from tests.extras.fitting.fit_rows import lasting_normals, nothing_else, rows_of


def _holds(estimate: Estimate, true: float) -> bool:
    return estimate.low <= true <= estimate.high


def _lists(captured_s: np.ndarray) -> FitLists:
    none = np.zeros(len(captured_s))
    return FitLists(none.astype(np.int64), captured_s, none, none, none, none.astype(np.int64))


def test_garwood_is_the_published_interval() -> None:
    assert garwood_interval(0) == pytest.approx((0.0, 3.689), abs=1e-3)
    assert garwood_interval(10) == pytest.approx((4.795, 18.390), abs=1e-3)  # Garwood 1936, table 1


def test_a_duration_is_found_from_what_is_seen_at_lists() -> None:
    held = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        gap_s = rng.uniform(0.05, 0.5, 400)
        ended = rng.uniform(size=400) < -np.expm1(-gap_s / 3.0)
        found = estimate_duration(gap_s[~ended], gap_s[ended], "end")
        held.append(_holds(found, 3.0))
    assert sum(held) >= 33
    assert estimate_duration(np.ones(20), np.empty(0), "end").words() == "not identifiable: no end in 20 s"


def test_outages_are_found_again() -> None:
    """A state that is looked at every period: down with share .05, for 2 s on average."""
    held = np.zeros(2)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        n, period_s, share, lasts_s = 12_000, 0.1, 0.05, 2.0
        phi = np.exp(-period_s / (lasts_s * (1 - share)))
        down, state = np.zeros(n, dtype=bool), False
        for k in range(n):
            if rng.uniform() > phi:
                state = rng.uniform() < share
            down[k] = state
        fit = fit_list_times(_lists(period_s * np.flatnonzero(~down) + rng.uniform(0, 0.005, (~down).sum())))
        held += _holds(fit.down_share, share), _holds(fit.lasts_s, lasts_s)
        assert fit.period_s.value == pytest.approx(period_s, abs=1e-3)
    assert (held >= 17).all()
    Outages.model_validate(strip_comments(fit.keys()))


def test_lists_of_one_time_have_no_period() -> None:
    fit = fit_list_times(_lists(np.array([0.0, 0.0, 0.0, 0.4])))
    assert fit.period_s.why == "4 lists, most of one time"


def test_no_outage_is_said() -> None:
    fit = fit_list_times(_lists(0.1 * np.arange(100)))
    assert fit.keys() == {}
    assert fit.down_share.words() == "not identifiable: 0 of 99 gaps are longer than 2.5 medians"


def test_outages_by_hand() -> None:
    """96 gaps of .1 s, then .3, .4, .4 and .5 s: 2 + 3 + 3 + 4 lists are missing.

    Beyond two they go on 4 times of 8, so 4/½ outages begin in 100 gaps, and ½ of a list each ends: .08/(.08 + .5).
    """
    gaps_s = np.array([0.1] * 96 + [0.3, 0.4, 0.4, 0.5])
    fit = fit_list_times(_lists(np.append(0.0, np.cumsum(gaps_s))))
    assert fit.down_share.value == pytest.approx(0.08 / 0.58)


def _confused(seed: int, share: float, tau_s: float, wrong: float, passes: int = 40) -> FitRows:
    rows, _ = rows_of(seed, passes=passes, listed=1.0)
    rng = np.random.default_rng(seed + 1000)
    listed = np.full(len(rows.log), 3)
    for p in range(passes):
        mine = np.flatnonzero(rows.pass_ix == p)
        held = rng.uniform()
        for k, row in enumerate(mine):
            if k and rng.uniform() > np.exp(-(rows.captured_s[row] - rows.captured_s[mine[k - 1]]) / tau_s):
                held = rng.uniform()
            drawn = held if rng.uniform() < share else rng.uniform()
            listed[row] = 4 if drawn < wrong else 3
    return replace(rows, class_ix=listed)


def test_classes_and_their_memory_are_found_again() -> None:
    held = np.zeros(3)
    for seed in range(15):
        rows = _confused(seed, 0.8, 0.5, 0.15)
        fit = fit_classes(rows, build_series(rows))
        [part] = fit.memory
        assert not isinstance(part.correlation_s, str)
        row = fit.confusion[CLASSES[3]]
        held += _holds(row[CLASSES[4]], 0.15), _holds(part.share, 0.8), _holds(part.correlation_s, 0.5)
    assert (held >= 12).all()
    assert fit.keys()["confusion"][CLASSES[3]].value.keys() == {CLASSES[3], CLASSES[4]}


def test_a_class_counts_for_as_many_rows_as_its_memory_leaves() -> None:
    """n²/Σ s² e^(−Δ/τ) over all pairs of rows of a pass, a row with itself as 1."""
    rows = _confused(3, 0.8, 0.5, 0.15, passes=6)
    fit = fit_classes(rows, build_series(rows))
    [part] = fit.memory
    assert not isinstance(part.correlation_s, str)
    apart_s = np.abs(rows.captured_s[:, None] - rows.captured_s)
    pairs = part.share.value**2 * np.exp(-apart_s / part.correlation_s.value)
    pairs *= rows.pass_ix[:, None] == rows.pass_ix
    np.fill_diagonal(pairs, 1.0)
    found = fit.confusion[CLASSES[3]][CLASSES[4]]
    assert found.n_effective == pytest.approx(len(rows.log) ** 2 / pairs.sum(), rel=1e-6)


def test_classes_that_are_never_mistaken() -> None:
    rows, _ = rows_of(1)
    listed = rows.take(rows.listed)
    fit = fit_classes(listed, build_series(listed))
    assert fit.keys() == {}
    assert fit.untold is not None
    assert fit.untold.startswith("no class mistaken in")
    assert 0 < float(fit.untold.partition("< ")[2].partition(",")[0]) < 0.1


def test_existence_of_objects_and_of_others() -> None:
    held = np.zeros(4)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        fit = fit_existence(rng.beta(8, 2, 2000), np.repeat(np.arange(20), 100), rng.beta(2, 4, 500))
        assert fit.real is not None
        assert fit.ghost is not None
        held += [_holds(one, true) for one, true in zip((*fit.real, *fit.ghost), (8, 2, 2, 4), strict=True)]
    assert (held >= 17).all()
    alike = fit_existence(0.9 + 1e-4 * rng.normal(size=400), np.arange(400) % 20, None)
    assert alike.real is not None
    assert alike.real[0].words() == "not identifiable: the claims hardly vary: 1000 is the end of what is tried"
    mixed = np.concatenate([rng.beta(8, 2, 4000), rng.beta(2, 4, 60)])  # ghosts matched to an object that was missed
    fit = fit_existence(mixed, np.arange(4060) % 20, rng.beta(2, 4, 500))
    assert fit.real is not None
    assert [one.value for one in fit.real] == pytest.approx([8, 2], rel=0.08)
    assert strip_comments(fit_existence(np.full(20, 0.9), np.zeros(20), None).keys()) == {"existence": 0.9}


def _ghosts(
    seed: int, in_list: float, lasts_s: float, minutes: float, *, beside: float = 0.0
) -> tuple[FitRows, FitLists, OtherEntries]:
    """Births by a Poisson process in a field of 40 m about (0, 0), or `beside` the one object at (20, 0)."""
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, 60 * minutes, 0.1)
    n = rng.poisson(in_list * 60 * minutes / lasts_s)
    born, life = (
        rng.uniform(-20 * lasts_s, 60 * minutes, int(n * (1 + 20 * lasts_s / 60 / minutes))),
        expon(scale=lasts_s),
    )
    gone = born + life.rvs(len(born), random_state=rng)
    range_m, azimuth = 40 * np.sqrt(rng.uniform(size=len(born))), rng.uniform(-np.pi, np.pi, len(born))
    by = rng.uniform(size=len(born)) < beside
    x = np.where(by, 20 + rng.uniform(-3, 3, len(born)), range_m * np.cos(azimuth))
    y = np.where(by, rng.uniform(-3, 3, len(born)), range_m * np.sin(azimuth))
    list_ix, ghost = np.nonzero((times[:, None] >= born) & (times[:, None] < gone))
    east, north = x[ghost] + rng.normal(0, 0.2, len(ghost)), y[ghost] + rng.normal(0, 0.2, len(ghost))
    other = OtherEntries(
        list_ix, 0 * list_ix, times[list_ix], east, north, np.hypot(east, north), np.arctan2(north, east),
        np.hypot(east - 20, north), np.full(len(ghost), 6), np.full(len(ghost), 0),
        np.full(len(ghost), 0.4), np.full(len(ghost), -1),
    )  # fmt: skip
    m = len(times)
    rows, _ = rows_of(0, passes=1, lists_each=m, listed=1.0)
    away = replace(rows.view, class_ix=np.full(m, 6, dtype=np.int8), length_m=np.full(m, 4.0), width_m=np.full(m, 2.0))
    rows = replace(
        rows, list=np.arange(m), captured_s=times, view=away, state_m=np.column_stack([np.full(m, 20.0), np.zeros(m)])
    )
    return rows, _lists(times), other


def test_ghosts_of_a_field_are_found_again() -> None:
    held = np.zeros(2)
    for seed in range(20):
        fit = fit_ghosts(*_ghosts(seed, 0.5, 1.5, 8.0))
        [sort] = fit.sorts
        held += _holds(sort.in_list, 0.5), _holds(sort.lasts_s, 1.5)
        assert sort.where["kind"] == "field"
        assert "azimuth_deg" not in sort.where
        assert sort.where["range_m"][1] == pytest.approx(40, abs=2)
    assert (held >= 16).all()
    assert fit.per_minute is not None
    assert fit.per_minute.value == pytest.approx(20, rel=0.3)  # births: in_list / lasts_s, a few cut in two


def test_ghosts_beside_objects_are_told_from_those_of_a_field() -> None:
    fit = fit_ghosts(*_ghosts(1, 0.6, 1.0, 10.0, beside=0.5))
    field, beside = fit.sorts
    assert field.where["kind"] == "field"
    assert beside.where["kind"] == "beside"
    assert beside.where["classes"] == [CLASSES[6]]
    assert beside.in_list.value == pytest.approx(0.3, rel=0.25)


def test_ghosts_that_are_others_in_every_list() -> None:
    rows, lists, other = _ghosts(2, 0.3, 0.01, 10.0)
    [sort] = fit_ghosts(rows, lists, other).sorts
    assert sort.keys()["lasts_s"].value == 0.0


def _posed(seed: int, sigma_m: float, sigma_deg: float, tau_s: float) -> tuple[FitRows, FitLists]:
    """Four objects about a unit at (0, 0) for five minutes, errors of their own of .3 m that last 1 s."""
    rng = np.random.default_rng(seed)
    m, K = 3000, 4
    times = 0.1 * np.arange(m)
    pose = lasting_normals(rng, times, 1.0, tau_s, 0.0, 3) * [sigma_m, sigma_m, np.deg2rad(sigma_deg)]
    pieces = []
    for k in range(K):
        bearing = 2 * np.pi * k / K + 0.05 * times
        range_m = 20.0 + 10 * np.sin(0.2 * times + k)
        own = 0.3 * lasting_normals(rng, times, 0.8, 1.0, 0.0, 2)
        east = own[:, 0] + pose[:, 0] - pose[:, 2] * range_m * np.sin(bearing)
        north = own[:, 1] + pose[:, 1] + pose[:, 2] * range_m * np.cos(bearing)
        cos, sin = np.cos(bearing), np.sin(bearing)
        pieces.append((range_m, bearing, cos * east + sin * north, cos * north - sin * east, east, north))
    range_m, bearing, along, across, east, north = (np.concatenate(column) for column in zip(*pieces, strict=True))
    n = K * m
    base, _ = rows_of(0, passes=K, lists_each=m, listed=1.0)
    one = np.ones(n)
    view = ViewGeometry(range_m, bearing, bearing, one, base.view.class_ix, *(5 * [one]))
    rows = replace(
        base, list=np.tile(np.arange(m), K), captured_s=np.tile(times, K), view=view, listed=one > 0,
        along_m=along, across_m=across, east_m=east, north_m=north,
    )  # fmt: skip
    return rows, _lists(times)


def test_the_pose_is_told_from_what_objects_have_in_common() -> None:
    held = np.zeros(2)
    for seed in range(12):
        fit = fit_pose(*_posed(seed, 0.3, 1.0, 3.0))
        assert fit.position_sigma_m is not None
        assert fit.yaw_sigma_deg is not None
        held += _holds(fit.position_sigma_m, 0.3), _holds(fit.yaw_sigma_deg, 1.0)
    assert (held >= 9).all()
    PoseError.model_validate(strip_comments(fit.keys()))
    assert fit.memory is not None
    assert not isinstance(fit.memory.correlation_s, str)
    assert 1.0 < fit.memory.correlation_s.value < 8.0


def test_no_pose_is_told_where_errors_are_the_objects_own() -> None:
    told = [fit_pose(*_posed(seed, 0.0, 0.0, 1.0)).untold is None for seed in range(10)]
    assert sum(told) <= 2
    two = _posed(0, 0.3, 1.0, 3.0)
    assert fit_pose(two[0].take(two[0].object < 2), two[1]).untold == (
        "0 lists have three objects: what two of them share need not be the unit's"
    )
    rows, lists = rows_of(0)
    assert fit_pose(rows.take(rows.listed), lists).untold == "0 lists have two objects or more; a pose needs 50"


def test_ids_and_what_is_untold() -> None:
    rows, lists = rows_of(3, passes=40, listed=1.0)
    rng = np.random.default_rng(0)
    switch = rng.uniform(size=len(rows.log)) < -np.expm1(-0.1 / 4.0)
    found = fit_rest(replace(rows, track_id=np.cumsum(switch)), lists, nothing_else(), truth="partial")
    assert found.ids_last_s is not None
    assert _holds(found.ids_last_s, 4.0)
    assert found.untold["ghosts"] == "the truth is partial: entries about no true object may be other traffic"
    none = fit_rest(replace(rows, track_id=np.full(len(rows.log), -1)), lists, nothing_else(), truth="complete")
    assert none.untold["tracks"] == "the lists have no track ids"
    assert none.untold["ghosts"].startswith("no ghost in")


def test_what_is_written_is_a_pem() -> None:
    rows, lists, other = _ghosts(3, 0.5, 1.0, 4.0)
    found = fit_rest(
        replace(rows, class_ix=np.where(np.arange(len(rows.log)) % 9 == 0, 3, 6)), lists, other, truth="complete"
    )
    couple = {"detection": {"kind": "constant", "probability": 0.9}, **found.existence.keys()}
    pem = Pem.model_validate(strip_comments({"couples": [couple], **found.pem_keys()}))
    assert len(pem.ghosts) == 1
    assert pem.classes is not None
