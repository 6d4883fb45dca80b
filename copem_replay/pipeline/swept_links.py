"""Links along a sweep: how much they lose, and how long at a time. With common draws more loss only removes lists."""

from __future__ import annotations

from copem_replay.communication.link import LinkModel
from copem_replay.communication.radio import Radio
from copem_replay.communication.reception import ConstantReception, GilbertElliott

SHORTEST_S = 0.001
"""A burst of 0 s is one of a millisecond: new in every list."""


def varies(link: LinkModel | None, kind: str) -> bool:
    """Whether a link has what a sweep of `loss` or `burst_s` varies."""
    if not isinstance(link, Radio):
        return False
    if isinstance(link.reception, GilbertElliott):
        return True
    return isinstance(link.reception, ConstantReception) if kind == "loss" else bool(link.memory.get("reception"))


def link_at(link: LinkModel, kind: str, value: float) -> LinkModel:
    """A link at one value of a sweep; as it is where the sweep does not vary it."""
    if kind not in ("loss", "burst_s") or not isinstance(link, Radio) or not varies(link, kind):
        return link
    reception, changed = link.reception, link.reception
    if kind == "loss" and isinstance(reception, GilbertElliott):
        changed = reception.model_copy(update={"bad_share": _bad_share(reception, value)})
    elif kind == "loss":
        changed = reception.model_copy(update={"probability_": 1 - value})
    elif isinstance(reception, GilbertElliott):
        changed = reception.model_copy(update={"bad_lasts_s": max(float(value), SHORTEST_S)})
    else:
        first, *others = link.memory["reception"]
        parts = (first.model_copy(update={"correlation_s": float(value)}), *others)
        return link.model_copy(update={"memory": link.memory | {"reception": parts}})
    return link.model_copy(update={"reception": changed})


def _bad_share(reception: GilbertElliott, loss: float) -> float:
    """The share of time in the bad state with which so many lists are lost on average, 0 … 1."""
    good, bad = reception.good_loss, reception.bad_loss
    return min(max((loss - good) / (bad - good), 0.0), 1.0) if bad != good else reception.bad_share
