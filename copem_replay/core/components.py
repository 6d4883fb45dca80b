"""Components: a component is its configuration, a frozen model with one method.

`kind:` is a built-in name, the name of an installed entry point (group `copem_replay.<slot>`), or
`package.module:Class`. There is no registry and nothing happens on import: a class is looked up when an experiment
names it. A failure or a wrong answer of a user's own class is an InputError with file and line; that of a built-in one
is a defect, and escapes.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Mapping
from copy import deepcopy
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar, get_args

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    ModelWrapValidatorHandler,
    Tag,
    ValidationError,
    ValidationInfo,
    WithJsonSchema,
    model_validator,
)
from pydantic.json_schema import SkipJsonSchema
from pydantic_core import PydanticCustomError, core_schema

from copem_replay.core.errors import (
    FAILURES,
    InputError,
    describe_failure,
    describe_source_line,
    is_own,
    near_name_hint,
)
from copem_replay.core.tracks import Float

T = TypeVar("T")
P = TypeVar("P")
M = TypeVar("M", bound=BaseModel)

# Failures and wrong answers of a user's own code: the file and the line.


def drop_python_examples(schema: dict[str, Any]) -> None:
    """Leave the examples for Python out of the descriptions of a JSON Schema."""
    if "description" in schema:
        schema["description"] = schema["description"].partition("\n\n>>> ")[0]


UNKNOWN_KEY = "unknown_key"
"""The type of the error for a key that a model does not know; `known` in its context: the names of those it knows."""


class Frozen(BaseModel):
    """Base of all models: immutable, and a key that is not known is refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, json_schema_extra=drop_python_examples)

    @model_validator(mode="wrap")
    @classmethod
    def _list_known_keys(cls, data: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        """The model; the error for an unknown key has those that are known."""
        try:
            return handler(data)
        except ValidationError as error:
            items: list[Any] = error.errors(include_url=False)
            unknown = [item for item in items if item["type"] == "extra_forbidden" and len(item["loc"]) == 1]
            if not unknown:
                raise
            fields = {name: of for name, of in cls.model_fields.items() if SkipJsonSchema not in map(type, of.metadata)}
            known = {"known": sorted(of.alias or name for name, of in fields.items())}
            for item in unknown:
                item |= {"type": UNKNOWN_KEY, "ctx": known}
            for item in items:
                if item["type"] not in _TYPES:
                    context = {"message": item["msg"], **item.get("ctx", {})}
                    item["type"] = PydanticCustomError(item["type"], "{message}", context)
            raise ValidationError.from_exception_data(error.title, items) from None


_TYPES = frozenset(get_args(core_schema.ErrorType))


_FORM = Discriminator(lambda value: "mapping" if isinstance(value, dict | BaseModel) else "plain")
Either = Annotated[Annotated[P, Tag("plain")] | Annotated[M, Tag("mapping")], _FORM]
"""A union of two models; errors name the one whose form the value has."""


class Component(Frozen):
    """Base of all components, built-in and users' own."""

    kind: str


class GivenError(TypeError):
    """A method of a component returned a wrong value: its name, and the value."""

    def __init__(self, method: str, message: str) -> None:
        super().__init__(f"{method}: {message}")
        self.method = method


def ask_component(component: Component, where: str, work: Callable[[], T]) -> T:
    """A component's answer to a call. Raises InputError where a user's own fails; a built-in one's is a defect."""
    try:
        return work()
    except FAILURES as error:
        if not is_own(type(component)):
            raise
        if isinstance(error, GivenError):
            raise wrong_answer_error(component, where, str(error), error.method) from error
        raise InputError(f"{where}: {component.kind}: {describe_failure(error, type(component))}") from error


def wrong_answer_error(component: Component, where: str, message: str, *methods: str) -> InputError:
    """The error for an invalid return value, with file and line of the first user-defined method of `methods`."""
    return InputError(f"{where}: {component.kind}: {message}{describe_source_line(type(component), *methods)}")


def ask_numbers(
    component: Component, where: str, call: str, answer: Callable[[], Any], shape: tuple[int, ...], expected: str,
    most: float = np.finfo(np.float64).max,
) -> Float:  # fmt: skip
    """Numbers from 0 to `most` that a component returns for a call, `probability(view)`. Raises InputError for others.

    `expected`: the words for what is expected.
    """
    method = call.partition("(")[0]
    numbers = ask_component(component, where, lambda: np.asarray(answer(), dtype=np.float64))
    if numbers.shape != shape:
        raise wrong_answer_error(component, where, f"{call}: expected shape {shape}, found {numbers.shape}", method)
    invalid = ~((numbers >= 0) & (numbers <= most))
    if invalid.any():
        raise wrong_answer_error(component, where, f"{call}: expected {expected}, found {numbers[invalid][0]}", method)
    return numbers


_LARGEST = 1e12
"""No quantity of an experiment is larger, and the product of two such numbers is far from overflow."""
Number = Annotated[float, Field(strict=True, ge=-_LARGEST, le=_LARGEST)]
"""A number; text and true/false are refused."""
Positive = Annotated[float, Field(strict=True, gt=0, le=_LARGEST)]
NotNegative = Annotated[float, Field(strict=True, ge=0, le=_LARGEST)]
Latency = Annotated[float, Field(strict=True, ge=0, le=86_400)]
"""Seconds, a day at most: more is a mistake, and a stamp in nanoseconds has an end."""
Share = Annotated[float, Field(strict=True, ge=0, le=1)]
MOST_RUNS = 10**9
Count = Annotated[int, Field(strict=True, ge=1, le=MOST_RUNS)]
Flag = Annotated[bool, Field(strict=True)]
"""True or false; `yes` is text."""


def _place_beside(file: str, info: ValidationInfo) -> str:
    folder = (info.context or {}).get("folder")
    return file if folder is None else str(Path(folder) / file)


FileBeside = Annotated[str, Field(min_length=1), AfterValidator(_place_beside)]
"""A file, relative to the folder of the experiment file: `folder` in the context, without it to the working folder."""


def _id_as_text(value: object) -> object:
    """Ids may be numbers or text: `1` is `"1"`."""
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


def _tag_as_text(value: object) -> object:
    """Tags may be numbers, or true and false: `2` is `"2"`, `true` is `"true"`."""
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, int | float) else value


