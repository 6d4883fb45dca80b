"""Write the reference of the experiment's keys, from its JSON Schema: docs/reference/keys.md.

python tools/key_reference.py

Types, defaults and bounds are the schema's, words its docstrings, units the ends of the names, and examples the
shortest in `logs/*.yaml`, in the YAML of the guide, and in `tools/key_examples.yaml`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from copem_replay.experiment.schema import Experiment

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs/reference/keys.md"
HEAD = """\
# Keys of the experiment

Made by `tools/key_reference.py` from the schema (`copem-replay schema`). What the sections do together:
[experiment.md](../guide/experiment.md). `<name>`: of your own. *needed*: there is no default. `null`: not said.
"""
_UNITS = {"s": "s", "m": "m", "m2": "m²", "hz": "Hz", "deg": "°", "rad": "rad", "mps": "m/s", "mps2": "m/s²",
          "mps3": "m/s³", "ppm": "ppm", "db": "dB", "kbps": "kbit/s", "bytes": "B", "share": "0 … 1", "iou": "0 … 1",
          "probability": "0 … 1", "existence": "0 … 1", "rate": "0 … 1", "confidence": "0 … 1",
          "incidence": "0 … 1", "ece": "0 … 1", "min": "1/min"}  # fmt: skip
_LONGEST = 80  # letters of an example; what is longer is made of keys that have their own
_LARGEST = 1e9  # bounds from here on only keep numbers finite


_READER = YAML(typ="safe", pure=True)
_BARE = re.compile(r"[A-Za-z_/][\w ./+-]*")  # text that YAML reads as it is
Schema = dict[str, Any]
Shown = dict[tuple[str, str], str]


class Reference:
    """The sections of the page, one per model of the schema, in the order in which the keys lead to them."""

    def __init__(self) -> None:
        self.whole: Schema = Experiment.model_json_schema(by_alias=True)
        self.where: dict[str, str] = {}
        self.models: dict[str, Schema] = {}
        self.examples: Shown = {}
        self._find(self.whole, "")
        for data in _samples():
            self._show(self.whole, data)

    def page(self) -> str:
        """The whole page."""
        return "\n".join([HEAD, *(self._section(title) for title in self.models)])

    def without_example(self) -> list[str]:
        """Keys that no sample, no block of the guide and no line of tools/key_examples.yaml sets."""
        keys = [(title, key) for title, model in self.models.items() for key in model["properties"] if key != "kind"]
        return [f"{title}.{key}" for title, key in keys if (title, key) not in self.examples]

    def _resolved(self, schema: Schema) -> Schema:
        name = schema.get("$ref", "").rpartition("/")[2]
        return self.whole["$defs"][name] if name else schema

    def _choices(self, schema: Schema) -> Iterator[Schema]:
        schema = self._resolved(schema)
        if choices := schema.get("anyOf", schema.get("oneOf")):
            for choice in choices:
                yield from self._choices(choice)
        else:
            yield schema

    def _find(self, schema: Schema, where: str) -> None:
        for choice in self._choices(schema):
            if choice.get("properties") and not _own_component(choice):
                title = choice["title"]
                if title not in self.models:
                    self.models[title], self.where[title] = choice, where
                    for key, value in choice["properties"].items():
                        self._find(value, f"{where}.{key}".lstrip("."))
            elif isinstance(choice.get("additionalProperties"), dict):
                self._find(choice["additionalProperties"], f"{where}.<name>")
            elif "items" in choice:
                self._find(choice["items"], f"{where}[]")

    def _show(self, schema: Schema, data: Any) -> None:
        for choice in self._choices(schema):
            if isinstance(data, dict) and choice.get("properties"):
                kind = choice["properties"].get("kind", {})
                if kind and data.get("kind", kind.get("default")) not in kind.get("enum", [kind.get("const")]):
                    continue
                if data.keys() - choice["properties"].keys():
                    continue
                for key, value in data.items():
                    said = f"{key}: {_flow(value)}"
                    best = self.examples.get((choice["title"], key))
                    if value is not None and (best is None or len(said) < len(best)):
                        self.examples[(choice["title"], key)] = said
                    self._show(choice["properties"][key], value)
            elif isinstance(data, dict) and isinstance(choice.get("additionalProperties"), dict):
                for value in data.values():
                    self._show(choice["additionalProperties"], value)
            elif isinstance(data, list) and "items" in choice:
                for value in data:
                    self._show(choice["items"], value)

    def _section(self, title: str) -> str:
        model, where = self.models[title], self.where[title]
        heading = f"`{where}`: {title}" if where else title
        lines = [f"## {heading}\n", _words(model.get("description", "")), ""]
        lines += ["| key | type | default | unit | example |", "|---|---|---|---|---|"]
        for key, schema in model["properties"].items():
            needed = key in model.get("required", ())
            default = "*needed*" if needed else "`" + _flow(schema["default"]) + "`" if "default" in schema else "none"
            example = self.examples.get((title, key), "")
            shown = [f"`{text}`" if len(text) <= _LONGEST else "below" for text in (example,) if text]
            default = default if len(default) <= _LONGEST else "as below"
            cells = [f"`{key}`", self._type(schema), default, unit_of(key), *(shown or [""])]
            lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
        return "\n".join(lines) + "\n"

    def _type(self, schema: Schema) -> str:
        found = list(dict.fromkeys(self._one_type(choice) for choice in self._choices(schema)))
        return " or ".join(word for word in found if word != "null") or "null"

    def _one_type(self, schema: Schema) -> str:
        if "const" in schema:
            return f"`{schema['const']}`"
        if "enum" in schema:
            return " or ".join(f"`{value}`" for value in schema["enum"])
        if _own_component(schema):
            return "own component"
        if schema.get("properties"):
            kind = schema["properties"].get("kind", {}).get("const")
            return f"`{kind}`" if kind else schema["title"]
        kinds = schema.get("type", "any")
        if kinds == "array":
            if "prefixItems" in schema:
                return "[" + ", ".join(self._type(item) for item in schema["prefixItems"]) + "]"
            return f"list of {self._type(schema['items'])}" if "items" in schema else "list"
        if kinds == "object":
            inner = schema.get("additionalProperties")
            return f"by name: {self._type(inner)}" if isinstance(inner, dict) else "keys and values"
        words = {"number": "number", "integer": "whole number", "string": "text", "boolean": "true or false"}
        said = "name" if isinstance(kinds, list) else words.get(kinds, kinds)
        return said + _bounds(schema)


def _own_component(schema: Schema) -> bool:
    return schema.get("properties", {}).get("kind", {}).get("pattern") == ":"


def _bounds(schema: Schema) -> str:
    said = []
    for key, sign in (("exclusiveMinimum", ">"), ("minimum", "≥"), ("maximum", "≤")):
        value = schema.get(key)
        if value is not None and abs(value) < _LARGEST:
            said.append(f"{sign} {value:g}")
    return " " + ", ".join(said) if said else ""


def unit_of(key: str) -> str:
    """The unit that ends a name; empty: none."""
    alone = ("probability", "existence", "share", "iou", "incidence")  # other words alone are no units
    *before, last = key.split("_")
    return _UNITS.get(last, "") if before or last in alone else ""


def _flow(value: Any) -> str:
    """YAML on one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_flow(k)}: {_flow(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_flow, value)) + "]"
    if isinstance(value, str) and _BARE.fullmatch(value) and value not in ("null", "true", "false"):
        return value
    return json.dumps(value, ensure_ascii=False)


def _words(description: str) -> str:
    return re.sub(r"(?<!\n)\n(?!\n)", " ", description)


def _samples() -> Iterator[Any]:
    """Experiments, or parts of one."""
    for path in sorted(ROOT.glob("logs/*.yaml")):
        yield _READER.load(path.read_text(encoding="utf-8"))
    for path in sorted(ROOT.glob("docs/guide/*.md")):
        for block in re.findall(r"```yaml\n(.*?)```", path.read_text(encoding="utf-8"), re.DOTALL):
            yield _READER.load(block)
    yield from _READER.load_all((ROOT / "tools/key_examples.yaml").read_text(encoding="utf-8"))


if __name__ == "__main__":
    PAGE.write_text(Reference().page(), encoding="utf-8")
    print(f"wrote {PAGE.relative_to(ROOT)}")
