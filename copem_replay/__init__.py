"""Replay of recorded traffic through (cooperative) perception error models.

    import copem_replay as cr

    result = cr.run("experiment.yaml")
    result.summary
    result.save("out/experiment")

A name is imported when it is first used.
"""

from __future__ import annotations

import importlib as _importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    __version__: str
    from copem_replay.api import plot
    from copem_replay.api.plot import write_figures
    from copem_replay.api.recordings import (
        draft_experiment,
        inspect_recording,
        read_lists,
        read_recording,
        read_recordings,
    )
    from copem_replay.api.results import compare, judge, load_results, view, write_report
    from copem_replay.api.run import fused_tracks, observations, run
    from copem_replay.api.study import load_experiment
    from copem_replay.communication.latency import LatencyModel
    from copem_replay.communication.link import LinkModel, SentLists
    from copem_replay.communication.reception import RadioPath, ReceptionModel
    from copem_replay.communication.testing import LINK_RULES, BrokenLinkRuleError, check_latency, check_reception
    from copem_replay.core.errors import (
        CopemError,
        EmptyWindowError,
        ExperimentError,
        InputError,
        OutputError,
        RecordingError,
    )
    from copem_replay.core.fused_tracks import FusedTracks
    from copem_replay.core.object_list import Inputs, ObjectLists, entries_of
    from copem_replay.core.tracks import CLASSES, Scene, Tracks
    from copem_replay.core.view_geometry import Errors, ViewGeometry
    from copem_replay.experiment.schema import Configuration, Experiment, Unit
    from copem_replay.extras.film.film import write_film
    from copem_replay.extras.fitting.api import FittedPem, fit
    from copem_replay.extras.history.history import write_history
    from copem_replay.extras.require.api import Requirement, require
    from copem_replay.extras.require.outputs import write_requirement
    from copem_replay.extras.why.api import Explanation, why
    from copem_replay.fusion.interface import Inbox, ListFusion, StepFusion
    from copem_replay.fusion.testing import FUSION_RULES, NonconformingError, check_fusion
    from copem_replay.io.recording import Recording
    from copem_replay.metrics.braking.driver import Driver, Reaction
    from copem_replay.metrics.config import Measure
    from copem_replay.metrics.gospa import gospa, ospa
    from copem_replay.metrics.metric import RowMetric
    from copem_replay.metrics.onset import Onset
    from copem_replay.metrics.survival import cumulative_incidence
    from copem_replay.perception.pem.detection import DetectionModel
    from copem_replay.perception.pem.error import ErrorModel
    from copem_replay.perception.visibility import VisibilityModel
    from copem_replay.results.compare import Comparison
    from copem_replay.results.read import Results
    from copem_replay.results.verdicts import Judgement

__all__ = [
    "CLASSES",
    "FUSION_RULES",
    "LINK_RULES",
    "BrokenLinkRuleError",
    "Comparison",
    "Configuration",
    "CopemError",
    "DetectionModel",
    "Driver",
    "EmptyWindowError",
    "ErrorModel",
    "Errors",
    "Experiment",
    "ExperimentError",
    "Explanation",
    "FittedPem",
    "FusedTracks",
    "Inbox",
    "InputError",
    "Inputs",
    "Judgement",
    "LatencyModel",
    "LinkModel",
    "ListFusion",
    "Measure",
    "NonconformingError",
    "ObjectLists",
    "Onset",
    "OutputError",
    "RadioPath",
    "Reaction",
    "ReceptionModel",
    "Recording",
    "RecordingError",
    "Requirement",
    "Results",
    "RowMetric",
    "Scene",
    "SentLists",
    "StepFusion",
    "Tracks",
    "Unit",
    "ViewGeometry",
    "VisibilityModel",
    "check_fusion",
    "check_latency",
    "check_reception",
    "compare",
    "cumulative_incidence",
    "draft_experiment",
    "entries_of",
    "fit",
    "fused_tracks",
    "gospa",
    "inspect_recording",
    "judge",
    "load_experiment",
    "load_results",
    "observations",
    "ospa",
    "plot",
    "read_lists",
    "read_recording",
    "read_recordings",
    "require",
    "run",
    "view",
    "why",
    "write_figures",
    "write_film",
    "write_history",
    "write_report",
    "write_requirement",
]

_PLACES = {
    "api": "plot",
    "api.plot": "write_figures",
    "api.recordings": "draft_experiment inspect_recording read_lists read_recording read_recordings",
    "api.results": "compare judge load_results view write_report",
    "api.run": "fused_tracks observations run",
    "api.study": "load_experiment",
    "communication.latency": "LatencyModel",
    "communication.link": "LinkModel SentLists",
    "communication.reception": "RadioPath ReceptionModel",
    "communication.testing": "LINK_RULES BrokenLinkRuleError check_latency check_reception",
    "core.errors": "CopemError EmptyWindowError ExperimentError InputError OutputError RecordingError",
    "core.fused_tracks": "FusedTracks",
    "core.object_list": "Inputs ObjectLists entries_of",
    "core.tracks": "CLASSES Scene Tracks",
    "core.view_geometry": "Errors ViewGeometry",
    "experiment.schema": "Configuration Experiment Unit",
    "fusion.interface": "Inbox ListFusion StepFusion",
    "fusion.testing": "FUSION_RULES NonconformingError check_fusion",
    "io.recording": "Recording",
    "metrics.braking.driver": "Driver Reaction",
    "metrics.config": "Measure",
    "metrics.metric": "RowMetric",
    "metrics.onset": "Onset",
    "metrics.gospa": "gospa ospa",
    "metrics.survival": "cumulative_incidence",
    "perception.pem.detection": "DetectionModel",
    "perception.pem.error": "ErrorModel",
    "perception.visibility": "VisibilityModel",
    "results.compare": "Comparison",
    "results.read": "Results",
    "results.verdicts": "Judgement",
}
"""Exported names by the module that defines them."""
_MODULE = {name: f"{__name__}.{module}" for module, names in _PLACES.items() for name in names.split()}


if not TYPE_CHECKING:  # with it type checkers would accept every name

    def __getattr__(name: str) -> object:
        if name == "__version__":
            return _importlib.import_module("importlib.metadata").version("copem-replay")
        extras = _importlib.import_module("copem_replay.core.extras")
        if name in extras.EXTRAS["name of the API"]:
            return extras.load_extra("name of the API", name)
        if name not in _MODULE:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        if name == "plot":
            return _importlib.import_module(f"{_MODULE[name]}.{name}")
        return getattr(_importlib.import_module(_MODULE[name]), name)


def __dir__() -> list[str]:
    return sorted({*__all__, "__version__", *(name for name in globals() if name.startswith("__"))})
