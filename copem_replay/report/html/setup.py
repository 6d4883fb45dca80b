"""Setup in words: the question, how it was measured, each configuration, errors of units, provenance."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from copem_replay.core.components import Component
from copem_replay.core.errors import count_noun, name_first
from copem_replay.core.tracks import TRUTH
from copem_replay.experiment.schema import Configuration, Experiment, Unit
from copem_replay.io.window import describe_window
from copem_replay.metrics.onset import BEGAN, LOG_START, has_frame_after, is_counted
from copem_replay.metrics.summary import DETECTED
from copem_replay.perception.pem.model import Pem
from copem_replay.report.html.markup import Html, allow_breaks, fold_parts, join_html, make_list, make_table, make_tag
from copem_replay.report.html.tables import row_head

if TYPE_CHECKING:
    import pandas as pd

    from copem_replay.report.html.study import ReportData
    from copem_replay.results.read import Results


# Provenance: recordings, notes, parameters, versions.


def provenance_tables(study: ReportData) -> Html:
    """The content of `provenance.json` as tables."""
    data, read = study.provenance, _count_read(study.results)
    logs = [
        make_tag(
            "tr",
            make_tag("th", str(log["log"]), scope="row"),
            make_tag("td", str(log.get("topic") or "–"), class_="text"),
            *(make_tag("td", number) for number in read.get(str(log["log"]), ("–", "–"))),
            make_tag("td", make_tag("code", str(log["sha256"])), class_="text"),
        )
        for log in data["logs"]
    ]
    skipped = [f"{log['log']}: {log['reason']}" for log in data.get("logs_skipped", [])]
    notes = [str(note) for note in data.get("notes", [])]
    if study.regret is not None:
        notes += [note.removeprefix(f"{study.results.place}: ") for note in study.regret.notes]
    keys = ("copem_replay", "python", "seed", "runs", "window_s", "visibility", "max_gap_s")
    parameters = {key: data.get(key) for key in keys}
    measured = {key: data.get(key) for key in ("measure", "braking", "run_shown")}
    return join_html(
        [
            make_tag("h3", "Recordings"),
            make_table(
                ["log", "topic of the truth", "frames", "entries", "SHA-256"],
                logs,
                caption="Recordings that were replayed",
                id_="logs",
            ),
            *_read_table(data["logs"]),
            make_tag("p", "Skipped, and not in any figure:" if skipped else "No recording was skipped."),
            make_list(skipped),
            make_tag("h3", "Notes"),
            make_list(notes) or make_tag("p", "There are none."),
            fold_parts("How it was made and measured", _pairs_table(parameters | measured, "Parameters", "parameters")),
            fold_parts("Libraries", _pairs_table(data.get("libraries", {}), "Versions of libraries", "libraries")),
        ]
    )


def _count_read(results: Results) -> dict[str, tuple[str, str]]:
    """Frames and entries that were replayed, by log; empty where a folder has no `read.csv`."""
    if not results.has("read.csv"):
        return {}
    table = results.frame("read.csv")
    return {str(one.log): (str(one.frames), str(one.entries)) for one in table.itertuples()}


def _read_table(logs: Sequence[Any]) -> Iterator[Html]:
    """A table of what was left out or mended of each recording; nothing where all was as it should be."""
    rows = [
        make_tag(
            "tr",
            make_tag("th", str(log["log"]), scope="row"),
            make_tag("td", str(finding["number"])),
            make_tag("td", str(finding["what"]), class_="text"),
            make_tag("td", "may change figures" if finding["changes"] else "–", class_="text"),
        )
        for log in logs
        for finding in log.get("read", ())
    ]
    if rows:
        caption = "What was left out or mended when recordings were read"
        yield make_table(["log", "how many", "what", "why it matters"], rows, caption=caption, id_="read")


def _pairs_table(data: dict[str, Any], caption: str, id_: str) -> Html:
    rows = [
        make_tag(
            "tr", make_tag("th", allow_breaks(key), scope="row"), make_tag("td", value, class_="text"), data_row=key
        )
        for key, value in _flatten_keys(data, "")
    ]
    return make_table(["key", "value"], rows, caption=caption, id_=id_)


def _flatten_keys(data: Any, key: str) -> Iterator[tuple[str, str]]:
    """Pairs of whole key, such as `measure.onset.kind`, and value in words."""
    if isinstance(data, dict) and data:
        for name, value in data.items():
            yield from _flatten_keys(value, f"{key}.{name}" if key else str(name))
    elif isinstance(data, list):
        yield key, ", ".join(map(str, data)) or "–"
    else:
        yield key, _format_value(data)


def _format_value(value: Any) -> str:
    if value is None or value == {}:
        return "–"
    if isinstance(value, float):
        return f"{value:.9g}"
    return str(value).lower() if isinstance(value, bool) else str(value)


# Errors of units beside those of single entries by their PEMs: outages, place, clock, ghosts, classes, track ids.


def describe_unit_errors(experiment: Experiment) -> str:
    """A sentence per unit with such errors, each after a blank; empty without any."""
    sentences = ""
    for name, unit in experiment.units.items():
        errors = [*_describe_unit(unit), *(_describe_pem(experiment.pems[unit.pem]) if unit.pem is not None else [])]
        if errors:
            sentences += f" Unit {name}: {', '.join(errors)}."
    return sentences


def _describe_unit(unit: Unit) -> list[str]:
    """Phrases on what is wrong with a unit beside its PEM: outages, pose, clock, what it fuses."""
    errors = []
    if unit.fuses is not None:
        kind = "ideal" if unit.fusion is None else unit.fusion.kind
        errors.append(f"lists what {kind} fusion makes of the lists of {' and '.join(unit.fuses)}")
    if unit.outages is not None:
        errors.append(
            f"no lists {100 * unit.outages.down_share:g} % of the time, {unit.outages.lasts_s:g} s at a time on average"
        )
    if unit.placed is not None:
        errors.append(
            f"wrong about its own place (σ {unit.placed.position_sigma_m:g} m) "
            f"and heading (σ {unit.placed.yaw_sigma_deg:g}°)"
        )
    if unit.clock is not None:
        errors.append(
            f"a clock that is off (σ {unit.clock.offset_sigma_s:g} s and {unit.clock.drift_sigma_ppm:g} ppm), "
            "which ideal fusion ignores"
        )
    return errors


def _describe_pem(pem: Pem) -> list[str]:
    """Phrases on what a PEM gets wrong beside misses and errors: ghosts, classes, track ids."""
    errors = []
    if pem.ghosts:
        errors.append(
            f"{pem.ghosts_in_list:g} false entries in a list on average, of which neither the truth nor ideal "
            "fusion knows"
        )
    if pem.classes is not None and pem.classes.confusion:
        errors.append(f"mistakes {' and '.join(pem.classes.confusion)} for others")
    if pem.tracks is not None:
        errors.append(f"a track id that switches every {pem.tracks.lasts_s:g} s")
    return errors


# Question and configurations.

_CLASSES = {"vru": "vulnerable road user", "vehicles": "vehicle"}
NAMED = 6
"""Most units, logs or objects that are named one by one: more make a sentence hard to read."""


def join_names(names: Sequence[str]) -> str:
    """`A, B and C`; of too many the first, and how many more there are."""
    return f"{', '.join(names[:-1])} and {names[-1]}" if 1 < len(names) <= NAMED else name_first(names, NAMED)


def describe_recordings(study: ReportData) -> str:
    """The names of the logs, and the window that was read."""
    names = [file.name for file in study.results.provenance.logs]
    window = study.results.experiment.window_s
    part = ""
    if window is not None and window != (None, None):
        part = f" ({describe_window(*window)} of {'it' if len(names) == 1 else 'each'})"
    return (f"the log {names[0]}" if len(names) == 1 else f"{len(names)} logs ({name_first(names, NAMED)})") + part


def describe_question(study: ReportData) -> str:
    """The question that the report answers."""
    experiment = study.results.experiment
    measure = experiment.measure
    if measure.objects.ids is not None:
        objects = f"object {join_names(measure.objects.ids)}"
    elif measure.objects.classes is not None:
        objects = f"each measured {' or '.join(_CLASSES.get(name, name) for name in measure.objects.classes)}"
    else:
        objects = "each object that moves"
    which = f"each of {len(study.names)} configurations" if len(study.names) > 1 else "the one configuration"
    far = "" if experiment.measure.distance_to != "ego" or experiment.ego == "none" else ", and how far away,"
    return (
        f"On {describe_recordings(study)}: how soon{far} is {objects} known to the receiver, with {which} of "
        "perception units, latencies and fusion?"
    )


def describe_setting(study: ReportData) -> str:
    """How it was measured: number of rows, seed, start of the clock, confirmation, errors of units."""
    results, experiment = study.results, study.results.experiment
    objects = results.known.groupby(["log", "object_id"]).ngroups
    episodes = results.known.groupby(["log", "object_id", "episode"]).ngroups
    times = f" with {count_noun(episodes, 'episode')}" if episodes > objects else ""
    tally = results.tally[results.tally["event"] == DETECTED]
    uncounted = tally[~is_counted(tally, experiment.measure.began)].drop_duplicates(["log", "object_id", "episode"])
    rows = int(results.known["runs"].sum()) // len(study.names)
    confirm = experiment.measure.confirm
    hits = f" An object is known when {confirm.hits} of {confirm.of} captures hold it." if confirm.hits > 1 else ""
    return (
        f"{count_noun(objects, 'measured object')}{times}, {count_noun(experiment.runs, 'run')}, so "
        f"{count_noun(rows, 'row')} for each configuration; common random numbers per run (seed {experiment.seed})."
        f"{_describe_others(experiment, uncounted) if len(uncounted) else ''} "
        f"The clock of an object starts {_describe_onset(experiment)}.{hits}{describe_unit_errors(experiment)}"
    )


def _describe_others(experiment: Experiment, rest: pd.DataFrame) -> str:
    """Episodes (a row each) that do not count: how many and why; most were there when the recording began."""
    noun, one = "object" if rest["episode"].max() == 0 else "episode", len(rest) == 1
    where = "in range" if experiment.measure.onset.kind == "in_range" else "there"
    if (rest["began"] == BEGAN[LOG_START]).all() and BEGAN[LOG_START] not in experiment.measure.began:
        rest = rest[has_frame_after(rest)]  # as the screen of `run` counts them
        was, them = ("was", "it does") if one else ("were", "they do")
        return f" {len(rest)} more {noun}{'' if one else 's'} {was} {where} when the recording began; {them} not count."
    return (
        f" {len(rest)} more {noun}{'' if one else 's'} {'does' if one else 'do'} not count: what counts began "
        f"{' or '.join(experiment.measure.began)}, and is seen for more than one frame."
    )


def _describe_onset(experiment: Experiment) -> str:
    near = experiment.measure.distance_to
    return experiment.measure.onset.described("the ego" if near == "ego" else f"unit {near}")


def describe_configurations(study: ReportData) -> Html:
    """A table of units, fusion and latency of each configuration."""
    experiment = study.results.experiment
    rows = []
    for name, configuration in experiment.configurations.items():
        truth = configuration.units == "truth"
        units = experiment.units_of(configuration)
        cells = (
            _describe_units(configuration, units),
            "–" if truth else "its own" if configuration.recorded else _describe_fusion(configuration),
            "as recorded" if configuration.recorded else _describe_links(experiment, configuration, units),
        )
        rows.append(
            make_tag(
                "tr",
                row_head(study, name),
                *(
                    make_tag("td", cell, class_=kind)
                    for cell, kind in zip(cells, ("text long", "text", "text long"), strict=True)
                ),
            )
        )
    head = ["configuration", "units", "fusion", "latency"]
    return make_table(head, rows, caption="The configurations, and how each is drawn", id_="configurations")


def _describe_units(configuration: Configuration, units: Sequence[str]) -> str:
    if configuration.units == "truth":
        return "ground truth"
    if configuration.recorded is not None:
        inputs = f", of {name_first(configuration.inputs, NAMED)}" if configuration.inputs else ""
        return f"recorded on {configuration.recorded.topic}{inputs}"
    return f"{len(units)}: {name_first(units, NAMED)}" if len(units) > 1 else "".join(units)


def _describe_fusion(configuration: Configuration) -> str:
    """Kind of the fusion, and parameters that differ from their defaults."""
    return _describe_component(configuration.fusion)


def _describe_component(component: Component) -> str:
    values = component.model_dump(mode="json", by_alias=True)
    kind = str(values.pop("kind"))
    defaults = {key: field.get_default() for key, field in type(component).model_fields.items()}
    components = {
        key: value for key in type(component).model_fields if isinstance(value := getattr(component, key), Component)
    }
    values |= {key: _describe_component(value) for key, value in components.items() if value != defaults.get(key)}
    defaults |= {key: values[key] for key, value in components.items() if value == defaults.get(key)}
    other = [f"{key}: {value}" for key, value in values.items() if value != defaults.get(key)]
    return f"{kind} ({', '.join(other)})" if other else kind


def _describe_links(experiment: Experiment, configuration: Configuration, units: Sequence[str]) -> str:
    """Links by which lists come, latency, and rate at which the receiver issues lists."""
    units_by_link: dict[str, list[str]] = {}
    senders = units or (TRUTH,)
    for unit in senders:
        link = configuration.link_of(unit)
        if isinstance(link, str):
            units_by_link.setdefault(f"link {link} = {_describe_component(experiment.links[link])}", []).append(unit)
        elif link is not None:
            units_by_link.setdefault(_describe_component(link), []).append(unit)
    all_of = len(senders)
    links = [link if len(of) == all_of else f"{name_first(of, NAMED)} by {link}" for link, of in units_by_link.items()]
    late = [_describe_latency(configuration, units)] if configuration.latency_s or not links else []
    issued = [f"issued at {configuration.issue_hz:g} Hz"] if configuration.issue_hz is not None else []
    return "; ".join([*links, *late, *issued])


def _describe_latency(configuration: Configuration, units: Sequence[str]) -> str:
    if not isinstance(configuration.latency_s, dict):
        return f"{configuration.latency_s:g} s"
    by: dict[float, list[str]] = {}
    for unit in units:
        by.setdefault(configuration.latency_of(unit), []).append(unit)
    return "; ".join(f"{name_first(names, NAMED)} {latency_s:g} s" for latency_s, names in by.items())
