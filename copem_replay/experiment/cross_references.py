"""Cross-references of an experiment: undefined names, and keys that exclude each other, checked without any log.

The file's plain data is checked, so that a problem of shape hides no undefined name, even in the same unit: a validator
of pydantic is called only where all below it has its shape. What has another shape is passed over.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypeAlias

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
Problems: TypeAlias = Iterator[tuple[Key, str]]
Names: TypeAlias = Mapping[str, Sequence[str]]
"""Defined names by section."""
EACH, NAMES, ITEMS = "{}", "names of {}", "[]"
"""Steps of a path: the values of a mapping; its names in place of them; the items of a list."""


def find_values(data: Any, *path: str, prefix: Key = ()) -> Problems:
    """Pairs of key and value at a path of plain data; none where the data has another shape."""
    if not path:
        yield prefix, data
        return
    step, inner = path[0], list[tuple[Any, Any]]()
    if isinstance(data, Mapping):
        names = data if step in (EACH, NAMES) else [step] if step in data else []
        inner = [(name, name if step == NAMES else data[name]) for name in names]
    elif isinstance(data, list | tuple) and step == ITEMS:
        inner = list(enumerate(data))
    for name, value in inner:
        yield from find_values(value, *path[1:], prefix=(*prefix, name))


def find_value(data: Any, *path: str, default: Any = None) -> Any:
    """The value at a path of plain data, or the default."""
    return next((value for _, value in find_values(data, *path)), default)


def check_references(source: ExperimentSource) -> Iterator[str]:
    """A line for every undefined name or number and for every key that does not go with the others."""
    data = source.data
    # A misspelt key is told of by itself, not by each name below it.
    meant = {name: data[key] for key in data for name in find_meant_key((key,), list(Experiment.model_fields))} | data
    names = {section: [str(name) for name in _mapping(meant, section)] for section in _SECTIONS.values()}
    for check in (
        _check_configurations,
        _check_names,
        _check_members,
        _check_places,
        _check_exact,
        _check_keys,
        _check_sweep,
    ):
        yield from (source.at(key, message) for key, message in check(data, names))
    yield from check_criteria(source, data)


_SECTIONS: Final = {"PEM": "pems", "unit": "units", "configuration": "configurations", "link": "links"}
_BY_UNIT: Final = ("default",)
_NAMED: Final[tuple[tuple[tuple[str, ...], str, tuple[str, ...], tuple[str, ...]], ...]] = (
    (("units", EACH, "pem"), "PEM", (), ()),
    (("units", EACH, "fuses", ITEMS), "unit", (), ()),
    (("configurations", EACH, "inputs", ITEMS), "unit", (), ()),
    (("configurations", EACH, "units", ITEMS), "unit", (), ()),
    (("configurations", EACH, "latency_s", NAMES), "unit", (), _BY_UNIT),
    (("measure", "distance_to"), "unit", ("ego",), ()),
    (("sweep", "configurations", ITEMS), "configuration", (), ()),
    (("sweep", "configurations", EACH, ITEMS), "configuration", (), ()),
    (("logs", ITEMS, "units", NAMES), "unit", (), ()),
    (("logs", ITEMS, "units", EACH, "pem"), "PEM", (), ()),
    (("logs", ITEMS, "measure", "distance_to"), "unit", ("ego",), ()),
    (("show", "configurations", ITEMS), "configuration", (), ()),
)
"""Where names stand, of what, and which are known before and after those that the experiment defines."""


def _check_names(data: Mapping[str, Any], names: Names) -> Problems:
    """Key and message of each undefined name, and of each unit that is named twice."""
    for path, noun, before, after in _NAMED:
        known_names = [*before, *names[_SECTIONS[noun]], *after]
        valid_names = {*known_names, TRUTH} if after == _BY_UNIT else {*known_names}
        for key, name in find_values(data, *path):
            if _is_name(name) and str(name) not in valid_names:
                yield key, unknown_name_message(noun, name, known_names)
    modelled, defined = {*_list_modelled_units(data)}, {*names["units"]}
    for section in ("units", "inputs"):
        for key, listed in find_values(data, "configurations", EACH, section):
            unlisted_units = {*defined}
            for k, unit in enumerate(_list_texts(listed) or ()):
                if section == "inputs" and unit in modelled:
                    yield (*key, k), f"unit {unit!r} has a PEM; the inputs of a stack are `recorded` units"
                elif unit in defined and unit not in unlisted_units:
                    yield (*key, k), f"unit {unit!r} named twice"
                unlisted_units.discard(unit)


def _check_configurations(data: Mapping[str, Any], names: Names) -> Problems:
    """Problems of configurations: undefined links, units that do not send by them, fusions of what they cannot fuse."""
    modelled = _list_modelled_units(data)
    for name, configuration in _items(data, "configurations"):
        key, members, listed = ("configurations", name), (of := configuration.get("units")), _list_texts(of)
        if members == "all" and not modelled:
            which = "modelled units; recorded ones are named" if names["units"] else "units"
            yield (*key, "units"), f"all: the experiment has no {which}"
        unit_names = modelled if members == "all" else listed or []
        how, posterior = (*key, "fusion", "combine"), find_value(configuration, "fusion", "combine") == "posterior"
        if posterior and any(_has_memory(data, one) for one in unit_names):
            yield how, "posterior draws anew at each instant and has no memory; use samples"
        for one in (one for one in unit_names if posterior and _list_said(data, one, "recorded", "fuses")):
            yield how, f"posterior draws errors, and what unit {one!r} lists has errors already; use samples"
        if (kind := _fusion_kind(configuration)) is not None and members == TRUTH:
            yield (*key, "fusion"), f"the truth is not fused; {kind} needs units"
        all_senders = [TRUTH] if members == TRUTH else [*names["units"], TRUTH]
        received = unit_names if members == "all" or listed is not None else all_senders
        yield from _check_link((*key, "link"), configuration.get("link"), received, names)


def _check_members(data: Mapping[str, Any], _: Names) -> Problems:
    """Problems of units that cannot be fused by another one, and of configurations that would hear one twice."""
    units, fused_by = dict(_items(data, "units")), dict[str, str]()
    fusing = {name: _list_texts(unit.get("fuses")) or [] for name, unit in units.items()}
    for name, members in fusing.items():
        carriers = {str(units[one].get("on")) for one in members if one in units and units[one].get("recorded") is None}
        for k, one in enumerate(members):
            key: Key = ("units", name, "fuses", k)
            member = units.get(one, {})
            if one == name:
                yield key, f"unit {name!r} cannot fuse itself"
            elif one in fused_by:
                yield key, f"unit {one!r} is fused by {fused_by[one]!r} already; a list counts once"
            elif member.get("fuses") is not None:
                yield key, f"unit {one!r} fuses others itself; chains are one level deep: name its members"
            elif isinstance(member.get("on"), dict) or len(carriers) > 1:
                what = "is carried by several objects" if isinstance(member.get("on"), dict) else "moves apart from it"
                yield key, f"unit {one!r} {what}; expected members on one object, or all at places"
            if _list_said(data, name, "placed") and _list_said(data, one, "recorded"):
                yield ("units", name, "placed"), f"member {one!r} is recorded; expected members with a PEM"
            for what in ("sends", "clock"):
                if member.get(what) is not None:
                    yield ("units", one, what), f"what {one!r} lists leaves by {name!r}; say `{what}` there"
            fused_by.setdefault(one, name)
    for key, listed in find_values(data, "configurations", EACH, "units"):
        own = _list_texts(listed) or []
        for k, one in enumerate(own):
            if fused_by.get(one) in own:
                yield (*key, k), f"unit {one!r} comes by {fused_by[one]!r} already; leave one of both out"


def _check_link(key: Key, link: object, received: Sequence[str], names: Names) -> Problems:
    """Problems of a `link`: undefined ones, and units that are undefined or not among those `received`."""
    by_unit = isinstance(link, Mapping) and "kind" not in link
    for unit, name in link.items() if isinstance(link, Mapping) and by_unit else [(None, link)]:
        at, known = (*key, str(unit)) if by_unit else key, [*names["units"], *_BY_UNIT]
        if by_unit and str(unit) not in [*known, TRUTH]:
            yield at, unknown_name_message("unit", unit, known)
        elif by_unit and str(unit) not in [*received, *_BY_UNIT]:
            message = f"the configuration has no unit {str(unit)!r} to send by a link (units: {', '.join(received)})"
            yield at, f"{message}; add it to `units`, or leave it out here"
        if _is_name(name) and str(name) not in [*(links := names["links"]), "none"]:
            yield at, f"no link {str(name)!r} (there {'are' if len(links) > 1 else 'is'} {', '.join(links) or 'none'})"


def _check_places(data: Mapping[str, Any], names: Names) -> Problems:
    """Problems of `distance_to` a unit without a place, and of keys of logs that are swept."""
    key = ("measure", "distance_to")
    place = find_value(data, *key, default="ego")
    measured = {} if place == "ego" else _mapping(data, "units", str(place))
    if measured.get("recorded") is not None and all(measured.get(one) is None for one in ("on", "at", "at_wgs84")):
        yield key, f"unit {place!r} has no place; say `at: [x, y]` or `on: <object id>` of it"
    if measured.get("fuses") is not None:
        yield key, f"unit {place!r} fuses others and has no place of its own; name one of its members"
    if isinstance(measured.get("on"), dict):
        yield key, f"unit {place!r} is carried by several objects; name a single one"
    for entry, own_unit in find_values(data, "logs", ITEMS, "units", EACH):
        distance_unit = find_value(data["logs"][entry[1]], *key, default=place)
        if own_unit is None and entry[-1] == distance_unit and distance_unit in names["units"]:
            message = f"the log lacks unit {entry[-1]!r}, from which distances are measured; give the log its own"
            yield entry, f"{message} `measure: {{distance_to: …}}`"
    for what, quantity in (("rate_hz", "rate_hz"), ("on", "penetration_rate")):
        for entry, _ in find_values(data, "logs", ITEMS, "units", EACH, what):
            if find_value(data, "sweep", quantity):
                yield entry, f"{quantity} is swept, in all logs alike; leave it out here"


def _check_exact(data: Mapping[str, Any], _: Names) -> Problems:
    """Problems of `measure.exact`: what has no exact times; and of messages with confirmation by several hits."""
    hits, window = (find_value(data, "measure", "confirm", what, default=1) for what in ("hits", "of"))
    several_hits, units = isinstance(hits, int) and hits > 1, list(_items(data, "units"))
    why = list[str]()
    for name, configuration in _items(data, "configurations"):
        if configuration.get("recorded") is not None:
            why.append(f"configuration {name!r}: a recorded output has no exact times")
        if (kind := _fusion_kind(configuration)) is not None:
            what = f"{kind} has no exact times, as what it does depends on sampled errors; only ideal fusion has"
            why.append(f"configuration {name!r}: {what}")
    for key, what in (
        ("recorded", "is recorded: nothing says how probable its lists were"),
        ("fuses", "fuses the lists of others, which has no closed form"),
        ("outages", "has outages, in which all objects miss all lists together: that has no closed form"),
    ):
        why += [f"unit {name!r} {what}" for name, unit in units if unit.get(key) is not None][:1]
    if find_value(data, "braking", "brakes_for") == "conflict":
        why.append("perceived conflicts depend on sampled errors and have no closed form; use `brakes_for: object`")
    for name, unit in units:
        sends = _mapping(unit, "sends")
        if several_hits and (sends.get("kind") == "cpm" or sends.get("max_objects") is not None):
            what = "leave out objects that are still there, so a miss is no missed capture; confirm with one hit"
            yield ("measure", "confirm"), f"the messages of unit {name!r} {what}"
        if unit.get("sends") is not None:
            why.append(f"unit {name!r} has `sends` rules that depend on earlier messages, which has no closed form")
        if several_hits and isinstance(unit.get("on"), dict):
            what = "is only in some runs, and confirmation by several hits then has no closed form"
            why.append(f"unit {name!r} {what}; confirm with one hit")
    if find_value(data, "measure", "exact") is not True:
        return
    yield from ((("measure", "exact"), one) for one in why)
    if hits != 1 and isinstance(window, int) and window > LONGEST_CHAIN:
        message = f"for `exact` expected at most {LONGEST_CHAIN} (2 to the power of `of` states), found {window}"
        yield ("measure", "confirm", "of"), message


def _check_keys(data: Mapping[str, Any], _: Names) -> Problems:
    """Problems of keys that need others, and of numbers that exceed others."""
    kind = find_value(data, "measure", "onset", "kind")
    if isinstance(kind, str) and onset_requirement(kind) is Requires.UNIT and not _list_modelled_units(data):
        yield ("measure", "onset"), f"{kind}: there is no unit to see anything"
    gap_s = data.get("max_gap_s", MAX_GAP_S)
    for path in (("measure",), ("logs", ITEMS, "measure")):
        for key, again_s in find_values(data, *path, "onset", "again_after_s"):
            if isinstance(again_s, int | float) and isinstance(gap_s, int | float) and 0 < again_s <= gap_s:
                over = f"max_gap_s, {gap_s:g} s, over which gaps are filled"
                yield key, f"expected more than {over}; found {again_s:g}"
    for key in (("braking",), ("measure", "conflict")):
        if data.get("ego") == NO_EGO and find_value(data, *key) is not None:
            yield key, "there is no ego in this study (`ego: none`) to brake or collide"
    for key, what in find_values(data, "braking", "brakes_for"):
        if what == "conflict" and find_value(data, "measure", "conflict") is None:
            yield key, "`conflict` needs `measure.conflict`, such as `conflict: {horizon_s: 3}`"
    runs = data.get("runs", 1)
    for key, number in (*find_values(data, "show", "run"), *find_values(data, "show", "run", ITEMS)):
        if isinstance(number, int) and number is not True and isinstance(runs, int) and 1 <= runs <= number:
            yield key, f"expected a run below {runs}, found {number}"


def _check_sweep(data: Mapping[str, Any], names: Names) -> Problems:
    """Problems of swept quantities that nothing in the experiment has, and of values that it cannot have."""
    sweep = _mapping(data, "sweep")
    for quantity, exists, message in (
        ("penetration_rate", any(isinstance(unit.get("on"), dict) for _, unit in _items(data, "units")),
         "no unit is `on: {classes, penetration_rate}`"),
        ("rate_hz", names["units"], "the experiment has no units"),
        ("ghosts_in_list", any(pem.get("ghosts") for _, pem in _items(data, "pems")), "no PEM has `ghosts: […]`"),
        ("correlation_s", any("detection" in one for pem in names["pems"] for one in _list_memories(data, pem)),
         "no PEM has `memory: {detection: […]}`"),
    ):  # fmt: skip
        if sweep.get(quantity) and not exists:
            yield ("sweep", quantity), message
    for kind in ("loss", "burst_s"):
        if sweep.get(kind):
            chosen = sweep.get("configurations")
            chosen = chosen.get(kind) if isinstance(chosen, Mapping) else chosen
            swept = _list_texts(chosen)
            yield from _check_swept_links(data, kind, names["configurations"] if swept is None else swept)
    others = sum(1 for _, unit in _items(data, "units") if unit.get("on") != "ego")
    for key, count in find_values(data, "sweep", "units", ITEMS):
        if isinstance(count, int) and count > others:
            yield key, f"expected at most {others}, the units beside the ego's; found {count}"


def _check_swept_links(data: Mapping[str, Any], kind: str, configurations: Sequence[str]) -> Problems:
    """Problems of a sweep of `kind` (`loss`, `burst_s`): a link cannot have the value, or no link has the quantity."""
    varies, link_names = False, set[str]()
    for name, configuration in _items(data, "configurations"):
        link = configuration.get("link")
        if name in configurations:
            link_names |= set(map(str, link.values())) if isinstance(link, dict) and "kind" not in link else {str(link)}
    for name, link in ((name, link) for name, link in _items(data, "links") if name in link_names):
        reception = _mapping(link, "reception")
        loss = reception.get("kind") if reception else "constant"
        bursts = loss == "gilbert_elliott"
        if kind == "loss" and not bursts and loss != "constant":
            message = f"links.{name}.reception: {loss} has no loss to vary; use constant or gilbert_elliott"
            yield ("sweep", kind), message
        varies |= kind == "loss" or bursts or "reception" in _mapping(link, "memory")
        low, high = reception.get("good_loss", 0.0), reception.get("bad_loss", 1.0)
        for key, value in find_values(data, "sweep", kind, ITEMS) if kind == "loss" and bursts else ():
            if all(isinstance(one, int | float) for one in (low, high, value)) and not low <= value <= high:
                between = f"good_loss and bad_loss of {name} ({low:g} … {high:g})"
                yield key, f"expected between {between}, found {value:g}"
    if not varies:
        fault = "no link loses lists" if kind == "loss" else "no link has bursts (gilbert_elliott, or memory.reception)"
        yield ("sweep", kind), fault


def _fusion_kind(configuration: Mapping[str, Any]) -> str | None:
    """The kind of a fusion by name; None: it is the ideal one."""
    kind = find_value(configuration, "fusion", "kind")
    return kind if isinstance(kind, str) and kind != "ideal" else None


def _has_memory(data: Mapping[str, Any], unit: str) -> bool:
    """Whether any random draw of a unit lasts, in its PEM or in its own pose."""
    pems = _list_said(data, unit, "pem")
    return bool(_list_said(data, unit, "placed")) or any(_list_memories(data, str(pem)) for pem in pems)


def _list_said(data: Mapping[str, Any], unit: str, *keys: str) -> list[Any]:
    """What a unit has at some keys, in the experiment and in single logs."""
    paths = (("units", unit), ("logs", ITEMS, "units", unit))
    values = (value for path in paths for key in keys for _, value in find_values(data, *path, key))
    return [value for value in values if value is not None]


def _list_memories(data: Mapping[str, Any], pem: str) -> list[Any]:
    """The `memory` mappings of a PEM and its couples that say anything."""
    of = next((of for name, of in _mapping(data, "pems").items() if str(name) == pem), None)
    paths = (("memory",), (ITEMS, "memory"), ("couples", ITEMS, "memory"))
    return [one for path in paths for _, one in find_values(of, *path) if isinstance(one, Mapping) and one]


def _list_modelled_units(data: Mapping[str, Any]) -> list[str]:
    """The units that are not recorded."""
    return [name for name, unit in _items(data, "units") if unit.get("recorded") is None]


def _mapping(data: Any, *path: str) -> Mapping[str, Any]:
    """The mapping at a path; an empty one where there is none."""
    found = find_value(data, *path)
    return found if isinstance(found, Mapping) else {}


def _items(data: Mapping[str, Any], section: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """The mappings of a section by name."""
    return ((name, value) for name, value in _mapping(data, section).items() if isinstance(value, Mapping))


def _list_texts(value: object) -> list[str] | None:
    """The items of a list as text; None: it is none."""
    return list(map(str, value)) if isinstance(value, list | tuple) else None


def _is_name(value: object) -> bool:
    return isinstance(value, str | int) and not isinstance(value, bool)


# Names that criteria use.

_ASKED: dict[str, tuple[Callable[[Mapping[str, Any]], bool], str]] = {
    "braking": (lambda data: data.get("braking") is not None, "`braking: {driver: …}`"),
    "conflict": (lambda data: _mapping(data, "measure").get("conflict") is not None, "`measure: {conflict: {}}`"),
    "needless": (
        lambda data: (
            "driver" in _mapping(data, "braking") and _mapping(data, "braking").get("needless", {}) is not None
        ),
        "`braking: {driver: …, needless: {}}`",
    ),
    "accuracy": (lambda data: _mapping(data, "measure").get("accuracy") is not False, "`measure: {accuracy: true}`"),
    "exact": (lambda data: _mapping(data, "measure").get("exact") is True, "`measure: {exact: true}`"),
}
"""What an experiment has to ask for so that there is a metric: whether it does, and the key that would."""


def check_criteria(source: ExperimentSource, study: Mapping[str, Any]) -> Iterator[str]:
    """One line for every metric and configuration that criteria name and the experiment `study`, plain data, lacks."""
    known = [str(name) for name in _mapping(study, "configurations")]
    for name, criterion in _items(source.data, "criteria"):
        key: Key = ("criteria", name)
        metric, against = str(criterion.get("metric")), criterion.get("against")
        problem = _find_metric_problem(metric, against is not None, study)
        if isinstance(criterion.get("metric"), str) and problem is not None:
            yield source.at((*key, "metric"), problem)
        of_rows = against and metric in COMPARED and COMPARED[metric].part not in OF_LISTS
        if criterion.get("weigh") is not None and metric not in JUDGED and not of_rows:
            what = f"{metric}, which is over pairs, lists or minutes"
            yield source.at((*key, "weigh"), f"expected `weigh` with a metric of detections, found {what}")
        for at, one in find_values(criterion, "configurations", ITEMS, prefix=key):
            if isinstance(one, str | int) and str(one) not in known:
                yield source.at(at, _unknown_configuration(one, known))
        for by, what, values in ((CLASS, "class", CLASSES), (BEGAN_BY, "way to begin", BEGAN)):
            for at, one in find_values(criterion, "by", by, prefix=key):
                if isinstance(one, str) and one not in values:
                    yield source.at(at, unknown_name_message(what, one, values))
        if isinstance(against, str | int) and str(against) not in known:
            other, _, where = str(against).rpartition("@")
            if where != BEFORE or (other and "@" not in str(against)):
                hint = f"; of the results given by --before: {against}@{BEFORE}, or {BEFORE} for the same name"
                yield source.at((*key, "against"), _unknown_configuration(against, known) + hint)


def _unknown_configuration(name: object, known: Sequence[str]) -> str:
    return f"expected names of configurations, found {name}: {unknown_name_message('configuration', name, known)}"


def _find_metric_problem(metric: str, paired: bool, study: Mapping[str, Any]) -> str | None:
    """Why a metric cannot be held against a bound; None: it can. `paired`: it is a difference; `study`: plain data."""
    own_names = [str(name) for _, name in find_values(study, "measure", "metrics", ITEMS, "name")]
    part_of = {name.name: part for part, names in METRICS_OF.items() for name in names}
    if metric not in part_of and metric not in own_names and metric not in COMPARED:
        hint = near_name_hint(metric, [*part_of, *own_names, *COMPARED]) or "; `copem-replay schema` lists them"
        return f"expected a column of summary.csv, found {metric}{hint}"
    if paired and metric not in COMPARED:
        listed = ", ".join(COMPARED)
        return f"expected a metric that `compare` pairs, as there is `against`, found {metric}; there are {listed}"
    judged = (*JUDGED, *SUMMED, *PER_MINUTE, *JUDGED_DRIVING, *own_names)
    if not paired and metric not in judged:
        if metric in COMPARED:
            return f"{metric} is a difference of two configurations; say `against: <configuration>`"
        return f"expected a metric that has an interval over logs or runs, found {metric}{_judged_instead(metric)}"
    needs = [part_of.get(metric, "")] + ["braking"] * (metric in JUDGED and "braking" in JUDGED[metric].rows)
    if "needless" in needs or (metric in COMPARED and (COMPARED[metric].compared or (0, 0, ()))[2]):
        needs.append("accuracy")
    for part in needs:
        if part in _ASKED and not _ASKED[part][0](study):
            return f"expected a metric that the experiment measures, found {metric}; {_ASKED[part][1]} would"
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
        shape = describe_by_key(error, source.data)
        raise ExperimentError([*problems, *(source.at(key, message) for key, message in shape)]) from None
    if problems:
        raise ExperimentError(problems)
    return dict(criteria)
