"""Recipes: every key of the experiment changes the key of a part, or is said not to."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import pytest
from pydantic import BaseModel

from copem_replay.core.components import Component
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.experiment.schema import Configuration, Experiment
from copem_replay.pipeline import parts as module
from copem_replay.pipeline.parts import NOT_OF_A_PART, canonical_json, recipe_key, write_recipe

LOG = {"name": "a", "sha256": "0" * 64, "topic": "truth", "ahead_ns": []}
PEM = {
    "couples": [
        {"when": {"range_m": [0, 80], "classes": ["car"]}, "detection": {"kind": "constant", "probability": 0.5},
         "error": {"kind": "gaussian", "covariance_m2": [[0.5, 0], [0, 0.5]]}}
    ],
    "memory": {"detection": [{"share": 0.5, "correlation_s": 0.5}]},
}  # fmt: skip
DATA: dict[str, Any] = {
    "version": 1, "runs": 9, "seed": 3, "logs": ["a.mcap", "b.mcap"], "ego": "1", "window_s": [0, 9], "max_gap_s": 0.4,
    "pems": {"p": PEM, "other": PEM},
    "units": {"ego": {"on": "ego", "pem": "p"}, "mast": {"at": [1, 2], "height_m": 5, "pem": "p", "rate_hz": 5},
              "far": {"at": [9, 9], "height_m": 5, "pem": "other"}},
    "obstacles": [{"polygon_m": [[0, 0], [1, 0], [1, 1]], "height_m": 3}],
    "configurations": {"mine": {"units": ["mast", "ego"], "latency_s": 0.1, "link": "v2x"},
                       "another": {"units": ["far"]}},
    "links": {"v2x": {"latency": 0.05, "channel": {"kbps": 600}}, "spare": {"latency": 0.2}},
    "measure": {"onset": {"kind": "in_range", "range_m": 60}, "conflict": {}, "exact": True, "horizon_s": 5},
    "braking": {"driver": {"kind": "constant_deceleration", "a_max_mps2": 8,
                           "reaction": {"kind": "constant", "delay_s": 0.3}}},
    "sweep": {"latency_s": [0, 1]},
    "show": {"run": 0},
}  # fmt: skip


def experiment(**changes: Any) -> Experiment:
    return Experiment.model_validate(DATA | changes)


def key(of: Experiment, configuration: str = "mine", runs: tuple[int, int] = (0, 9), **log: Any) -> str:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # changed values need not be of the right kind
        return recipe_key(write_recipe(of, configuration, LOG | log, runs))


class Marked(Component):
    """What stands for any component."""


def other(value: Any) -> Any:
    """A value that is not this one."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, int | float):
        return value + 1
    return Marked(kind="other") if value is None else f"{value}, changed"


def variants(model: BaseModel, path: str = "") -> Iterator[tuple[str, BaseModel]]:
    """The same model with one field changed, at whatever depth, and the path of the field."""
    for name in type(model).model_fields:
        value, at = getattr(model, name), f"{path}.{name}".lstrip(".")
        within = list(inner(value, at))
        yield from ((where, model.model_copy(update={name: changed})) for where, changed in within)
        if not within:
            yield at, model.model_copy(update={name: other(value)})


def inner(value: Any, at: str) -> Iterator[tuple[str, Any]]:
    if isinstance(value, BaseModel):
        yield from variants(value, at)
    elif isinstance(value, dict):
        for name, one in value.items():
            yield from ((where, value | {name: changed}) for where, changed in inner(one, f"{at}.{name}"))
    elif isinstance(value, tuple):
        for k, one in enumerate(value):
            yield from ((where, (*value[:k], changed, *value[k + 1 :])) for where, changed in inner(one, f"{at}.{k}"))


OTHERS = ("configurations.another", "units.far", "pems.other", "links.spare")
UNTOUCHED = {
    "logs", "runs", "show", "criteria", "sweep", "tags", "measure.began", "measure.horizon_s", "measure.exact",
    "measure.metrics", "measure.by",
}  # fmt: skip


