"""Worth of units: Shapley's mean over all orders as an oracle, and curves against sets."""

from __future__ import annotations

from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from copem_replay.api.study import make_study
from copem_replay.core.errors import ExperimentError
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.extras.why.worth import UnitCurves, UnitWorths, compute_unit_worths, share_by_curves, share_by_sets
from tests.helpers.experiments import drive

SHARES = st.floats(0, 1)


def over_all_orders(units: tuple[str, ...], unknown_s: dict[frozenset[str], float]) -> list[float]:
    """The mean of what each unit spares when it comes, over all orders."""
    spared = dict.fromkeys(units, 0.0)
    orders = list(permutations(units))
    for order in orders:
        for k, unit in enumerate(order):
            spared[unit] += unknown_s[frozenset(order[:k])] - unknown_s[frozenset(order[: k + 1])]
    return [spared[unit] / len(orders) for unit in units]


@given(st.data())
def test_curves_and_sets_are_the_mean_over_all_orders(data: st.DataObject) -> None:
    n, spans = data.draw(st.integers(1, 5)), data.draw(st.integers(1, 3))
    units = tuple("abcde"[:n])
    q = np.array(data.draw(st.lists(SHARES, min_size=n * spans, max_size=n * spans))).reshape(n, spans)
    length_s = np.array(data.draw(st.lists(st.floats(0, 10), min_size=spans, max_size=spans)))
    unknown_s = {}
    for bits in range(2**n):
        some = [k for k in range(n) if bits >> k & 1]
        unknown_s[frozenset(units[k] for k in some)] = float(q[some].prod(axis=0) @ length_s)
    expected = over_all_orders(units, unknown_s)
    by_curves, by_sets = share_by_curves(units, [UnitCurves(length_s, q)]), share_by_sets(units, unknown_s)
    for found in (by_curves, by_sets):
        np.testing.assert_allclose(found.share_s, expected, atol=1e-9)
        assert found.share_s.sum() == pytest.approx(found.given_s - found.all_s, abs=1e-9)
    np.testing.assert_allclose(by_curves.alone_s, by_sets.alone_s, atol=1e-9)
    np.testing.assert_allclose(by_curves.left_out_s, by_sets.left_out_s, atol=1e-9)


