"""Compiled functions that call each other: of what is called, Numba makes no machine code of its own.

Numba compiles every function by itself, down to machine code and with the wrapper by which Python calls it, and then
links it, optimised, into each function that calls it, where all is optimised and turned into machine code once more.
In a chain of six functions the innermost goes through that six times. And a variable that starts as a literal (`n = 0`
before a loop) has a callee compiled twice: for the literal, and for any number.

Here a function has two sides. The one that Python calls is Numba's own. The one that compiled functions call is typed
and lowered, for numbers and not for literals, and linked into the caller as it is: optimised there, once, and kept in
the cache as part of it. The operations are the same, and so are the results, to the last bit.

docs/develop/decisions/0052-code-of-callees.md
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from itertools import chain
from types import SimpleNamespace
from typing import Any

from llvmlite.binding import parse_assembly
from numba import types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.event import Event, Listener, register
from numba.core.registry import CPUDispatcher
from numba.core.targetconfig import TargetConfig
from numba.core.types.containers import BaseTuple
from numba.core.types.functions import BaseFunction
from numba.core.types.misc import SliceType, unliteral

_NO_WRAPPERS = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}


class Kernel(CPUDispatcher):  # type: ignore[misc]  # Numba has no types
    """A compiled function that Python and compiled functions may call. `options`: those of `nb.njit`."""

    def __init__(self, function: Callable[..., Any], options: Mapping[str, Any]) -> None:
        options = {"nopython": True, "boundscheck": None, **options}
        super().__init__(function, targetoptions={**options, "no_cfunc_wrapper": True}, pipeline_class=_EntryCompiler)
        self.callee = _Callee(function, targetoptions={**options, **_NO_WRAPPERS}, pipeline_class=_CalleeCompiler)
        self.enable_caching()

    def compile(self, sig: Any) -> Any:
        """What Python calls, for arguments of these types."""
        return call_in_room(super().compile, sig)

    def get_call_template(self, args: tuple[Any, ...], kws: Mapping[str, Any]) -> Any:
        """What a caller has to know of the function to be called."""
        return self.callee.get_call_template(args, kws)

    def get_overload(self, sig: Any) -> Any:
        """What a caller calls."""
        return self.callee.get_overload(sig)


def call_in_room(function: Callable[[Any], Any], argument: Any) -> Any:
    """What the function returns, called with half a MiB for Python's frames in one piece.

    Python has frames in pieces of 16 KiB, and gives a piece back as soon as the first frame in it ends. Where calls go
    to and fro over the end of a piece, which compiling does a million times, each asks the system for memory.
    """
    return function(argument)


# A frame as deep as this (never filled) gets a piece of 1 MiB, the rest of which is for the frames of what it calls.
call_in_room.__code__ = call_in_room.__code__.replace(co_stacksize=70_000)


class _Callee(CPUDispatcher):  # type: ignore[misc]
    def get_call_template(self, args: tuple[Any, ...], kws: Mapping[str, Any]) -> Any:
        named = {name: unliteral(kind) for name, kind in kws.items()}
        return super().get_call_template(tuple(unliteral(kind) for kind in args), named)


class _LibraryCompiler(Compiler):  # type: ignore[misc]
    library_class: type[JITCodeLibrary]

    def _compile_core(self) -> Any:
        state = self.state
        state.library = self.library_class(state.targetctx.codegen(), state.func_id.func_qualname)
        return super()._compile_core()


class _EntryLibrary(JITCodeLibrary):  # type: ignore[misc]
    # The code that Python calls. No compiled function links it: in the cache it is machine code, and the names in it.

    def __init__(self, codegen: Any, name: str) -> None:
        super().__init__(codegen, name)
        self.enable_object_caching()

    def serialize_using_object_code(self) -> tuple[str, str, tuple[bytes, bytes]]:
        self._ensure_finalized()
        there = chain(self._final_module.functions, self._final_module.global_variables)
        names = "\n".join(f'@"{one.name}" = global i8 0' for one in there if not one.is_declaration)
        return self.name, "object", (self._get_compiled_object(), parse_assembly(names).as_bitcode())


class _EntryCompiler(_LibraryCompiler):
    library_class = _EntryLibrary


class _CalleeLibrary(JITCodeLibrary):  # type: ignore[misc]
    # The code of a callee and of all that it calls, to be linked into its callers.

    def finalize(self) -> None:
        for library in dict.fromkeys(self._linking_libraries):
            self._reload_init.update(library._reload_init)
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalize_dynamic_globals()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        self._ensure_finalized()
        return 0  # none

    @property
    def codegen(self) -> Any:
        # Numba puts the environment of a function into its machine code, to no use in nopython mode.
        return SimpleNamespace(set_env=lambda name, environment: None)


class _CalleeCompiler(_LibraryCompiler):
    library_class = _CalleeLibrary


# What an operator makes of which types, Numba asks anew at each place in each function. Most implementations refuse,
# and each refusal is looked up by the whole configuration of the compiler. Here it is asked once.


def _resolve_once(resolve: Callable[..., Any]) -> Callable[..., Any]:
    """`BaseFunction.get_call_type`, asked once for the same plain types.

    What overloads a function in Python depends on options of compiling, too, and is asked for each time.
    """
    known: dict[Any, Any] = {}

    def resolve_once(self: Any, context: Any, args: tuple[Any, ...], kws: Mapping[str, Any]) -> Any:
        if kws or not all(isinstance(kind, _PLAIN) for kind in args):
            return resolve(self, context, args, kws)
        key = self, context, tuple(args)
        if key not in known:
            signature = resolve(self, context, args, kws)
            if signature is None or self.get_impl_key(signature) != self.typing_key:
                return signature
            known[key] = signature
        return known[key]

    return resolve_once


_PLAIN = types.Number, types.Boolean, types.Array, types.Record, BaseTuple, SliceType


@cache
def _defaults_of(options: Any) -> dict[str, Any]:
    return {name: option.default for name, option in options.options.items()}


def _compare(self: Any, other: object) -> Any:
    return self is other or (self.values() == other.values() if isinstance(other, TargetConfig) else NotImplemented)


def _tell_values(self: Any) -> dict[str, Any]:
    kind: Any = type(self)
    return {**_defaults_of(kind), **self._values}


BaseFunction.get_call_type = _resolve_once(BaseFunction.get_call_type)  # type: ignore[method-assign]
TargetConfig.values = _tell_values
TargetConfig.__eq__ = _compare
TargetConfig.__hash__ = lambda self: hash(type(self))


def watch_compiling(tell: Callable[[int], None]) -> None:
    """From now on call `tell` with 1 when Numba begins to compile a function, with −1 at its end."""
    register("numba:compile", _Watch(tell))


class _Watch(Listener):  # type: ignore[misc]
    def __init__(self, tell: Callable[[int], None]) -> None:
        self._tell = tell

    def on_start(self, event: Event) -> None:
        self._tell(1)

    def on_end(self, event: Event) -> None:
        self._tell(-1)
