"""Write the reference of the public API, from its docstrings: docs/reference/api.md.

python tools/api_reference.py
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import sys
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

from pydantic import BaseModel

import copem_replay as cr

PAGE = Path(__file__).resolve().parents[1] / "docs/reference/api.md"
HEAD = """\
# The public API

Made by `tools/api_reference.py` from the docstrings. Every example runs as a test, with `import copem_replay as cr` and
`import numpy as np`, in a folder with the project's `logs/` and the results of `logs/tc016d.yaml` in `out/tc016d`.

Letters of shapes: S runs, P rows (an object in a list), F lists, N objects, U units. Units of measurement end names:
`_m`, `_s`, `_rad`, `_mps`. AnyExperiment: an Experiment, its keys and values in a dict, or the path of its file.
AnyRecordings: Recordings or paths, one or several. AnyResults: Results, or the path of a folder.
What is not on this page is private and may change in any release.
"""
GROUPS = {
    "Experiments and recordings": "load_experiment read_recordings read_recording inspect_recording draft_experiment",
    "Runs": "run observations fused_tracks FusedTracks read_lists why Explanation",
    "Fits": "fit FittedPem",
    "Results": "load_results Results compare Comparison judge Judgement write_report write_history view",
    "Requirements": "require Requirement write_requirement",
    "Figures": "plot write_figures write_film",
    "Keys of an experiment": "Experiment Unit Configuration Measure Onset",
    "Data": "Recording Scene Tracks ObjectLists Inputs Inbox entries_of ViewGeometry Errors CLASSES",
    "Own components": "DetectionModel ErrorModel VisibilityModel LatencyModel ReceptionModel RadioPath LinkModel "
    "SentLists StepFusion ListFusion Driver Reaction RowMetric check_fusion NonconformingError FUSION_RULES "
    "check_latency check_reception BrokenLinkRuleError LINK_RULES",
    "Metrics": "gospa ospa cumulative_incidence",
    "Errors": "CopemError InputError ExperimentError RecordingError EmptyWindowError OutputError",
}


def page() -> str:
    """The whole page."""
    parts = [HEAD]
    for title, names in GROUPS.items():
        parts.append(f"## {title}\n")
        for name in names.split():
            parts += entries(name)
    return "\n".join(parts)


def entries(name: str) -> Iterator[str]:
    """The entry of a name, and of what is in it."""
    found = getattr(cr, name)
    if inspect.ismodule(found):
        yield entry(f"cr.{name}", found.__doc__ or "")
        for inner in found.__all__:
            yield entry(f"cr.{name}.{inner}", getattr(found, inner).__doc__, signature(getattr(found, inner)))
    elif inspect.isfunction(found):
        yield entry(f"cr.{name}", found.__doc__ or "", signature(found))
    elif inspect.isclass(found):
        # Python 3.13 has no indentation in docstrings any more.
        yield entry(f"cr.{name}", inspect.cleandoc(found.__doc__ or "") + "\n" + fields(found))
        for inner, member in vars(found).items():
            if (
                inspect.isfunction(member)
                and not inner.startswith("_")
                and member.__doc__
                and inner != "model_post_init"
            ):
                yield entry(f"cr.{name}.{inner}", member.__doc__, signature(member))
    else:
        yield entry(f"cr.{name}", constant_doc(name) + (f"\n\n{found!r}" if isinstance(found, tuple) else ""))


def entry(title: str, doc: str, called: str = "") -> str:
    """A heading, how a function is called, and a docstring, its examples as code."""
    prose, code, lines = True, "```python", [f"### `{title}`\n"]
    lines += [f"`{title.rpartition('.')[2]}{called}`\n"] if called else []
    for line in inspect.cleandoc(doc).splitlines():
        if line.startswith(">>>") and prose:
            lines, prose = [*lines, code], False
        elif not line and not prose:
            lines, prose = [*lines, "```"], True
        lines.append(line)
    return "\n".join([*lines, *["```"] * (not prose), ""])


def signature(function: Callable[..., object]) -> str:
    """`(path: AnyPath, ego: str | None = None) -> Recording`, without self."""
    said = inspect.signature(function)
    parts, star = [], False
    for one in said.parameters.values():
        if one.kind is one.KEYWORD_ONLY and not star:
            parts, star = [*parts, "*"], True
        if one.name != "self":
            kind = "" if one.annotation is one.empty else f": {one.annotation}"
            parts.append(one.name + kind + ("" if one.default is one.empty else f" = {one.default!r}"))
    return f"({', '.join(parts)}) -> {said.return_annotation}"


def fields(kind: type) -> str:
    """The fields of a class, for the end of its docstring."""
    if issubclass(kind, BaseModel):
        names = [field.alias or name for name, field in kind.model_fields.items() if name != "kind"]
        return f"\nKeys: {', '.join(f'`{name}`' for name in names)}." if names else ""
    if not dataclasses.is_dataclass(kind):
        return ""
    said = [f"`{field.name}: {field.type}`" for field in dataclasses.fields(kind)]
    members = [pair for of in kind.__mro__[::-1] if dataclasses.is_dataclass(of) for pair in vars(of).items()]
    said += [f"`{name}`" for name, member in members if is_property(member) and not name.startswith("_")]
    return f"\nFields: {', '.join(said)}."


def is_property(member: object) -> bool:
    """Whether a member of a class is read like a field."""
    return isinstance(member, property) or type(member).__name__ == "cached_property"


def constant_doc(name: str) -> str:
    """The text that stands below a constant in its module; empty: none."""
    body = ast.parse(inspect.getsource(sys.modules[cr._MODULE[name]])).body
    for statement, after in pairwise(body):
        targets = [t.id for t in getattr(statement, "targets", ()) if isinstance(t, ast.Name)]
        if name in targets and isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
            return str(after.value.value)
    return ""


def main() -> None:
    PAGE.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
