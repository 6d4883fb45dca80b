"""Checks of your own latency and reception models, for your tests.

def test_mine():
    check_latency(Mine(kind="mine:Mine"))
"""

from __future__ import annotations

import numpy as np

from copem_replay.communication.latency import LatencyModel
from copem_replay.communication.reception import RadioPath, ReceptionModel
from copem_replay.core.tracks import Float

LINK_RULES = {
    "answer": "there is a number for each that is asked for: seconds of 0 or more, or a probability",
    "inputs": "what is handed over belongs to others, too: copy what you change",
    "again": "the same question has the same answer, to the last bit: draw nothing, keep nothing",
    "alone": "a list has the same number, whichever others stand beside it",
    "order": "delays never decrease as the uniform number grows: they invert a distribution",
}
"""The rules of `check_latency` and `check_reception`."""


class BrokenLinkRuleError(AssertionError):
    """A model breaks one of the LINK_RULES, `rule`.

    >>> cr.BrokenLinkRuleError("order", "mine", "0.2 s after 0.3 s").rule
    'order'
    """

    def __init__(self, rule: str, kind: str, finding: str) -> None:
        self.rule = rule
        super().__init__(f"{kind} breaks the rule {rule!r}: {LINK_RULES[rule]}. Found {finding}.")


def check_latency(model: LatencyModel) -> None:
    """Raise BrokenLinkRuleError for the first broken rule; return nothing where a latency model keeps all.

    >>> class Uniform(cr.LatencyModel):
    ...     def delays(self, uniform):
    ...         return 0.06 - 0.04 * uniform
    >>> cr.check_latency(Uniform(kind="my_package.links:Uniform"))
    Traceback (most recent call last):
    copem_replay.communication.testing.BrokenLinkRuleError: my_package.links:Uniform breaks the rule 'order': ...
    """
    uniform = np.concatenate([np.logspace(-15, -2, 60), np.linspace(0.01, 0.99, 199), 1 - np.logspace(-2, -15, 60)])

    def ask(part: Float) -> Float:
        return _ask_model(model.kind, model.delays(part), part.shape, np.inf)

    before = uniform.copy()
    delay_s = ask(uniform)
    _check_same(model.kind, "inputs", uniform, before)
    _check_same(model.kind, "again", ask(uniform), delay_s)
    _check_same(model.kind, "alone", np.concatenate([ask(uniform[k : k + 1]) for k in range(len(uniform))]), delay_s)
    if (fall := np.diff(delay_s)).min() < 0:
        k = int(np.argmin(fall))
        raise BrokenLinkRuleError(
            "order", model.kind, f"{delay_s[k + 1]:g} s at {uniform[k + 1]:g}, {delay_s[k]:g} s before"
        )


def check_reception(model: ReceptionModel) -> None:
    """Raise BrokenLinkRuleError for the first broken rule; return nothing where a reception model keeps all.

    >>> class Within(cr.ReceptionModel):
    ...     def probability(self, path, noise):
    ...         return (path.distance_m < 100).astype(float)
    >>> cr.check_reception(Within(kind="my_package.links:Within"))
    """
    distance_m, share = np.meshgrid([0.0, 1.0, 30.0, 100.0, 999.0, np.inf], [0.0, 0.03, 0.5, 1.0])
    path = RadioPath(distance_m.ravel(), share.ravel())
    rows = np.arange(len(path.distance_m))

    def ask(part_rows: np.ndarray) -> Float:
        def noise(name: str, *, lasts_s: float | None = None) -> Float:
            return (((part_rows + 1) * 0.381966) % 1)[None]

        part = RadioPath(path.distance_m[part_rows], path.visible_share[part_rows])
        probability_found = _ask_model(model.kind, model.probability(part, noise), (1, len(part_rows)), 1.0)
        for name in ("distance_m", "visible_share"):
            _check_same(model.kind, "inputs", getattr(part, name), getattr(path, name)[part_rows])
        return probability_found

    probability = ask(rows)
    _check_same(model.kind, "again", ask(rows), probability)
    _check_same(model.kind, "alone", np.concatenate([ask(rows[k : k + 1]) for k in rows]), probability)


def _ask_model(kind: str, answer: object, shape: tuple[int, ...], most: float) -> Float:
    """The answer of a model (K,). Raises BrokenLinkRuleError where shape or numbers are wrong."""
    if not isinstance(answer, np.ndarray) or answer.shape not in (shape, shape[-1:]):
        shape_found = answer.shape if isinstance(answer, np.ndarray) else type(answer).__name__
        raise BrokenLinkRuleError("answer", kind, f"shape {shape_found}, expected {shape}")
    if answer.dtype.kind not in "fiu" or not ((answer >= 0) & (answer <= most) & np.isfinite(answer)).all():
        raise BrokenLinkRuleError("answer", kind, f"what is not within 0 … {most:g}")
    return np.array(answer, dtype=float).reshape(shape[-1:])


def _check_same(kind: str, rule: str, actual: Float, expected: Float) -> None:
    if not np.array_equal(actual, expected):
        k = int(np.argmax(actual != expected))
        raise BrokenLinkRuleError(rule, kind, f"{actual[k]} in the place of {expected[k]}")
