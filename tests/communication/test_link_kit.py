"""The conformance kit for links: ours keep the rules, each rule is broken by one that is to be found."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from copem_replay.communication.latency import ConstantLatency, GammaLatency, LatencyModel, LognormalLatency
from copem_replay.communication.reception import (
    ConstantReception,
    GilbertElliott,
    RadioPath,
    ReceptionModel,
    Shadowing,
    TableReception,
)
from copem_replay.communication.testing import BrokenLinkRuleError, check_latency, check_reception
from copem_replay.core.tracks import Float


@pytest.mark.parametrize(
    "model",
    [
        ConstantLatency(s=0.1),
        GammaLatency(min_s=0.02, mean_s=0.06, shape=2.0),
        LognormalLatency(median_s=0.1, sigma=1.0),
    ],
)
def test_our_latencies_keep_the_rules(model: LatencyModel) -> None:
    check_latency(model)


@pytest.mark.parametrize(
    "model",
    [
        ConstantReception(probability=0.5),
        TableReception(distance_m=(0.0, 100.0), probability=[1.0, 0.2]),  # type: ignore[arg-type]
        Shadowing(half_at_m=100.0, exponent=2.27, sigma_db=3.0, blocked_db=9.0),
        GilbertElliott(bad_share=0.5, bad_lasts_s=1.0),
    ],
)
def test_our_receptions_keep_the_rules(model: ReceptionModel) -> None:
    check_reception(model)


class Late(LatencyModel):
    how: str

    def delays(self, uniform: Float) -> Float:
        if self.how == "inputs":
            uniform[:] = 0.5
        return {  # type: ignore[no-any-return]
            "answer": lambda: uniform[:-1],
            "inputs": lambda: uniform,
            "again": lambda: np.random.default_rng().random() + uniform,
            "alone": lambda: uniform + len(uniform),
            "order": lambda: 1 - uniform,
        }[self.how]()


class Heard(ReceptionModel):
    how: str

    def probability(self, path: RadioPath, noise: Any) -> Float:
        if self.how == "inputs":
            path.distance_m[:] = 1.0
        return {  # type: ignore[no-any-return]
            "answer": lambda: path.visible_share + 1,
            "inputs": lambda: path.visible_share,
            "again": lambda: np.random.default_rng().random() * path.visible_share,
            "alone": lambda: path.visible_share / len(path.visible_share),
            "one": lambda: np.where(path.distance_m < 999, 1.0, np.nan),
        }[self.how]()


@pytest.mark.parametrize("how", ["answer", "inputs", "again", "alone", "order"])
def test_each_rule_is_checked(how: str) -> None:
    with pytest.raises(BrokenLinkRuleError, match=f"^mine breaks the rule '{how}'") as caught:
        check_latency(Late(kind="mine", how=how))
    assert caught.value.rule == how
    if how != "order":
        with pytest.raises(BrokenLinkRuleError, match=f"^mine breaks the rule '{how}'"):
            check_reception(Heard(kind="mine", how=how))


def test_one_number_that_is_none_is_enough() -> None:
    with pytest.raises(BrokenLinkRuleError, match=r"^mine breaks the rule 'answer'"):
        check_reception(Heard(kind="mine", how="one"))
