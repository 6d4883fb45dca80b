"""What is wrong with the shape of an experiment, in the words of its file: which keys, what was expected and found."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pydantic import BaseModel, ValidationError

from copem_replay.core.yaml import Key


def by_key(
    model: type[BaseModel], error: ValidationError, data: dict[str, Any], above: Key = ()
) -> Iterator[tuple[Key, str]]:
    """A line per key: the alternatives of one key are said in one, and only what was meant of several is said.

    `data`: what was validated, which is the value at the key `above` of what `model` describes.
    """
    found: dict[Key, list[Any]] = {}
    for item in error.errors(include_url=False):
        if item["type"] == "too_short" and len(item["input"]) >= item["ctx"]["min_length"]:
            continue  # long enough, but what is in it was refused, which has its own line
        found.setdefault((*above, *_file_key(data, item)), []).append(item)
    for part in reversed(above):
        data = {str(part): data}
    for key, items in found.items():
        if any(other[: len(key)] == key and len(other) > len(key) for other in found):
            continue  # another alternative fits so far, and says where it does not
        yield key, _message(model, items, key, data)


def _file_key(data: Any, item: Any) -> Key:
    """The location pydantic gives, without what is not in the file (names of alternatives, `[key]`)."""
    key: list[str | int] = []
    here, location = data, item["loc"]
    for k, part in enumerate(location):
        if isinstance(here, dict) and (part in here or (k == len(location) - 1 and item["type"] == "missing")):
            key.append(part)
            here = here.get(part)
        elif isinstance(here, list) and isinstance(part, int):
            key.append(part)
            here = here[part] if part < len(here) else None
    return tuple(key)


_EXPECTED = {
    "tuple_type": "a list",
    "list_type": "a list",
    "dict_type": "keys and values",
    "model_type": "keys and values",
    "model_attributes_type": "keys and values",
    "string_type": "text",
    "bool_type": "true or false",
    "float_type": "a number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "finite_number": "a finite number",
    "greater_than": "more than {gt:g}",
    "greater_than_equal": "at least {ge:g}",
    "less_than": "less than {lt:g}",
    "less_than_equal": "at most {le:g}",
    "string_too_short": "at least {min_length} character",
    "too_short": "at least {min_length} in the list",
    "too_long": "at most {max_length} in the list",
    "literal_error": "{expected}",
}


def _unit(written: str, meant: str) -> str:
    """That a key has another unit than the one it was taken for, where names say so."""
    (name, _, unit), (other, _, right) = written.rpartition("_"), meant.rpartition("_")
    return f" (in {right}, not {unit})" if name == other and name else ""


def _message(model: type[BaseModel], items: Sequence[Any], key: Key, data: Any) -> str:
    first = items[0]
    if first["type"] == "extra_forbidden":
        known = _names_at(model, key[:-1], data)
        near = difflib.get_close_matches(str(key[-1]), known, n=1)
        hint = f"did you mean {near[0]}?{_unit(str(key[-1]), near[0])}" if near else f"known here: {', '.join(known)}"
        if _RENAMED.get(str(key[-1])) in known:
            return f"`{key[-1]}` is called `{_RENAMED[str(key[-1])]}` now"
        if key[-1] in _DEVIATIONS and "covariance_m2" in known:
            hint = f"{_variances(first['input'])} says it"
        return "unknown key" + (f"; {hint}" if known else "")
    if first["type"] == "missing":
        return "missing"
    if own := [item for item in items if item["type"] not in _EXPECTED]:
        return str(own[0]["msg"]).removeprefix("Value error, ")
    if first["type"] == "too_short" and isinstance(first["input"], Mapping):
        return "expected at least one, found none"
    words = dict.fromkeys(_EXPECTED[item["type"]].format(**item.get("ctx", {})) for item in items)
    return f"expected {', or '.join(words)}, found {_short(first['input'])}{_percent(first)}"


_RENAMED = {"share": "penetration_rate"}
"""Keys of version 0.1, and what they are called now."""
_DEVIATIONS = ("sigma_m", "sigma", "std_m", "std", "stddev_m", "stddev")


def _variances(sigma_m: object) -> str:
    """How a covariance is written that was given as a standard deviation."""
    variance = f"{sigma_m**2:g}" if isinstance(sigma_m, int | float) else "σ²"
    return f"`covariance_m2: [[{variance}, 0], [0, {variance}]]`"


def _percent(item: Any) -> str:
    """How a fraction is written that seems to have been given in per cent."""
    is_share = item["type"] == "less_than_equal" and item["ctx"]["le"] == 1
    if not is_share or not 2 < item["input"] <= 100:  # 1.5 and 2 are other mistakes (chosen)
        return ""
    return f"; a fraction: {item['input']:g} % is {item['input'] / 100:g}"


def _names_at(model: type[BaseModel], key: Key, data: Any) -> list[str]:
    """The keys that are known at a place of the file."""
    schema = model.model_json_schema()

    def alternatives(part: Any) -> Iterator[dict[str, Any]]:
        if isinstance(part, dict):
            if "$ref" in part:
                part = schema["$defs"][part["$ref"].rpartition("/")[2]]
            yield part
            for inner in (*part.get("anyOf", ()), *part.get("oneOf", ())):
                yield from alternatives(inner)

    places = [*alternatives(schema)]
    for step in key:
        data = data[step]
        if isinstance(step, int):
            inner = [p.get("items") or (p.get("prefixItems") or [{}])[0] for p in places]
        else:
            inner = [p.get("properties", {}).get(step) or p.get("additionalProperties") for p in places]
        places = [found for part in inner for found in alternatives(part)]
    names = [place["properties"] for place in places if "properties" in place]
    meant = [place for place in names if _is_meant(place.get("kind", {}), data.get("kind"))]
    return sorted({name for place in meant or names for name in place})


def _is_meant(kinds: Mapping[str, Any], kind: object) -> bool:
    """Whether keys go with `kind:` as the file says it, or leaves it to the default."""
    known = [kinds["const"]] if "const" in kinds else kinds.get("enum", [])
    return kind in known or (kind is None and "default" in kinds)


def _short(value: object) -> str:
    words = {None: "nothing", True: "true", False: "false"}
    text = words[value] if value is None or isinstance(value, bool) else repr(value)
    return text if len(text) <= 60 else text[:57] + "…"
