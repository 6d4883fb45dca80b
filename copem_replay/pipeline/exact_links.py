"""Links without a draw: when lists arrive, and how probably, where exact times are asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from copem_replay.communication.link import UnitLinks, taken_in, transmit
from copem_replay.communication.radio import Radio
from copem_replay.communication.ready import when_ready
from copem_replay.communication.reception import ConstantReception, RadioPath, probability_of
from copem_replay.core.errors import ExperimentError
from copem_replay.core.random import CounterRng
from copem_replay.core.tracks import TRUTH, Float, Tracks
from copem_replay.pipeline.expansion import ExpandedExperiment
from copem_replay.pipeline.prepare import Replay


def exactly_heard(replay: Replay, experiment: ExpandedExperiment, name: str, hits: int) -> tuple[Tracks, Float]:
    """What reaches the receiver of a configuration if no list is lost, and how probably each list (F,) is not.

    `hits` confirm an object. Raises ExperimentError where drawn arrivals have no closed form.
    """
    configuration, units = experiment.configurations[name], set(experiment.units_of(experiment.configurations[name]))
    for unit in sorted(units & experiment.ready.keys()):
        if experiment.ready[unit].fixed_s is None:
            why = "`ready` is drawn, and then lists have no common instants; make it constant"
            raise _refused(name, f"unit {unit}: {why}")
    of_truth = configuration.units == TRUTH
    seen = replay.truth if of_truth else replay.measured.tracks
    if not of_truth:
        rng = CounterRng(experiment.seed, replay.scene.log)
        seen = when_ready(seen, experiment.ready, rng, np.zeros(1, dtype=np.int64))
    received = np.ones(len(seen.stamp_ns))
    sure: list[UnitLinks] = []
    for one in experiment.links_of(name):
        if one.link.drawn:
            assert isinstance(one.link, Radio)  # links of the user's own are not drawn
            _check(one, one.link, name, hits)
            share = _received(replay, seen, one, one.link, name)
            if one.units is not None:
                mine = np.array([unit in one.units for unit in seen.units], dtype=bool)[seen.frame_unit_ix]
                share = np.where(mine, share, 1.0)
            received *= share
            one = replace(one, link=one.link.model_copy(update={"reception": ConstantReception()}))
        sure.append(one)
    return taken_in(transmit(seen, sure, None if of_truth else units), configuration.issue_hz), received


def _check(one: UnitLinks, link: Radio, name: str, hits: int) -> None:
    of = f"link {one.where.removeprefix('links.')}"
    if link.latency.fixed_s is None:
        raise _refused(name, f"{of}: latency is drawn, and then lists have no common instants; use a constant one")
    if link.channel is not None:
        raise _refused(name, f"{of}: lists queue, each as long as the lists before it are; use no `channel`")
    if link.memory.get("reception"):
        raise _refused(name, f"{of}: losses last, and lists are then lost together; use no `memory`")
    if hits > 1:
        why = "a lost list is no capture to the receiver, and confirmation by several hits then has no closed form"
        raise _refused(name, f"{of}: {why}; confirm with one hit")


def _received(replay: Replay, seen: Tracks, one: UnitLinks, link: Radio, name: str) -> Float:
    """(F,) how probably each list arrives."""
    F = len(seen.stamp_ns)
    path = replay.paths if link.reception.by_path else None
    nowhere = np.full(F, np.nan)
    path = RadioPath(nowhere, nowhere) if path is None else RadioPath(path.distance_m[:F], path.visible_share[:F])

    asked: list[str] = []

    def noise(name: str, *, lasts_s: float | None = None) -> Float:
        asked.append(name)
        return np.full((1, F), 0.5)

    share = probability_of(link.reception, path, noise, f"{one.where}.reception")
    if asked:
        why = "losses come in bursts, and lists are then lost together; use a constant reception"
        raise _refused(name, f"link {one.where.removeprefix('links.')}: {why}")
    return share


def _refused(name: str, why: str) -> ExperimentError:
    return ExperimentError(f"exact: configuration {name}: {why}, or leave exact out")
