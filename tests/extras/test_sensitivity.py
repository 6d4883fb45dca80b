"""How much an order hangs on the models: scaled odds and errors by hand, orders of made-up times."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from copem_replay.api.study import make_study
from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.extras.why.sensitivity import AS_IT_IS, VARIATIONS, compare_orders, describe_orders, vary_pems
from tests.helpers.experiments import changed, drive


def times(**of_runs: tuple[str, list[float], list[float]]) -> pd.DataFrame:
    rows = []
    for configuration, (variation, before, after) in of_runs.items():
        for when, values in ((AS_IT_IS, before), (variation, after)):
            rows += [(configuration, run, value, when) for run, value in enumerate(values)]
    return pd.DataFrame(rows, columns=["configuration", "run", "unknown_s", "variation"])


def test_an_order_changes_beyond_chance_or_within_it() -> None:
    """a before b by 1.0 ± 0, after it by 1.0 ± 0; c before b by .9 ± .3, three errors; a before c by .1 ± .3."""
    varied = times(
        a=("odds × 2", [1.0, 1.0], [3.0, 3.0]),
        b=("odds × 2", [2.0, 2.0], [2.0, 2.0]),
        c=("odds × 2", [1.4, 0.8], [2.5, 2.5]),
    )
    orders = compare_orders(varied).set_index(["better", "worse"])
    assert orders["beyond"].to_dict() == {("a", "b"): True, ("a", "c"): False, ("c", "b"): True}
    ab = orders.loc[("a", "b")]
    assert (ab["difference_s"], ab["varied_s"], ab["error_s"]) == pytest.approx((1.0, -1.0, 0.0))
    ac = orders.loc[("a", "c")]
    assert (ac["difference_s"], ac["error_s"]) == pytest.approx((0.1, 0.3))
    assert describe_orders(varied, orders.reset_index()) == [
        "odds × 2: the order of 1 of 3 pairs stays (1 more change places within chance); "
        "a falls behind b, c falls behind b"
    ]


def test_odds_are_scaled_and_certainty_is_not(tmp_path: Path) -> None:
    """p = .5 has odds 1: twice is 2 to 1, p = 2/3; half is p = 1/3. p = 1 stays."""
    drive(tmp_path / "drive.mcap")
    (tmp_path / "e.yaml").write_text(changed())
    experiment = make_study(tmp_path / "e.yaml").experiment
    view = ViewGeometry(*np.full((10, 3), 1.0))
    for variation, expected in (("odds × 2", 2 / 3), ("odds × ½", 1 / 3)):
        (couple,) = VARIATIONS[variation](experiment).pems["onboard"].couples
        assert couple.detection.probability(view) == pytest.approx(np.full(3, expected))


def test_errors_are_half_as_large_again_with_their_variances(tmp_path: Path) -> None:
    drive(tmp_path / "drive.mcap")
    union = "configurations: {PEM: {units: [ego], fusion: {kind: union}}, coPEM: {units: all, fusion: {kind: union}}}"
    text = "\n".join(line for line in changed().splitlines() if not line.startswith(("  GT:", "  PEM:", "  coPEM:")))
    (tmp_path / "e.yaml").write_text(text.replace("configurations:", union) + "\n")
    experiment = make_study(tmp_path / "e.yaml").experiment
    (before,), (after,) = (
        vary(experiment).pems["onboard"].couples for vary in (VARIATIONS[AS_IT_IS], VARIATIONS["errors × 1.5"])
    )
    view = ViewGeometry(*np.full((10, 2), 1.0))
    assert before.error is not None
    assert after.error is not None
    small, large = (one.perturb(view, lambda name: np.ones((4, 2))) for one in (before.error, after.error))
    np.testing.assert_allclose(large.east_m, 1.5 * small.east_m)
    np.testing.assert_allclose(large.cov_ee_m2, 2.25 * small.cov_ee_m2)


def test_what_changes_nothing_is_left_out(tmp_path: Path) -> None:
    """No detection lasts, and ideal fusion does not go by errors: odds alone are varied."""
    drive(tmp_path / "drive.mcap")
    (tmp_path / "e.yaml").write_text(changed())
    study = make_study(tmp_path / "e.yaml")
    logs = [(one, resolve_for_log(study.experiment, one.scene.log)) for one in study.recordings]
    varied = vary_pems(logs)
    assert varied["variation"].unique().tolist() == [AS_IT_IS, "odds × ½", "odds × 2"]
    assert sorted(varied["configuration"].unique()) == ["PEM", "coPEM"]
    means = varied.groupby(["variation", "configuration"])["unknown_s"].mean()
    for name in ("PEM", "coPEM"):
        assert means["odds × 2", name] <= means[AS_IT_IS, name] <= means["odds × ½", name]


def test_memory_lasts_twice_as_long() -> None:
    experiment = make_study(Path("logs/crossing_memory.yaml")).experiment
    longer = VARIATIONS["memory × 2"](experiment)
    times_s = [
        [part.correlation_s for pem in one.pems.values() for part in pem.memory.get("detection", ())]
        for one in (experiment, longer)
    ]
    assert len(times_s[0]) > 0
    assert times_s[1] == [s if isinstance(s, str) else 2 * s for s in times_s[0]]
