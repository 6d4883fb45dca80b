"""Cross-references of an experiment: undefined names, and keys that exclude each other, checked without any log.

The file's plain data is checked, so that a problem of shape elsewhere does not hide an undefined name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from copem_replay.core.errors import ExperimentError, near_name_hint, unknown_name_message
from copem_replay.core.tracks import CLASSES, TRUTH
from copem_replay.core.yaml import Key
from copem_replay.experiment.criteria import BEFORE, CriteriaFile, Criterion
from copem_replay.experiment.file import (
    ExperimentSource,
    describe_by_key,
    find_meant_key,
    make_plain_source,
    read_experiment_file,
)
from copem_replay.experiment.schema import Experiment
from copem_replay.io.ground_truth import MAX_GAP_S
from copem_replay.metrics.braking.driving import JUDGED_DRIVING
from copem_replay.metrics.config import BEGAN_BY, CLASS, LONGEST_CHAIN, onset_requirement
from copem_replay.metrics.onset import BEGAN, Requires
from copem_replay.metrics.row_figures import JUDGED, PER_MINUTE, SUMMED
from copem_replay.metrics.summary_metrics import COMPARED, METRICS_OF, OF_LISTS

NO_EGO = "none"
"""The value of `ego: none`: the study has no ego."""


def check_references(source: ExperimentSource) -> Iterator[str]:
    """A line for every undefined name or number and for every key that does not go with the others."""
    data = source.data
    # A misspelt key is told of by itself, not by each name below it.
    meant = {name: data[key] for key in data for name in find_meant_key((key,), list(Experiment.model_fields))} | data
    pems, units, measure = _mapping_names(meant.get("pems")), _mapping_names(meant.get("units")), data.get("measure")
    for name, unit in _mapping_items(data.get("units")):
        pem = unit.get("pem")
        if _is_name(pem) and str(pem) not in pems:
            yield source.at(("units", name, "pem"), unknown_name_message("PEM", pem, pems))
    for name, configuration in _mapping_items(data.get("configurations")):
        yield from _check_configuration(source, ("configurations", name), configuration, units)
    if isinstance(measure, dict):
        place = measure.get("distance_to", "ego")
        unit = dict(_mapping_items(data.get("units"))).get(str(place), {})
        placed = any(unit.get(key) is not None for key in ("on", "at", "at_wgs84"))
        if place != "ego" and unit.get("recorded") is not None and not placed:
            yield source.at(
                ("measure", "distance_to"), f"unit {place!r} has no place; say `at: [x, y]` or `on: <object id>` of it"
            )
        if _is_name(place) and place != "ego" and str(place) not in units:
            yield source.at(("measure", "distance_to"), unknown_name_message("unit", place, ["ego", *units]))
        onset = measure.get("onset")
        kind = onset.get("kind") if isinstance(onset, dict) else None
        if isinstance(kind, str) and onset_requirement(kind) is Requires.UNIT and not _list_modelled_units(data):
            yield source.at(("measure", "onset"), f"{kind}: there is no unit to see anything")
    yield from _check_again(source, data)
    yield from _check_braking(source, data)
    yield from _check_carried(source, data)
    yield from _check_sweep(source, data, units)
    yield from _check_settings(source, data, units, pems)
    yield from check_criteria(source, data)
    show, runs, configurations = data.get("show"), data.get("runs", 1), _mapping_names(meant.get("configurations"))
    shown_names = show.get("configurations") if isinstance(show, dict) else None
    for k, name in enumerate(shown_names if isinstance(shown_names, list) else []):
        if _is_name(name) and str(name) not in configurations:
            yield source.at(("show", "configurations", k), unknown_name_message("configuration", name, configurations))
    run = show.get("run") if isinstance(show, dict) else None
    several = enumerate(run) if isinstance(run, list) else ()
    shown: list[tuple[Key, object]] = [(("show", "run", k), each) for k, each in several] or [(("show", "run"), run)]
    for key, number in shown:
        if type(number) is int and isinstance(runs, int) and 1 <= runs <= number:
            yield source.at(key, f"expected a run below {runs}, found {number}")


def _check_again(source: ExperimentSource, data: dict[str, Any]) -> Iterator[str]:
    """Onsets after which an object comes back sooner than a gap of its track is filled."""
    gap_s, logs = data.get("max_gap_s", MAX_GAP_S), data.get("logs")
    places: list[tuple[Key, Any]] = [(("measure",), data.get("measure"))]
    places += [
        (("logs", k, "measure"), one.get("measure"))
        for k, one in enumerate(logs if isinstance(logs, list) else ())
        if isinstance(one, dict)
    ]
    for key, measure in places:
        onset = measure.get("onset") if isinstance(measure, dict) else None
        again_s = onset.get("again_after_s") if isinstance(onset, dict) else None
        if isinstance(again_s, int | float) and isinstance(gap_s, int | float) and 0 < again_s <= gap_s:
            yield source.at(
                (*key, "onset", "again_after_s"),
                f"expected more than max_gap_s, {gap_s:g} s, over which gaps are filled; found {again_s:g}",
            )


def _check_braking(source: ExperimentSource, data: dict[str, Any]) -> Iterator[str]:
    """Keys that braking and exact times need, and keys that exclude them."""
    braking, measure = data.get("braking"), data.get("measure")
    measure = measure if isinstance(measure, dict) else {}
    confirm = measure.get("confirm")
    if measure.get("exact") is True:
        recorded = [name for name, unit in _mapping_items(data.get("units")) if unit.get("recorded") is not None]
        if recorded:
            yield source.at(
                ("measure", "exact"), f"unit {recorded[0]!r} is recorded: nothing says how probable its lists were"
            )
        off = [name for name, unit in _mapping_items(data.get("units")) if unit.get("outages") is not None]
        if off:
            yield source.at(
                ("measure", "exact"),
                f"unit {off[0]!r} has outages, in which all objects miss all lists together: that has no closed form",
            )
    if measure.get("exact") is True and isinstance(confirm, dict):
        of = confirm.get("of", 1)
        if isinstance(of, int) and confirm.get("hits", 1) != 1 and of > LONGEST_CHAIN:
            message = f"for `exact` expected at most {LONGEST_CHAIN} (2 to the power of `of` states), found {of}"
            yield source.at(("measure", "confirm", "of"), message)
    if data.get("ego") == NO_EGO:
        for key in (("braking",), ("measure", "conflict")):
            if (braking if key[0] == "braking" else measure.get("conflict")) is not None:
                yield source.at(key, "there is no ego in this study (`ego: none`) to brake or collide")
    if not isinstance(braking, dict) or braking.get("brakes_for") != "conflict":
        return
    if measure.get("conflict") is None:
        yield source.at(
            ("braking", "brakes_for"),
            "`conflict` needs `measure.conflict`, such as `conflict: {horizon_s: 3}`",
        )
    if measure.get("exact") is True:
        yield source.at(
            ("measure", "exact"),
            "perceived conflicts depend on sampled errors and have no closed form; use `brakes_for: object`",
        )


def _check_carried(source: ExperimentSource, data: dict[str, Any]) -> Iterator[str]:
    """Keys that exclude units of some runs only, and units that leave objects out of messages."""
    measure = data.get("measure")
    measure = measure if isinstance(measure, dict) else {}
    hits = measure["confirm"].get("hits", 1) if isinstance(measure.get("confirm"), dict) else 1
    for name, unit in _mapping_items(data.get("units")):
        sends = unit.get("sends")
        leaves_out = isinstance(sends, dict) and (sends.get("kind") == "cpm" or sends.get("max_objects") is not None)
        if isinstance(hits, int) and hits > 1 and leaves_out:
            yield source.at(
                ("measure", "confirm"),
                f"the messages of unit {name!r} leave out objects that are still there, so a miss is no "
                "missed capture; confirm with one hit",
            )
        if measure.get("exact") is True and sends is not None:
            message = f"unit {name!r} has `sends` rules that depend on earlier messages, which has no closed form"
            yield source.at(("measure", "exact"), message)
        if not isinstance(unit.get("on"), dict):
            continue
        if measure.get("distance_to") == name:
            yield source.at(
                ("measure", "distance_to"), f"unit {name!r} is carried by several objects; name a single one"
            )
        if isinstance(hits, int) and hits > 1 and measure.get("exact") is True:
            yield source.at(
                ("measure", "exact"),
                f"unit {name!r} is only in some runs, and confirmation by several hits then has no closed "
                "form; confirm with one hit",
            )


def _check_sweep(source: ExperimentSource, data: dict[str, Any], units: Sequence[str]) -> Iterator[str]:
    """Names that a sweep uses and are undefined, and quantities that nothing in the experiment has."""
    sweep = data.get("sweep")
    if not isinstance(sweep, dict):
        return
    named, configurations = sweep.get("configurations"), _mapping_names(data.get("configurations"))
    by_quantity = named.items() if isinstance(named, dict) else [(None, named)]
    for quantity, names in by_quantity:
        where: Key = ("sweep", "configurations", *([] if quantity is None else [quantity]))
        for k, name in enumerate(names if isinstance(names, list) else []):
            if _is_name(name) and str(name) not in configurations:
                yield source.at((*where, k), unknown_name_message("configuration", name, configurations))
    carried = [name for name, unit in _mapping_items(data.get("units")) if isinstance(unit.get("on"), dict)]
    if sweep.get("penetration_rate") and not carried:
        yield source.at(("sweep", "penetration_rate"), "no unit is `on: {classes, penetration_rate}`")
    if sweep.get("rate_hz") and not units:
        yield source.at(("sweep", "rate_hz"), "the experiment has no units")
    if sweep.get("ghosts_in_list") and not any(
        isinstance(pem, dict) and pem.get("ghosts") for _, pem in _mapping_items(data.get("pems"))
    ):
        yield source.at(("sweep", "ghosts_in_list"), "no PEM has `ghosts: […]`")
    if sweep.get("correlation_s") and not any(
        _list_memories(data, name, "detection") for name in _mapping_names(data.get("pems"))
    ):
        yield source.at(("sweep", "correlation_s"), "no PEM has `memory: {detection: […]}`")
    for kind in ("loss", "burst_s"):
        if sweep.get(kind):
            names_of_kind = named.get(kind) if isinstance(named, dict) else named
            yield from _check_swept_links(
                source, kind, sweep[kind], names_of_kind if isinstance(names_of_kind, list) else configurations
            )
    others = sum(1 for _, unit in _mapping_items(data.get("units")) if unit.get("on") != "ego")
    counts = sweep.get("units")
    for k, count in enumerate(counts if isinstance(counts, list) else []):
        if isinstance(count, int) and count > others:
            yield source.at(
                ("sweep", "units", k), f"expected at most {others}, the units beside the ego's; found {count}"
            )


def _check_swept_links(
    source: ExperimentSource, kind: str, values: object, configurations: Sequence[object]
) -> Iterator[str]:
    """Links of the swept configurations whose loss cannot be varied, or not to a value; that there are none at all."""
    varies, used_links = False, set()
    for name, configuration in _mapping_items(source.data.get("configurations")):
        if name in map(str, configurations):
            link = configuration.get("link")
            used_links |= set(map(str, link.values())) if isinstance(link, dict) and "kind" not in link else {str(link)}
    for name, link in _mapping_items(source.data.get("links")):
        if name not in used_links:
            continue
        reception, memory = link.get("reception"), link.get("memory")
        loss_kind = reception.get("kind") if isinstance(reception, dict) else "constant"
        if kind == "loss" and loss_kind not in ("constant", "gilbert_elliott"):
            message = f"links.{name}.reception: {loss_kind} has no loss to vary; use constant or gilbert_elliott"
            yield source.at(("sweep", kind), message)
        varies |= (
            kind == "loss" or loss_kind == "gilbert_elliott" or (isinstance(memory, dict) and "reception" in memory)
        )
        if kind == "loss" and loss_kind == "gilbert_elliott" and isinstance(reception, dict):
            low, high = reception.get("good_loss", 0.0), reception.get("bad_loss", 1.0)
            for k, value in enumerate(values if isinstance(values, list) else []):
                if all(isinstance(one, int | float) for one in (low, high, value)) and not low <= value <= high:
                    message = f"expected between good_loss and bad_loss of {name} ({low:g} … {high:g}), found {value:g}"
                    yield source.at(("sweep", kind, k), message)
    if not varies:
        what = "no link loses lists" if kind == "loss" else "no link has bursts (gilbert_elliott, or memory.reception)"
        yield source.at(("sweep", kind), what)


def _check_settings(
    source: ExperimentSource, data: dict[str, Any], units: Sequence[str], pems: Sequence[str]
) -> Iterator[str]:
    """Names that the settings of single logs use and are undefined, and keys that they set though they are swept."""
    logs, measure, swept = data.get("logs"), data.get("measure"), data.get("sweep")
    everywhere = measure.get("distance_to", "ego") if isinstance(measure, dict) else "ego"
    for k, entry in enumerate(logs if isinstance(logs, list) else []):
        if not isinstance(entry, dict):
            continue
        log_units, log_measure = entry.get("units"), entry.get("measure")
        for name, unit in log_units.items() if isinstance(log_units, dict) else ():
            key: Key = ("logs", k, "units", name)
            if _is_name(name) and str(name) not in units:
                yield source.at(key, unknown_name_message("unit", name, units))
            pem = unit.get("pem") if isinstance(unit, dict) else None
            if _is_name(pem) and str(pem) not in pems:
                yield source.at((*key, "pem"), unknown_name_message("PEM", pem, pems))
            for what, quantity in (("rate_hz", "rate_hz"), ("on", "penetration_rate")):
                if isinstance(unit, dict) and what in unit and isinstance(swept, dict) and swept.get(quantity):
                    yield source.at((*key, what), f"{quantity} is swept, in all logs alike; leave it out here")
        place = log_measure.get("distance_to", everywhere) if isinstance(log_measure, dict) else everywhere
        if place not in ("ego", everywhere) and _is_name(place) and str(place) not in units:
            yield source.at(("logs", k, "measure", "distance_to"), unknown_name_message("unit", place, ["ego", *units]))
        elif isinstance(log_units, dict) and place in log_units and log_units[place] is None:
            message = f"the log lacks unit {place!r}, from which distances are measured; give the log its own"
            yield source.at(("logs", k, "units", str(place)), message + " `measure: {distance_to: …}`")


def _check_configuration(
    source: ExperimentSource, key: Key, configuration: dict[str, Any], units: Sequence[str]
) -> Iterator[str]:
    if configuration.get("recorded") is not None:
        yield from _check_inputs(source, key, configuration, units)
    members = configuration.get("units")
    if members == "all" and not _list_modelled_units(source.data):
        which = "modelled units; recorded ones are named" if units else "units"
        yield source.at((*key, "units"), f"all: the experiment has no {which}")
    yield from _check_fusion(source, key, configuration, members)
    named: list[str] = []
    for k, unit in enumerate(members if isinstance(members, list) else []):
        if _is_name(unit) and str(unit) not in units:
            yield source.at((*key, "units", k), unknown_name_message("unit", unit, units))
        elif str(unit) in named:
            yield source.at((*key, "units", k), f"unit {str(unit)!r} named twice")
        named.append(str(unit))
    latency = configuration.get("latency_s")
    for unit in latency if isinstance(latency, dict) else ():
        if unit not in [*units, "default", "truth"]:
            yield source.at((*key, "latency_s", unit), unknown_name_message("unit", unit, [*units, "default"]))
    yield from _check_link(source, (*key, "link"), configuration, units)


def _check_link(
    source: ExperimentSource, key: Key, configuration: dict[str, Any], units: Sequence[str]
) -> Iterator[str]:
    """Undefined links, and units that send by links and are undefined or not the configuration's."""
    link, members = configuration.get("link"), configuration.get("units")
    own = _list_modelled_units(source.data) if members == "all" else members
    received = [str(one) for one in own] if isinstance(own, list) else [TRUTH] if members == TRUTH else [*units, TRUTH]
    links = _mapping_names(source.data.get("links"))
    by_unit = isinstance(link, dict) and "kind" not in link
    for unit, name in link.items() if isinstance(link, dict) and by_unit else [(None, link)]:
        if by_unit and str(unit) not in [*units, "default", "truth"]:
            yield source.at((*key, str(unit)), unknown_name_message("unit", unit, [*units, "default"]))
        elif by_unit and str(unit) not in [*received, "default"]:
            message = f"the configuration has no unit {str(unit)!r} to send by a link (units: {', '.join(received)})"
            yield source.at((*key, str(unit)), f"{message}; add it to `units`, or leave it out here")
        if _is_name(name) and str(name) not in [*links, "none"]:
            choices = f"there {'are' if len(links) > 1 else 'is'} {', '.join(links) or 'none'}"
            yield source.at((*key, str(unit)) if by_unit else key, f"no link {str(name)!r} ({choices})")


