"""On air: the input of drawn links beside the lists themselves: one run's numbers, the way to the ego, and sizes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.communication.link import Air, KeptDraws
from copem_replay.communication.radio import Radio
from copem_replay.communication.reception import RadioPath
from copem_replay.core.draws import Draws
from copem_replay.core.errors import ExperimentError
from copem_replay.core.lasting import ListTimes
from copem_replay.core.random import CounterRng, RandomKey, object_words, stable_hash
from copem_replay.core.tracks import TRUTH, Float, Int, Scene, Tracks

if TYPE_CHECKING:
    from copem_replay.perception.observation import Observations
    from copem_replay.pipeline.expansion import ExpandedExperiment
    from copem_replay.pipeline.sent import SentObjects


@dataclass(frozen=True)
class OnAir:
    """Of the lists (F,) of all units in one run: the way of each to the ego, and how many entries it has.

    None where no link asks for it. `sent`: what of them units send; None: every unit sends what it lists. `kept`: what
    links drew for lists of this log.
    """

    run: int
    path: RadioPath | None
    objects: Int | None
    sent: SentObjects | None = None
    kept: KeptDraws = field(default_factory=KeptDraws)

    def of(self, lists: Tracks, scene: Scene, seed: int) -> Air:
        """What links of these lists go by; of the truth's there is no way, and no size."""
        units = lists.units != (TRUTH,)
        F = len(lists.stamp_ns)
        # By sender, receiver and capture.
        word = object_words([scene.object_ids[scene.ego_ix]])[0] if scene.ego_ix >= 0 else stable_hash("everyone")
        random_key = RandomKey(lists.units, lists.frame_unit_ix, np.full(F, word, dtype=np.uint64), lists.stamp_ns)
        times = ListTimes(lists.stamp_ns, lists.frame_unit_ix, np.arange(F))
        draws = Draws(CounterRng(seed, scene.log), random_key, times, np.array([self.run]))
        return Air(draws, self.path if units else None, self.objects if units else None, self.kept)


def asks_for_path(experiment: ExpandedExperiment, scene: Scene) -> bool:
    """Whether a link goes by how far away the receiver is. Raises ExperimentError where that is not known."""
    asked = False
    for name, configuration in experiment.configurations.items():
        for one in experiment.links_of(name):
            if not (isinstance(one.link, Radio) and one.link.loses and one.link.reception.by_path):
                continue
            asked, where = True, f"{scene.log}: {one.where}.reception: {one.link.reception.kind}"
            if scene.ego_ix < 0:
                raise ExperimentError(
                    f"{where}: the distance to a receiver is unknown, for the log has no ego; use constant"
                )
            units = experiment.units_of(configuration) if one.units is None else one.units
            far = [TRUTH] if configuration.units == TRUTH else sorted(experiment.recorded.keys() & set(units))
            if far:
                source = "of the truth" if far == [TRUTH] else f"of unit {far[0]}, source lists are recorded,"
                raise ExperimentError(f"{where}: the distance {source} to a receiver is not known; use constant")
    return asked


def has_channel(experiment: ExpandedExperiment) -> bool:
    """Whether a link goes by how long lists are. Raises ExperimentError for the truth, which no unit sends."""
    found = False
    for name, configuration in experiment.configurations.items():
        for one in experiment.links_of(name):
            if isinstance(one.link, Radio) and one.link.channel is not None:
                found = True
                if configuration.units == TRUTH:
                    raise ExperimentError(f"configurations.{name}.link: the truth is sent by no unit; use no `channel`")
    return found


def paths(of_ego: Observations, scene: Scene, experiment: ExpandedExperiment, lists: Tracks) -> RadioPath:
    """The way of each list (F,) of all units. `of_ego`: how the ego shows from the modelled units.

    `lists`: those of all units, the modelled ones' first.
    """
    F = len(lists.stamp_ns)
    distance_m: Float = np.full(F, np.inf)
    share: Float = np.zeros(F)
    distance_m[of_ego.tracks.frame_ix] = of_ego.view.range_m
    share[of_ego.tracks.frame_ix] = of_ego.view.visible_share
    ego = scene.object_ids[scene.ego_ix]
    aboard = [name for name, unit in experiment.modelled.items() if unit.on in ("ego", ego)]
    here = np.array([name in aboard for name in lists.units], dtype=bool)[lists.frame_unit_ix]
    far = np.array([name in experiment.recorded for name in lists.units], dtype=bool)[lists.frame_unit_ix]
    distance_m[here], share[here] = 0.0, 1.0
    distance_m[far] = share[far] = np.nan
    return RadioPath(distance_m, share)
