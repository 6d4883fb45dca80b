"""What is wrong between an experiment and one log."""

from __future__ import annotations

from collections.abc import Iterator

from copem_replay.core.yaml import Key
from copem_replay.experiment.cross_references import NO_EGO
from copem_replay.experiment.schema import Experiment
from copem_replay.io.recording import Recording, moving_ids
from copem_replay.metrics.onset import Requires
from copem_replay.perception.config import Carriers
from copem_replay.perception.sensor_poses import solid_around


def against_log(experiment: Experiment, recording: Recording, *, known: bool = False) -> Iterator[tuple[Key, str]]:
    """Problems of an experiment with one log, no ego, carriers that are not in it.

    `known`: whether there are others already, of which an onset may be a consequence.
    """
    scene = recording.scene
    none = scene.ego_ix < 0
    if none and experiment.ego is None:
        yield (
            ("ego",),
            f"no ego vehicle in this log{_host(recording)}; give `ego: <object id>` or --ego ID "
            f"({moving_ids(scene)}), or `ego: none` with `distance_to: <unit>`",
        )
    if experiment.braking is not None and not none and not scene.ego_sized:
        yield ("braking",), "the size of the ego is not known; give `ego: {topic: …, size_m: [length, width, height]}`"
    studied = not none or experiment.ego != NO_EGO  # an ego that is sought and not there is said once
    if not studied and experiment.measure.distance_to == "ego":
        yield ("measure", "distance_to"), "`ego: none` needs `distance_to: <unit>` to measure distances from"
    within = experiment.measure.objects.within
    if not studied and within is not None and within.of_ego:
        yield ("measure", "objects", "within"), "no ego in this study, and so no path of it; give `polygon_m`"
    for name, unit in experiment.units.items():
        if unit.on == "ego":
            if not studied:
                yield ("units", name, "on"), "no ego in this study to carry the unit"
        elif isinstance(unit.on, Carriers):
            taken = [one for one in scene.object_ids if f"{name}:{one}" in experiment.units]
            if taken:
                yield ("units", f"{name}:{taken[0]}"), f"this is the name of {name} on object {taken[0]}"
        elif unit.on is not None and unit.on not in scene.object_number:
            yield ("units", name, "on"), f"no object {unit.on!r} in the log; there are {moving_ids(scene)}"
    yield from _inside_solids(experiment, recording)
    onset = experiment.measure.onset
    if onset.requires is not Requires.UNIT_ON_EGO or known:
        return
    if not studied:
        yield ("measure", "onset"), f"{onset.kind} needs an ego; without one use line_of_sight_any"
    elif not none:
        on_ego = ("ego", scene.object_ids[scene.ego_ix])
        if not any(unit.on in on_ego for unit in experiment.units.values()):
            yield ("measure", "onset"), f"{onset.kind} needs a unit on the ego; or use line_of_sight_any"


def _inside_solids(experiment: Experiment, recording: Recording) -> Iterator[tuple[Key, str]]:
    for name, unit in experiment.units.items():
        found = solid_around(recording.scene, recording.truth, unit, experiment.obstacles)
        if found is not None:
            solid, depth_m = found
            yield (
                ("units", name, "at"),
                f"{name} stands {depth_m:.2g} m inside {solid.name} (z {solid.bottom_m:.4g} … {solid.top_m:.4g} m): it "
                "would look through it; expected a place beside it, or `height_m` above its top",
            )


def _host(recording: Recording) -> str:
    if recording.host_id is None:
        return " (host_vehicle_id is not set)"
    return f" (its host_vehicle_id {recording.host_id!r} is no moving object of it)"