def _check_inputs(
    source: ExperimentSource, key: Key, configuration: dict[str, Any], units: Sequence[str]
) -> Iterator[str]:
    """Undefined inputs of a recorded output, and inputs that it cannot have had."""
    listed, modelled = configuration.get("inputs"), _list_modelled_units(source.data)
    inputs = listed if isinstance(listed, list) else []
    for k, unit in enumerate(inputs):
        if _is_name(unit) and str(unit) not in units:
            yield source.at((*key, "inputs", k), unknown_name_message("unit", unit, units))
        elif str(unit) in modelled:
            yield source.at(
                (*key, "inputs", k), f"unit {str(unit)!r} has a PEM; the inputs of a stack are `recorded` units"
            )
        elif unit in inputs[:k]:
            yield source.at((*key, "inputs", k), f"unit {str(unit)!r} named twice")
    measure = source.data.get("measure")
    if isinstance(measure, dict) and measure.get("exact") is True:
        yield source.at(("measure", "exact"), f"configuration {key[-1]!r}: a recorded output has no exact times")


def _check_fusion(source: ExperimentSource, key: Key, configuration: dict[str, Any], members: object) -> Iterator[str]:
    """Keys that exclude fusions other than the ideal one."""
    fusion, measure = configuration.get("fusion"), source.data.get("measure")
    kind = fusion.get("kind") if isinstance(fusion, dict) else None
    if isinstance(fusion, dict) and fusion.get("combine") == "posterior" and _has_memory(source.data, members):
        message = "posterior draws anew at each instant and has no memory; use samples"
        yield source.at((*key, "fusion", "combine"), message)
    if not isinstance(kind, str) or kind == "ideal":
        return
    if members == "truth":
        yield source.at((*key, "fusion"), f"the truth is not fused; {kind} needs units")
    if isinstance(measure, dict) and measure.get("exact") is True:
        yield source.at(
            ("measure", "exact"),
            f"configuration {key[-1]!r}: {kind} has no exact times, as what it does depends on sampled errors; only "
            "ideal fusion has",
        )


