"""What was compared, in words: the question, and each configuration."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from copem_replay.core.components import Component
from copem_replay.core.text import counted
from copem_replay.core.tracks import TRUTH
from copem_replay.experiment.schema import Configuration, Experiment
from copem_replay.io.window import in_words
from copem_replay.report.html.markup import Html, table, tag
from copem_replay.report.html.tables import named
from copem_replay.report.html.unit_errors import unit_errors

if TYPE_CHECKING:
    from copem_replay.report.html.study import Study

_CLASSES = {"vru": "vulnerable road user", "vehicles": "vehicle"}
_NAMED = 6
"""Units, logs or objects that are named one by one, at most (chosen)."""


def some(names: Sequence[str]) -> str:
    """Names, the first of them where they are many."""
    shown = ", ".join(names[:_NAMED])
    return shown if len(names) <= _NAMED else f"{shown} and {len(names) - _NAMED} more"


def together(names: Sequence[str]) -> str:
    """`A, B and C`; the first of them where they are many."""
    return f"{some(names[:-1])} and {names[-1]}" if 1 < len(names) <= _NAMED else some(names)


def logs(study: Study) -> str:
    """Which recordings."""
    names = [file.name for file in study.results.provenance.logs]
    window = study.results.experiment.window_s
    part = ""
    if window is not None and window != (None, None):
        part = f" ({in_words(*window)} of {'it' if len(names) == 1 else 'each'})"
    return (f"the log {names[0]}" if len(names) == 1 else f"{len(names)} logs ({some(names)})") + part


def question(study: Study) -> str:
    """What was asked."""
    experiment = study.results.experiment
    measure = experiment.measure
    if measure.objects.ids is not None:
        them = f"object {together(measure.objects.ids)}"
    elif measure.objects.classes is not None:
        them = f"each measured {' or '.join(_CLASSES.get(name, name) for name in measure.objects.classes)}"
    else:
        them = "each object that moves"
    which = f"each of {len(study.names)} configurations" if len(study.names) > 1 else "the one configuration"
    far = "" if experiment.measure.distance_to != "ego" or experiment.ego == "none" else ", and how far away,"
    return (
        f"On {logs(study)}: how soon{far} is {them} known to the receiver, with {which} of perception units, latencies "
        "and fusion?"
    )


def setting(study: Study) -> str:
    """How it was measured: rows, and when the clock starts."""
    results = study.results
    things = results.known.groupby(["log", "object_id"]).ngroups
    rows = int(results.known["runs"].sum()) // len(study.names)
    confirm = results.experiment.measure.confirm
    hits = f" An object is known when {confirm.hits} of {confirm.of} captures hold it." if confirm.hits > 1 else ""
    return (
        f"{counted(things, 'measured object')}, {counted(results.experiment.runs, 'run')}, so {counted(rows, 'row')} "
        f"for each configuration; common random numbers per run (seed {results.experiment.seed}). "
        f"The clock of an object starts {_onset(results.experiment)}.{hits}{unit_errors(results.experiment)}"
    )


def _onset(experiment: Experiment) -> str:
    near = experiment.measure.distance_to
    return experiment.measure.onset.described("the ego" if near == "ego" else f"unit {near}")


def configurations(study: Study) -> Html:
    """What each configuration is made of."""
    experiment = study.results.experiment
    rows = []
    for name, configuration in experiment.configurations.items():
        truth = configuration.units == "truth"
        units = experiment.units_of(configuration)
        cells = (
            _heard(configuration, units),
            "–" if truth else "its own" if configuration.recorded else _fusion(configuration),
            "as recorded" if configuration.recorded else _way(experiment, configuration, units),
        )
        rows.append(
            tag(
                "tr",
                named(study, name),
                *(
                    tag("td", cell, class_=kind)
                    for cell, kind in zip(cells, ("text long", "text", "text long"), strict=True)
                ),
            )
        )
    head = ["configuration", "units", "fusion", "latency"]
    return table(head, rows, caption="The configurations, and how each is drawn", id_="configurations")


def _heard(configuration: Configuration, units: Sequence[str]) -> str:
    if configuration.units == "truth":
        return "ground truth"
    if configuration.recorded is not None:
        of = f", of {some(configuration.inputs)}" if configuration.inputs else ""
        return f"recorded on {configuration.recorded.topic}{of}"
    return f"{len(units)}: {some(units)}" if len(units) > 1 else "".join(units)


def _fusion(configuration: Configuration) -> str:
    """Its kind, and what is not by default."""
    return _component(configuration.fusion)


def _component(component: Component) -> str:
    said = component.model_dump(mode="json", by_alias=True)
    kind = str(said.pop("kind"))
    plain = {key: field.get_default() for key, field in type(component).model_fields.items()}
    of = {key: value for key in type(component).model_fields if isinstance(value := getattr(component, key), Component)}
    said |= {key: _component(value) for key, value in of.items() if value != plain.get(key)}
    plain |= {key: said[key] for key, value in of.items() if value == plain.get(key)}
    other = [f"{key}: {value}" for key, value in said.items() if value != plain.get(key)]
    return f"{kind} ({', '.join(other)})" if other else kind


def _way(experiment: Experiment, configuration: Configuration, units: Sequence[str]) -> str:
    """By which links lists come, and the latency; how often lists are issued."""
    by: dict[str, list[str]] = {}
    senders = units or (TRUTH,)
    for unit in senders:
        link = configuration.link_of(unit)
        if isinstance(link, str):
            by.setdefault(f"link {link} = {_component(experiment.links[link])}", []).append(unit)
        elif link is not None:
            by.setdefault(_component(link), []).append(unit)
    links = [said if len(of) == len(senders) else f"{some(of)} by {said}" for said, of in by.items()]
    late = [_latency(configuration, units)] if configuration.latency_s or not links else []
    issued = [f"issued at {configuration.issue_hz:g} Hz"] if configuration.issue_hz is not None else []
    return "; ".join([*links, *late, *issued])


def _latency(configuration: Configuration, units: Sequence[str]) -> str:
    if not isinstance(configuration.latency_s, dict):
        return f"{configuration.latency_s:g} s"
    by: dict[float, list[str]] = {}
    for unit in units:
        by.setdefault(configuration.latency_of(unit), []).append(unit)
    return "; ".join(f"{some(of)} {latency_s:g} s" for latency_s, of in by.items())