TagText = Annotated[
    str,
    BeforeValidator(_tag_as_text),
    Field(min_length=1, max_length=100),
    WithJsonSchema({"type": ["string", "number", "boolean"]}),
]
"""What a drive is tagged with under a name, as text."""

Id = Annotated[str, BeforeValidator(_id_as_text), WithJsonSchema({"type": ["string", "integer"]})]

Pair = tuple[Number, Number]


def _check_covariance(value: tuple[Pair, Pair]) -> tuple[Pair, Pair]:
    (a, b), (c, d) = value
    scale = max(abs(a), abs(d), 1e-12)
    if abs(b - c) > 1e-9 * scale:
        raise ValueError(f"expected a symmetric matrix, found {b} and {c} off the diagonal")
    if a < 0 or d < 0 or a * d - b * c < -1e-9 * scale**2:
        raise ValueError(f"expected a positive semi-definite matrix, found [[{a}, {b}], [{c}, {d}]]")
    return value


Covariance = Annotated[tuple[Pair, Pair], AfterValidator(_check_covariance)]


class Slot:
    """Annotation of a field that holds a component: `Annotated[DetectionModel, Slot("detection", {...})]`.

    `built_in` maps names to `package.module:Class`, so that nothing is imported before it is used. `default`: the kind
    where none is said.
    """

    def __init__(self, name: str, built_in: Mapping[str, str], default: str | None = None) -> None:
        self.name = name
        self.default = default
        self.built_in = dict(built_in)
        self.base: type[Any] = Component

    def __get_pydantic_core_schema__(self, source: type[Any], handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        """Validation: find the class that `kind` names and let it validate the rest."""
        self.base = source
        return core_schema.with_info_plain_validator_function(
            lambda value, info: self.build(value, info.context),
            serialization=core_schema.plain_serializer_function_ser_schema(
                lambda c: c.model_dump(mode="json", by_alias=True)
            ),
        )

    def __get_pydantic_json_schema__(
        self, schema: core_schema.CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """JSON Schema: one alternative per installed component, and one for `package.module:Class`."""
        alternatives = []
        for kind in self.kinds():
            try:
                component = self.find(kind)
            except PydanticCustomError:  # an entry point of another package that is broken: not to be had
                continue
            alternative = deepcopy(handler.resolve_ref_schema(handler(component.__pydantic_core_schema__)))
            if kind == self.default:
                alternative["properties"]["kind"] = {"const": kind, "default": kind}
            else:
                alternative["properties"]["kind"] = {"const": kind}
                alternative["required"] = sorted({*alternative.get("required", []), "kind"})
            alternatives.append(alternative)
        own = {"type": "object", "properties": {"kind": {"type": "string", "pattern": ":"}}, "required": ["kind"]}
        return {"anyOf": [*alternatives, own]}

    def kinds(self) -> list[str]:
        """Names that can stand in `kind:` besides `package.module:Class`."""
        return [*self.built_in, *sorted(e.name for e in entry_points(group=f"copem_replay.{self.name}"))]

    def find(self, kind: str) -> type[Component]:
        """The class `kind` names. Raises PydanticCustomError, which reads as a problem of the experiment file."""
        if kind in self.built_in:
            target = self.built_in[kind]
        elif installed := [e for e in entry_points(group=f"copem_replay.{self.name}") if e.name == kind]:
            target = installed[0].value
        elif ":" in kind:
            target = kind
        else:
            kinds = f"one of {', '.join(self.kinds())}, or " if self.kinds() else ""
            raise _pydantic_error(
                f"kind: expected {kinds}package.module:Class; found {kind!r}{near_name_hint(kind, self.kinds())}"
            )
        module, _, name = target.partition(":")
        try:
            component = getattr(importlib.import_module(module), name)
        except FAILURES as error:  # whatever a module of the user's raises
            missing = isinstance(error, ModuleNotFoundError) and module.startswith(str(error.name))
            hint = " (install it, or name its folder in PYTHONPATH)" if missing else ""
            raise _pydantic_error(f"kind: {kind!r} cannot be imported: {describe_failure(error)}{hint}") from error
        if not (isinstance(component, type) and issubclass(component, self.base)) or component is self.base:
            raise _pydantic_error(
                f"kind: {kind!r} is no kind of {self.base.__module__}.{self.base.__name__}; derive it from that"
            )
        if inspect.isabstract(component):
            lacking = ", ".join(sorted(vars(component)["__abstractmethods__"]))
            raise _pydantic_error(f"kind: {kind!r} lacks {lacking}")
        return component

    def build(self, value: object, context: Mapping[str, Any] | None = None) -> Component:
        """A component from its keys in the experiment. `context`: given to validators, such as the folder."""
        if isinstance(value, Component):
            return value
        if self.default is not None and isinstance(value, Mapping) and "kind" not in value:
            value = {"kind": self.default, **value}
        if not isinstance(value, Mapping) or not isinstance(value.get("kind"), str):
            found = "nothing" if value is None else repr(value)
            kinds = f"one of {', '.join(self.kinds())}" if self.kinds() else "package.module:Class"
            raise _pydantic_error(f"expected {{kind: …}}, kind {kinds}; found {found}")
        component = self.find(value["kind"])
        try:
            return component.model_validate(dict(value), context=context)
        except ValidationError:
            raise
        except FAILURES as error:  # of a constructor of the user's
            if not is_own(component):
                raise
            raise _pydantic_error(
                f"kind: {value['kind']!r} cannot be made: {describe_failure(error, component)}"
            ) from error


def error_at_key(key: str, message: str) -> ValidationError:
    """The error for a wrong value at a key of a model, for the model's own validators to raise."""
    return ValidationError.from_exception_data("key", [{"type": _pydantic_error(message), "loc": (key,), "input": key}])


def _pydantic_error(message: str) -> PydanticCustomError:
    # The message is a constant to pydantic: braces of the text must not be read as fields.
    return PydanticCustomError("component", "{message}", {"message": message})