def _has_memory(data: dict[str, Any], members: object) -> bool:
    """Whether any random draw of a configuration's units lasts, in their PEMs or in their own poses."""
    names = map(str, members) if isinstance(members, list) else _list_modelled_units(data) if members == "all" else ()
    units = dict(_mapping_items(data.get("units")))
    unit_data = [units.get(name, {}) for name in names]
    return any(unit.get("placed") is not None or _list_memories(data, str(unit.get("pem"))) for unit in unit_data)


def _list_memories(data: dict[str, Any], name: str, quantity: str | None = None) -> list[dict[str, Any]]:
    """The `memory` mappings of a PEM and its couples that have a quantity, or any."""
    pems = data.get("pems")
    pem = {str(key): pem for key, pem in pems.items()}.get(name) if isinstance(pems, dict) else None
    couples = pem.get("couples") if isinstance(pem, dict) else pem
    each = [pem, *(couples if isinstance(couples, list) else ())]
    memories = [one["memory"] for one in each if isinstance(one, dict) and isinstance(one.get("memory"), dict)]
    return [memory for memory in memories if memory and (quantity is None or quantity in memory)]


def _list_modelled_units(data: dict[str, Any]) -> list[str]:
    return [name for name, unit in _mapping_items(data.get("units")) if unit.get("recorded") is None]


