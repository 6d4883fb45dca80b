"""Where times at equal ghosts say nothing, and why.

Ghosts are here those that were about nobody at the instant they tell of either: a late list that was right then is not
cleaner for being left out. A side is *thinned* where it has more of them than is asked for.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from copem_replay.results.compare.configuration_data import ConfigurationData, Ghosts, StepData
from copem_replay.results.compare.metrics import kept_at, own_rate

FEWEST_GHOSTS = 10
"""Fewer entries than this decide nothing (chosen)."""
TRUTH = "the baseline is the truth, which has no ghosts"
ONE_VALUE = "all entries claim the same existence, so that none is left out before the others"
FEW = f"fewer than {FEWEST_GHOSTS} ghosts would decide"


def why_not(
    first: ConfigurationData, second: ConfigurationData, per_min: float | None, *, asked: bool, truth: bool
) -> str | None:
    """Why the times of two sides at so many ghosts per minute are no measure; None: they are, or there are none.

    `asked`: whether that rate was asked for, else it is the second side's own. `truth`: whether that one is the truth.
    """
    if per_min is None or any(side.ghosts is None or side.steps is None for side in (first, second)):
        return None
    if truth:
        return TRUTH
    assert second.ghosts is not None
    if not asked and second.ghosts.at[second.ghosts.there, :1].sum() < FEWEST_GHOSTS:
        return FEW
    for side in (first, second):
        assert side.ghosts is not None
        assert side.steps is not None
        own, kept = own_rate(side.ghosts), kept_at(side.ghosts, per_min)
        if own is None or kept is None or own <= per_min * (1 + 1e-9):
            continue
        if not _tells_apart(side.ghosts, side.steps):
            return ONE_VALUE if side is first else f"of the baseline, {ONE_VALUE}"
        minutes = float(side.ghosts.minutes[side.ghosts.there].sum())
        if kept.false_positives_per_min * minutes < FEWEST_GHOSTS * (1 - 1e-9):
            return FEW
    return None


def notes_on_equal_ghosts(reasons: Mapping[str, str | None]) -> Iterator[str]:
    """`reasons`: by label."""
    for reason in dict.fromkeys(reason for reason in reasons.values() if reason is not None):
        labels = ", ".join(label for label, why in reasons.items() if why == reason)
        yield f"{labels}: no ttd_rmst_s_equal_ghosts: {reason}"


def _tells_apart(ghosts: Ghosts, steps: StepData) -> bool:
    """Whether any threshold leaves out some of the entries but not all."""
    counts = ghosts.at[ghosts.there].sum(axis=0)
    for existence, count in zip(ghosts.existence.tolist(), counts.tolist(), strict=True):
        kept = steps.existence >= existence
        all_left, none_left = count == counts[0] and kept.all(), count == 0 and not kept.any()
        if not (all_left or none_left):
            return True
    return False
