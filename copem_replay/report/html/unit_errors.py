"""Errors of units beside those that their PEMs make in single entries, a sentence each. Empty where there are none."""

from __future__ import annotations

from copem_replay.experiment.schema import Experiment, Unit
from copem_replay.perception.pem.model import Pem


def unit_errors(experiment: Experiment) -> str:
    """Sentences for the setting of a study, a blank before each."""
    said = ""
    for name, unit in experiment.modelled.items():
        errors = [*_of_unit(unit), *_of_pem(experiment.pems[str(unit.pem)])]
        if errors:
            said += f" Unit {name}: {', '.join(errors)}."
    return said


def _of_unit(unit: Unit) -> list[str]:
    said = []
    if unit.outages is not None:
        said.append(
            f"no lists {100 * unit.outages.down_share:g} % of the time, {unit.outages.lasts_s:g} s at a time on average"
        )
    if unit.placed is not None:
        said.append(
            f"wrong about its own place (σ {unit.placed.position_sigma_m:g} m) "
            f"and heading (σ {unit.placed.yaw_sigma_deg:g}°)"
        )
    if unit.clock is not None:
        said.append(
            f"a clock that is off (σ {unit.clock.offset_sigma_s:g} s and {unit.clock.drift_sigma_ppm:g} ppm), "
            "which ideal fusion ignores"
        )
    return said


def _of_pem(pem: Pem) -> list[str]:
    said = []
    if pem.ghosts:
        said.append(
            f"{pem.ghosts_in_list:g} false entries in a list on average, of which neither the truth nor ideal "
            "fusion knows"
        )
    if pem.classes is not None and pem.classes.confusion:
        said.append(f"mistakes {' and '.join(pem.classes.confusion)} for others")
    if pem.tracks is not None:
        said.append(f"a track id that switches every {pem.tracks.lasts_s:g} s")
    return said