def _mapping_items(mapping: object) -> Iterator[tuple[str, dict[str, Any]]]:
    for name, value in mapping.items() if isinstance(mapping, dict) else ():
        if isinstance(value, dict):
            yield name, value


def _mapping_names(mapping: object) -> list[str]:
    return [str(name) for name in mapping] if isinstance(mapping, dict) else []


def _is_name(value: object) -> bool:
    return isinstance(value, str | int) and not isinstance(value, bool)


# Names that criteria use.

_ASKED: dict[str, tuple[Callable[[Mapping[str, Any]], bool], str]] = {
    "braking": (lambda data: data.get("braking") is not None, "`braking: {driver: …}`"),
    "conflict": (lambda data: _measure_data(data).get("conflict") is not None, "`measure: {conflict: {}}`"),
    "needless": (
        lambda data: isinstance(of := data.get("braking"), Mapping) and of.get("needless", {}) is not None,
        "`braking: {driver: …, needless: {}}`",
    ),
    "accuracy": (lambda data: _measure_data(data).get("accuracy", True) is not False, "`measure: {accuracy: true}`"),
    "exact": (lambda data: _measure_data(data).get("exact") is True, "`measure: {exact: true}`"),
}
"""What an experiment has to ask for so that there is a metric: whether it does, and the key that would."""


