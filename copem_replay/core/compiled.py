"""Compiled functions: decorators for those that Python calls (kernels) and for those that kernels call (callees).

A kernel is `numba.njit(cache=True, nogil=True)`; `core/kernel_cache.py` says where its code is cached. A callee is
`numba.extending.register_jitable`: Numba compiles it into each kernel that calls it, for numbers and not for literals,
without the wrapper by which Python would call it and without files of its own in the cache. Called by Python it is
the Python function. A kernel gets arrays of one layout: each is compiled for itself, and of one row any is contiguous.

At each call Numba counts, atomically, references to each array that is handed over. For a function called for each
entry this takes several times its work. `borrowing` and `making` say whether references are counted, and functions that
are called inherit it: docs/develop/decisions/speed.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, ParamSpec, TypeVar, cast

from copem_replay.core.kernel_cache import keep_code

Function = TypeVar("Function", bound=Callable[..., Any])
Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def kernel(function: Function) -> Function:
    """The function, compiled at its first call: its code is cached, and runs without Python's global lock."""
    return _compile(function)


def borrowing_kernel(function: Function) -> Function:
    """`kernel` without reference counting: it neither makes nor returns arrays, and its arguments outlive it."""
    return _compile(function, _nrt=False)


def making_kernel(function: Function) -> Function:
    """A reference-counted `kernel`: it may make arrays, and borrowing kernels may call it."""
    return _compile(function, _nrt=True)


def vectorised_kernel(function: Function) -> Function:
    """`kernel` with NumPy's division, which never raises: a branch that may raise would keep loops from vectorising."""
    return _compile(function, error_model="numpy")


def callee(function: Function) -> Function:
    """The function, compiled into each kernel that calls it."""
    return _register(function, nopython=True)


def borrowing(function: Function) -> Function:
    """`callee` without reference counting: it neither makes nor returns arrays, and its arguments outlive it."""
    return _register(function, _nrt=False)


def making(function: Function) -> Function:
    """A reference-counted `callee`: it may make arrays, and borrowing functions may call it."""
    return _register(function, _nrt=True)


def _compile(function: Function, **options: bool | str) -> Function:
    _watch_compiling()
    with keep_code():
        return cast("Function", _import_numba().njit(cache=True, nogil=True, **options)(function))


def _register(function: Function, **options: bool) -> Function:
    return cast("Function", _import_numba().extending.register_jitable(**options)(function))


@cache
def _import_numba() -> Any:  # by kernels alone: most commands have none
    import numba
    import numba.extending

    return numba


@dataclass
class Compiling:
    """How many functions, not in the cache, this process has begun to compile, and how many it compiles now."""

    begun: int = 0
    running: int = 0

    def count(self, step: int) -> None:
        """Count a function: 1 as its compilation begins, −1 as it ends. Numba compiles under one lock."""
        self.running += step
        self.begun += step > 0


compiling = Compiling()
"""Of this process."""


@cache
def _watch_compiling() -> None:
    """From now on `compiling` counts."""
    from numba.core.event import Event, Listener, register

    class Watch(Listener):  # type: ignore[misc]  # Numba has no types
        def on_start(self, event: Event) -> None:
            compiling.count(1)

        def on_end(self, event: Event) -> None:
            compiling.count(-1)

    register("numba:compile", Watch())


def call_in_room(
    function: Callable[Arguments, Result], *arguments: Arguments.args, **named: Arguments.kwargs
) -> Result:
    """Call the function on a stack chunk of half a MiB for Python's frames, and return its result.

    Else compiling crosses the end of a 16-KiB chunk half a million times, each with a call to the system for memory.
    """
    return function(*arguments, **named)


# A frame as deep as this (never filled) gets a piece of 1 MiB, the rest of which is for the frames of what it calls.
call_in_room.__code__ = call_in_room.__code__.replace(co_stacksize=70_000)