def test_three_units_by_hand() -> None:
    """10 s in all; a and b are alike, and each knows in half of the cases; c knows nothing.

    a alone spares 5 s, after b half of what is left, 2.5 s: 3.75 s in the mean over both orders.
    """
    found = share_by_curves(("a", "b", "c"), [UnitCurves(np.array([10.0]), np.array([[0.5], [0.5], [1.0]]))])
    np.testing.assert_allclose(found.share_s, [3.75, 3.75, 0.0], atol=1e-12)
    np.testing.assert_allclose(found.alone_s, [5.0, 5.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(found.left_out_s, [2.5, 2.5, 0.0], atol=1e-12)
    assert (found.given_s, found.all_s) == pytest.approx((10.0, 2.5))


TEXT = """\
version: 1
logs: [drive.mcap]
pems:
  near: [{{when: {{range_m: [0, 40]}}, detection: {{kind: constant, probability: 1.0}}}}]
  far: [{{when: {{range_m: [0, 55.05]}}, detection: {{kind: constant, probability: 1.0}}}}]
  blind: [{{when: {{range_m: [0, 1]}}, detection: {{kind: constant, probability: 1.0}}}}]
units:
  ego: {{on: ego, height_m: 1.8, pem: near}}
  mast: {{at: [0.0, 0.1], height_m: 5.0, pem: far}}
  twin: {{at: [0.0, -0.1], height_m: 5.0, pem: far}}
  dark: {{at: [0.0, 9.0], height_m: 5.0, pem: blind}}
configurations: {{all: {{units: all{fusion}}}}}
measure: {{onset: {{kind: in_range, range_m: 60}}, horizon_s: 2, began: [crossed]}}
"""


def worths_of(folder: Path, fusion: str, units: tuple[str, ...] | None = None) -> UnitWorths:
    drive(folder / "drive.mcap")
    (folder / "e.yaml").write_text(TEXT.format(fusion=fusion))
    study = make_study(folder / "e.yaml")
    logs = [(one, resolve_for_log(study.experiment, one.scene.log)) for one in study.recordings]
    return compute_unit_worths(logs, "all", units)


@pytest.mark.parametrize("fusion", ["", ", fusion: {kind: union}"])
def test_a_drive_by_hand(tmp_path: Path, fusion: str) -> None:
    """The car, 60 m away at 1.0 s, comes 1 m nearer each .1 s. The ego knows it at 3.0 s, 40 m away, a mast at 1.5 s.

    So 2 s are unknown with the ego alone, .5 s with a mast: 1.5 s, shared by two that are alike.
    """
    found = worths_of(tmp_path, fusion)
    assert found.by_curves == (fusion == "")
    table = found.table.set_index("unit")
    assert table["share_s"].to_dict() == pytest.approx({"mast": 0.75, "twin": 0.75, "dark": 0.0}, abs=1e-9)
    assert table["alone_s"].to_dict() == pytest.approx({"mast": 1.5, "twin": 1.5, "dark": 0.0}, abs=1e-9)
    assert table["left_out_s"].abs().max() == pytest.approx(0.0, abs=1e-9)
    assert (found.given_s, found.all_s) == pytest.approx((2.0, 0.5))


@pytest.mark.parametrize(("of", "together"), [("pair", False), ("object", True)])
def test_masts_that_miss_together_are_no_product(tmp_path: Path, of: str, together: bool) -> None:
    """Two masts in one place that see the car half of the time, for good. What they miss together one spares as well as
    two; what each misses by itself the other may see.
    """
    memory = f"{{detection: [{{share: 1, correlation_s: always, of: {of}}}]}}"
    seen = "detection: {kind: constant, probability: 0.5}"
    text = TEXT.format(fusion="").replace(
        "far: [{when: {range_m: [0, 55.05]}, detection: {kind: constant, probability: 1.0}}]",
        f"far: {{couples: [{{when: {{range_m: [0, 55.05]}}, {seen}}}], memory: {memory}}}",
    )
    drive(tmp_path / "drive.mcap")
    (tmp_path / "e.yaml").write_text(text + "runs: 40\n")
    study = make_study(tmp_path / "e.yaml")
    found = compute_unit_worths(
        [(one, resolve_for_log(study.experiment, one.scene.log)) for one in study.recordings], "all"
    )
    table = found.table.set_index("unit")
    assert found.by_curves is not together
    if together:  # 1.5 s in the runs that see, half for each
        assert table["alone_s"]["mast"] > 0.3
        assert table["share_s"]["mast"] == pytest.approx(table["alone_s"]["mast"] / 2, abs=1e-9)
        assert table["left_out_s"]["mast"] == pytest.approx(0.0, abs=1e-9)
    else:  # alone 1.5 s in half of all cases; after the other half of what is left
        assert table["alone_s"]["mast"] == pytest.approx(0.75, abs=1e-9)
        assert table["left_out_s"]["mast"] == pytest.approx(0.375, abs=1e-9)
        assert table["share_s"]["mast"] == pytest.approx(0.5625, abs=1e-9)


@pytest.mark.parametrize(("of", "together"), [("unit", False), ("all", True)])
def test_masts_whose_lists_are_lost_together_are_no_product(tmp_path: Path, of: str, together: bool) -> None:
    """Two masts in one place whose links are dead for good in half of all runs: both in the same runs, or each in its
    own. What both give at once one spares as well as two.
    """
    memory = f"{{reception: [{{share: 1, correlation_s: always, of: {of}}}]}}"
    link = f"{{latency: 0, reception: {{kind: constant, probability: 0.5}}, memory: {memory}}}"
    text = TEXT.format(fusion=", link: {ego: none, default: radio}") + f"links: {{radio: {link}}}\nruns: 40\n"
    drive(tmp_path / "drive.mcap")
    (tmp_path / "e.yaml").write_text(text)
    study = make_study(tmp_path / "e.yaml")
    found = compute_unit_worths(
        [(one, resolve_for_log(study.experiment, one.scene.log)) for one in study.recordings], "all"
    )
    table = found.table.set_index("unit")
    assert not found.by_curves
    alive = table["alone_s"] / 1.5  # shares of the runs
    assert (alive[["mast", "twin"]].between(0.3, 0.7)).all()
    if together:
        assert table["share_s"]["mast"] == pytest.approx(table["alone_s"]["mast"] / 2, abs=1e-9)
        assert table["share_s"]["twin"] == pytest.approx(table["share_s"]["mast"], abs=1e-9)
        assert table["left_out_s"]["mast"] == pytest.approx(0.0, abs=1e-9)
    else:
        assert table["left_out_s"]["mast"] > 0.15
        assert found.given_s - found.all_s > table["alone_s"].max() + 0.15


def test_a_unit_that_is_not_there_is_refused_with_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(ExperimentError, match=r"no unit is named 'mats'; did you mean mast\?"):
        worths_of(tmp_path, "", ("mats",))


def test_many_units_without_curves_are_refused_with_the_count() -> None:
    study = make_study(Path("logs/tc016d.yaml"))
    one = study.experiment.configurations["coPEM:0s"]
    fused = one.model_copy(update={"fusion": study.experiment.configurations["PEM"].fusion, "issue_hz": None})
    measure = study.experiment.measure.model_copy(
        update={"confirm": study.experiment.measure.confirm.model_copy(update={"hits": 2, "of": 3})}
    )
    experiment = study.experiment.model_copy(update={"configurations": {"all": fused}, "measure": measure})
    logs = [(one, experiment) for one in study.recordings]
    with pytest.raises(ExperimentError, match="20 units have 1,048,575 sets to replay"):
        compute_unit_worths(logs, "all")