def _measure_data(data: Mapping[str, Any]) -> Mapping[str, Any]:
    measure = data.get("measure")
    return measure if isinstance(measure, Mapping) else {}


def _own_metric_names(study: Mapping[str, Any]) -> list[str]:
    own = _measure_data(study).get("metrics")
    return [str(one.get("name")) for one in own if isinstance(one, dict)] if isinstance(own, list | tuple) else []


def check_criteria(source: ExperimentSource, study: Mapping[str, Any]) -> Iterator[str]:
    """A line for every metric and configuration that criteria name and the experiment `study`, plain data, has not."""
    criteria = source.data.get("criteria")
    configurations = study.get("configurations")
    known = [str(name) for name in configurations] if isinstance(configurations, Mapping) else []
    for name, criterion in criteria.items() if isinstance(criteria, Mapping) else ():
        if not isinstance(criterion, Mapping):
            continue
        key: Key = ("criteria", name)
        metric, against = criterion.get("metric"), criterion.get("against")
        if isinstance(metric, str) and (problem := _find_metric_problem(metric, against is not None, study)):
            yield source.at((*key, "metric"), problem)
        if criterion.get("weigh") is not None and metric not in JUDGED and not (against and _is_of_rows(metric)):
            message = (
                f"expected `weigh` with a metric of detections, found {metric}, which is over pairs, lists or minutes"
            )
            yield source.at((*key, "weigh"), message)
        named = criterion.get("configurations")
        for k, one in enumerate(named if isinstance(named, list | tuple) else ()):
            if isinstance(one, str | int) and str(one) not in known:
                yield source.at((*key, "configurations", k), _unknown_configuration(one, known))
        yield from _check_group(source, (*key, "by"), criterion.get("by"))
        if isinstance(against, str | int) and str(against) not in known:
            other, _, where = str(against).rpartition("@")
            if where != BEFORE or (other and "@" not in str(against)):
                hint = f"; of the results given by --before: {against}@{BEFORE}, or {BEFORE} for the same name"
                yield source.at((*key, "against"), _unknown_configuration(against, known) + hint)


