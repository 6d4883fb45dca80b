"""All lists at once, through what takes them chunk by chunk."""

from __future__ import annotations

from copem_replay.core.object_list import ObjectLists
from copem_replay.core.tracks import Bool, Float, Scene, Tracks
from copem_replay.metrics.accuracy.aggregator import Aggregator
from copem_replay.metrics.accuracy.statistics import Accuracy, AccuracySettings
from copem_replay.metrics.config import Confirm
from copem_replay.metrics.detection.by_match import DetectionSteps, FirstMatches
from copem_replay.metrics.detection.by_truth_id import FirstDetections
from copem_replay.metrics.detection.turns import Turns
from copem_replay.metrics.episodes import Episodes, Reference
from copem_replay.metrics.matching import Matches
from copem_replay.metrics.origin import Origins


def assess(
    lists: ObjectLists,
    about: Matches,
    now: Matches,
    issue_s: Float,
    world: Tracks,
    scene: Scene,
    episodes: Episodes,
    stay_from_s: Float,
    reference: Reference,
    measured_class: Bool,
    *,
    settings: AccuracySettings,
) -> Accuracy:
    """Add up how far off all lists are at once: what `Aggregator` is given."""
    whole = Aggregator(
        issue_s, scene, episodes, stay_from_s, reference, measured_class, settings=settings, runs=len(lists.start)
    )
    whole.add(lists, about, now, world)
    return whole.result()


def first_matches(
    lists: ObjectLists,
    matches: Matches,
    issue_s: Float,
    episodes: Episodes,
    *,
    confirm: Confirm,
    count_earlier: bool,
    turns: Turns | None,
    origins: Origins,
) -> tuple[FirstDetections, DetectionSteps]:
    """The same of all lists at once."""
    whole = FirstMatches(episodes, runs=len(lists.start), confirm=confirm, count_earlier=count_earlier, turns=turns)
    whole.add(lists, matches, issue_s, origins)
    return whole.result()