def test_every_key_changes_the_part_or_is_said_not_to() -> None:
    base, seen = key(experiment()), set()
    for path, changed in variants(experiment()):
        assert isinstance(changed, Experiment)
        if path.endswith(".recorded"):
            continue  # a unit's: without its pem, see the next test; a configuration's: see below
        if path == "configurations.mine.units":
            changed = experiment(configurations={"mine": DATA["configurations"]["mine"] | {"units": ["ego"]}})
        elif path == "configurations.mine.inputs":  # of a recorded output, which has nothing else
            of = {"recorded": {"topic": "/out", "delay_s": 0.1}}
            assert key(experiment(configurations={"mine": of})) != base
            changed, base_of = (experiment(configurations={"mine": of | more}) for more in ({"inputs": ["ego"]}, {}))
            assert key(changed) != key(base_of)
        elif path == "configurations.mine.link":
            changed = experiment(configurations={"mine": DATA["configurations"]["mine"] | {"link": "spare"}})
        elif path.endswith(".pem"):
            changed = experiment(units=DATA["units"] | {path.split(".")[1]: DATA["units"]["far"]})
        elif path == "measure.distance_to":
            changed = experiment(measure=DATA["measure"] | {"distance_to": "mast"})
        spared = path.startswith(OTHERS) or any(f"{path}.".startswith(f"{name}.") for name in UNTOUCHED)
        assert (key(changed) == base) == spared, path
        seen.add(path)
    assert len(seen) > 100
    assert {*UNTOUCHED, "configurations", "units", "pems", "links"} == set(NOT_OF_A_PART)


def test_tags_change_the_parts_of_a_pem_that_asks_for_some() -> None:
    asks = {"p": [PEM["couples"][0] | {"when": {"tags": {"weather": "rain"}}}], "other": PEM}
    wet, dry = (experiment(pems=asks, tags={"weather": weather}) for weather in ("rain", "dry"))
    assert key(wet) != key(dry)


def test_every_key_of_recorded_lists_changes_the_part() -> None:
    recorded = experiment(units=DATA["units"] | {"mast": {"on": "2", "recorded": {"topic": "/lists"}}})
    keys = {path: key(one) for path, one in variants(recorded) if path.startswith("units.mast.recorded.")}
    assert len(keys) > 3
    assert key(experiment()) != key(recorded) not in keys.values()


def models() -> list[type[BaseModel]]:
    """All that an experiment may be made of: what its fields name, and every component of ours."""
    found: set[type[BaseModel]] = set()

    def walk(annotation: Any) -> None:
        for one in (annotation, *get_args(annotation)):
            if isinstance(one, type) and issubclass(one, BaseModel) and one not in found:
                found.add(one)
                for field in one.model_fields.values():
                    walk(field.annotation)
                if issubclass(one, Component):
                    for below in one.__subclasses__():
                        walk(below)
            elif one is not annotation:
                walk(one)

    walk(Experiment)
    found = {one for one in found if not inspect.isabstract(one)}
    return sorted((one for one in found if one.__module__.startswith("copem_replay.")), key=lambda one: one.__name__)


@pytest.mark.parametrize("model", models(), ids=lambda one: one.__name__)
def test_no_field_is_left_out_of_what_is_written(model: type[BaseModel]) -> None:
    """What a recipe is made of is all that the experiment as it is written has."""
    fields = list(model.model_fields)
    for name in fields:
        given: Any = dict.fromkeys(fields, Marked(kind="not"))
        if model is Configuration:  # a recorded output goes without what the others have
            given["recorded"] = "said" if name in ("recorded", "inputs") else None
        for marked in ("marked", Marked(kind="marked"), (Marked(kind="marked"),), {"marked": Marked(kind="marked")}):
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    made = model.model_construct(_fields_set={name}, **given | {name: marked})
                    written = made.model_dump(mode="json", by_alias=True)
            except (AttributeError, TypeError, ValueError):  # not a value of this kind
                continue
            assert "marked" in str(written), name
            break
        else:
            pytest.fail(f"{name}: no value could be written")


def test_what_a_part_is_of() -> None:
    base = key(experiment())
    assert key(experiment(), runs=(0, 8)) != base
    for name, value in (("name", "b"), ("sha256", "1" * 64), ("topic", "t"), ("ahead_ns", [0, 5])):
        assert key(experiment(), **{name: value}) != base, name
    assert key(experiment(), "another") != base