def _is_of_rows(metric: object) -> bool:
    """Whether a compared metric is of rows of detections."""
    return metric in COMPARED and COMPARED[str(metric)].part not in OF_LISTS


def _check_group(source: ExperimentSource, key: Key, by: object) -> Iterator[str]:
    """A line for each class and way to begin that does not exist."""
    for name, what, known in ((CLASS, "class", CLASSES), (BEGAN_BY, "way to begin", BEGAN)):
        value = by.get(name) if isinstance(by, Mapping) else None
        if isinstance(value, str) and value not in known:
            yield source.at((*key, name), unknown_name_message(what, value, known))


def _unknown_configuration(name: object, known: Sequence[str]) -> str:
    return f"expected names of configurations, found {name}: {unknown_name_message('configuration', name, known)}"


def _find_metric_problem(metric: str, paired: bool, study: Mapping[str, Any]) -> str | None:
    """Why a metric cannot be held against a bound; None: it can. `paired`: it is a difference."""
    own, of = _own_metric_names(study), {name.name: what for what, names in METRICS_OF.items() for name in names}
    if metric not in of and metric not in own and metric not in COMPARED:
        hint = near_name_hint(metric, [*of, *own, *COMPARED]) or "; `copem-replay schema` lists them"
        return f"expected a column of summary.csv, found {metric}{hint}"
    if paired and metric not in COMPARED:
        listed = ", ".join(COMPARED)
        return f"expected a metric that `compare` pairs, as there is `against`, found {metric}; there are {listed}"
    judged = (*JUDGED, *SUMMED, *PER_MINUTE, *JUDGED_DRIVING, *own)
    if not paired and metric not in judged:
        if metric in COMPARED:
            return f"{metric} is a difference of two configurations; say `against: <configuration>`"
        return f"expected a metric that has an interval over logs or runs, found {metric}{_judged_instead(metric)}"
    needs = [of.get(metric, "")] + ["braking"] * (metric in JUDGED and "braking" in JUDGED[metric].rows)
    if "needless" in needs or (metric in COMPARED and (COMPARED[metric].compared or (0, 0, ()))[2]):
        needs.append("accuracy")
    for what in needs:
        if what in _ASKED and not _ASKED[what][0](study):
            return f"expected a metric that the experiment measures, found {metric}; {_ASKED[what][1]} would"
    return None


def _judged_instead(metric: str) -> str:
    if f"{metric.removesuffix('_m')}_held_m" in COMPARED:
        return f"; with `against`, {metric.removesuffix('_m')}_held_m has one"
    names = (name for name in (*JUDGED, *SUMMED, *PER_MINUTE, *JUDGED_DRIVING) if not name.endswith("_exact"))
    return f"; there are {', '.join(names)}"


def read_criteria(given: Path | Mapping[str, Any], study: Mapping[str, Any]) -> dict[str, Criterion]:
    """Criteria by name, from a file with the one key `criteria` or as plain data, checked against an experiment's data.

    Raises ExperimentError with all problems, a line each, with file, line and key.
    """
    source = make_plain_source({"criteria": given}) if isinstance(given, Mapping) else read_experiment_file(given)
    problems = [*source.problems, *check_criteria(source, study)]
    try:
        criteria = CriteriaFile.model_validate(source.data).criteria
    except ValidationError as error:
        shape = describe_by_key(CriteriaFile, error, source.data)
        raise ExperimentError([*problems, *(source.at(key, message) for key, message in shape)]) from None
    if problems:
        raise ExperimentError(problems)
    return dict(criteria)
