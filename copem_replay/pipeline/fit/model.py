"""A fit as keys of an experiment: the PEM, the unit, and an experiment that replays both beside what was recorded."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from copem_replay.core.yaml import Noted, without_notes
from copem_replay.experiment.schema import Experiment
from copem_replay.pipeline.fit.detection import DetectionCouple
from copem_replay.pipeline.fit.errors import ErrorBin, ErrorFit
from copem_replay.pipeline.fit.estimate import Estimate
from copem_replay.pipeline.fit.fit import Fit

RUNS = 500
"""Of the experiment that is written."""
Tree = dict[str, Any]


def number(value: float) -> float:
    """Six significant digits: less than any interval tells."""
    return float(f"{value:.6g}")


def noted(estimate: Estimate) -> Noted:
    """An estimate as a value, with what is said of it behind."""
    return Noted(number(estimate.value), estimate.words())


def pem_of(fit: Fit) -> Tree:
    """The PEM, behind every number what is known of it."""
    couples = [_couple(fit, detection, of_bin) for detection in fit.parts.detection.couples for of_bin in _bins(fit)]
    more = fit.parts.rest.pem_keys(Noted)
    memory = dict(_memories(fit)) | more.pop("memory", {})
    return {"couples": couples} | ({"memory": memory} if memory else {}) | more


def _bins(fit: Fit) -> Iterator[tuple[Tree, ErrorBin]]:
    """The bins of the errors and where they hold: together all of the reach."""
    low_m, high_m = fit.gathered.reach.range_m
    bins = fit.parts.errors.bins
    nearest = min(one.where.range_m[0] for one in bins)
    farthest = max(one.where.range_m[1] for one in bins)
    for one in bins:
        from_m, to_m = one.where.range_m
        from_m = low_m if from_m == nearest else max(from_m, low_m)
        to_m = high_m if to_m == farthest else min(to_m, high_m)
        if to_m > from_m:
            yield one.where.when | {"range_m": [number(from_m), number(to_m)]}, one


def _couple(fit: Fit, detection: DetectionCouple, of_bin: tuple[Tree, ErrorBin]) -> Tree:
    where, errors = of_bin
    reach = fit.gathered.reach
    words = "within reach: nothing is claimed beyond the last 5 m, and the last 5°, with five matched entries"
    when: Tree = where | {"range_m": Noted(where["range_m"], words)}
    if reach.azimuth_deg is not None:
        when["azimuth_deg"] = list(reach.azimuth_deg)
    return {
        "when": when | detection.when,
        "detection": _table(detection),
        "error": _error(fit.parts.errors, errors),
        "existence": Noted(0.9, "chosen: the lists say nothing of it"),
    } | fit.parts.rest.couple_keys(Noted)


def _table(detection: DetectionCouple) -> Tree:
    """The detection model, behind every probability what is known of it."""
    tree = detection.detection()
    said = detection.probability
    if tree["kind"] == "constant":
        return tree | {"probability": Noted(tree["probability"], said[0][0].words())}
    for axis in tree.keys() & {"range_m", "visible_share"}:
        tree[axis] = Noted(tree[axis], "nodes: chosen, at quantiles of the rows")
    rows = zip(tree["probability"], said, strict=True)
    tree["probability"] = [
        [Noted(value, one.words()) for value, one in zip(values, row, strict=True)] for values, row in rows
    ]
    return tree


def _error(errors: ErrorFit, one: ErrorBin) -> Tree:
    tree: Tree = errors.yaml_error(one)
    (first, second), (xx, xy, yy) = tree["covariance_m2"], one.covariance_m2
    tree["covariance_m2"] = [
        Noted(first, f"variance {xx.words()}; covariance {xy.words()}"),
        Noted(second, f"variance {yy.words()}"),
    ]
    tree["mean_m"] = [Noted(value, mean.words()) for value, mean in zip(tree["mean_m"], one.mean_m, strict=True)]
    for key in tree.keys() & {"yaw_sigma_deg", "speed_sigma_mps", "size_sigma_m"}:
        tree[key] = Noted(tree[key], getattr(errors, key).words())
    return tree


def _memories(fit: Fit) -> Iterator[tuple[str, list[Tree]]]:
    detection = fit.parts.detection.memory
    if detection is not None:
        [part] = fit.parts.detection.yaml_detection()["memory"]["detection"]
        yield "detection", [{key: Noted(value, detection[key].words()) for key, value in part.items()}]
    for quantity, parts in fit.parts.errors.memory.items():
        if parts:
            yield quantity, [part.keys(Noted) for part in parts]


def unit_of(fit: Fit, experiment: Experiment, pem: str) -> Tree:
    """The unit where it is, with the fitted PEM and rate."""
    recorded = experiment.units[fit.unit]
    tree: Tree = {
        key: value
        for key, value in recorded.model_dump(mode="json", by_alias=True, exclude_unset=True).items()
        if key != "recorded"
    }
    tree |= {"pem": pem, "rate_hz": noted(fit.rate_hz)}
    return tree | fit.parts.rest.unit_keys(Noted)


def pasted(fit: Fit, experiment: Experiment) -> Tree:
    """What is ready to paste: `pems` and `units`."""
    return {"pems": {fit.unit: pem_of(fit)}, "units": {fit.unit: unit_of(fit, experiment, fit.unit)}}


def experiment_of(fit: Fit, experiment: Experiment, logs: Sequence[Any]) -> Tree:
    """An experiment over some logs that replays the fitted unit beside the recorded one, as plain data.

    `logs`: its entries of `logs`. Other units and PEMs of the experiment stay.
    """
    data = experiment.as_written()
    name, other = fit.unit, _free(f"{fit.unit}_recorded", data["units"])
    pem = _free(name, data["pems"])
    late_s = max(number(fit.delay.seconds), 0.0)
    told = {"delay_s": late_s, "covariance_m2": _pooled(fit)}
    recorded = _told(data["units"][name], told)
    units = {key: value for key, value in data["units"].items() if key != name}
    entries = [_with_both(entry, name, other, told) for entry in logs]
    late = {"latency_s": {name: late_s}}
    return {
        **{key: value for key, value in data.items() if key not in ("sweep", "show")},
        "logs": entries,
        "runs": RUNS,
        "pems": data["pems"] | {pem: without_notes(pem_of(fit))},
        "units": {name: without_notes(unit_of(fit, experiment, pem)), other: recorded, **units},
        "configurations": {"recorded": {"units": [other]}, "fitted": {"units": [name], **late}},
    }


def _pooled(fit: Fit) -> list[list[float]]:
    """The covariance of all errors in easting and northing, which recorded entries are given that state none."""
    rows = fit.gathered.rows
    told = np.isfinite(rows.east_m)
    (ee, en), (_, nn) = np.cov(np.stack([rows.east_m[told], rows.north_m[told]])).tolist()
    return [[number(ee), number(en)], [number(en), number(nn)]]


def _free(name: str, taken: Any) -> str:
    while name in taken:
        name += "_"
    return name


def _told(unit: Tree, told: Tree) -> Tree:
    """A recorded unit with the delay that was found, and a covariance where none is stated."""
    if unit.get("recorded") is None:
        return unit
    said = {key: value for key, value in unit["recorded"].items() if value is not None}
    return unit | {"recorded": told | said | {"delay_s": told["delay_s"]}}


def _with_both(entry: Any, name: str, other: str, told: Tree) -> Any:
    """A log's settings of the recorded unit as those of the recorded and of the fitted one."""
    settings = entry.get("units") if isinstance(entry, dict) else None
    if not settings or name not in settings:
        return entry
    mine = settings[name]
    fitted = None if mine is None else {key: value for key, value in mine.items() if key != "recorded"}
    both = {other: None if mine is None else _told(mine, told)} | ({name: fitted} if fitted or mine is None else {})
    return entry | {"units": {key: value for key, value in settings.items() if key != name} | both}