def test_where_a_unit_is_that_distances_are_to_is_in_it() -> None:
    """Also of configurations that it is no member of."""
    far = DATA["units"]["far"]
    units = [DATA["units"] | {"far": far | {"at": at}} for at in ([9, 9], [500, 9])]
    to_far = {"measure": DATA["measure"] | {"distance_to": "far"}}
    near_key, far_key = (key(experiment(units=where, **to_far)) for where in units)
    assert near_key != far_key
    assert len({key(experiment(units=where)) for where in units}) == 1


def test_names_of_configurations_and_other_units_do_not_matter_but_their_order_does() -> None:
    mine = DATA["configurations"]["mine"]
    assert key(experiment(configurations={"renamed": mine}), "renamed") == key(experiment())
    assert key(experiment(configurations={"mine": mine | {"units": ["ego", "mast"]}})) == key(experiment())
    turned = {name: DATA["units"][name] for name in ("mast", "ego", "far")}
    assert key(experiment(units=turned)) != key(experiment())
    assert key(experiment(pems={"p": PEM, "other": PEM, "more": PEM})) == key(experiment())


def test_an_onset_that_units_decide_is_of_all_units() -> None:
    """Whoever sees first starts the clock of all."""
    seen = {"measure": {"onset": {"kind": "line_of_sight_any"}}}
    moved = DATA["units"] | {"far": DATA["units"]["far"] | {"height_m": 6}}
    assert key(experiment(units=moved)) == key(experiment())
    assert key(experiment(units=moved, **seen)) != key(experiment(**seen))


def test_settings_of_a_log_are_in_its_recipe_alone() -> None:
    logs = [{"file": "a.mcap", "name": "a", "units": {"mast": {"height_m": 7}}}, {"file": "b.mcap", "name": "b"}]
    whole = experiment(logs=logs)
    assert key(resolve_for_log(whole, "a")) != key(experiment())
    assert key(resolve_for_log(whole, "b")) == key(experiment())


def test_libraries_and_own_files_are_in_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (
        "import copem_replay as cr\nclass Own(cr.DetectionModel):\n    def probability(self, view):\n        return 1\n"
    )
    (tmp_path / "own_model.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    pem = [{"detection": {"kind": "own_model:Own"}}]
    mine = experiment(pems={"p": pem, "other": PEM})
    before = key(mine)
    (tmp_path / "own_model.py").write_text(text + "# another one\n")
    assert key(mine) != before
    other_version = module.take_fingerprint() | {"numba": "0.0.1"}
    monkeypatch.setattr(module, "take_fingerprint", lambda: other_version)
    assert key(experiment()) != before


def test_canonical_json() -> None:
    assert canonical_json({"b": (1.0, 0.1, None), "a": "é"}) == '{"a":"é","b":[1.0,0.1,null]}'
    assert len(recipe_key("x")) == 40


def test_a_hub_depends_on_its_members_and_theirs_alone() -> None:
    """They are in no list of units; the PEM of one changes what the hub lists."""

    def of(member: dict[str, Any], beside: dict[str, Any]) -> str:
        units = {"a": {"at": [1, 2], "height_m": 5, "pem": "p"}, "c": {"at": [1, 9], "height_m": 5, "pem": "p"}}
        units = {"a": units["a"] | member, "b": units["a"], "c": units["c"] | beside, "hub": {"fuses": ["a", "b"]}}
        return key(experiment(units=units, configurations={"mine": {"units": ["hub"]}}, measure={}), "mine")

    before = of({}, {})
    assert of({"rate_hz": 7}, {}) != before
    assert of({"pem": "other"}, {}) != before
    assert of({}, {"rate_hz": 7}) == before


def test_definitions_of_messages_are_part_of_the_recipe(tmp_path: Path) -> None:
    (tmp_path / "my_msgs/msg").mkdir(parents=True)
    message = tmp_path / "my_msgs/msg/Box.msg"
    message.write_text("float64 x")
    asked = experiment(read={"topic": "/boxes", "definitions": str(tmp_path)})
    before = key(asked)
    message.write_text("float32 x")
    assert key(asked) != before
