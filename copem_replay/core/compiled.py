"""Compiled functions: decorators for those that Python calls (kernels) and for those that kernels call (callees).

A kernel is `numba.njit(cache=True, nogil=True)`; `core/kernel_cache.py` says where its code is cached. A callee is
`numba.extending.register_jitable`: Numba compiles it into each kernel that calls it, for numbers and not for literals,
without the wrapper by which Python would call it and without files of its own in the cache. Called by Python it is
the Python function. A kernel is handed arrays that are contiguous, or never are: each layout is compiled for itself,
and a part of one row is contiguous, where one of more rows is not.

At each call Numba counts, atomically, references to each array that is handed over. For a function called for each
entry this takes several times as long as its work. `borrowing` and `making` say whether references are counted;
functions that are called inherit it: docs/develop/decisions/0039-counted-references.md.
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
    """`kernel` for functions that make no array and return none: their arguments outlive them."""
    return _compile(function, _nrt=False)


def making_kernel(function: Function) -> Function:
    """`kernel` for functions that make arrays and are called by borrowing ones, too."""
    return _compile(function, _nrt=True)


def vectorised_kernel(function: Function) -> Function:
    """`kernel` with divisions as NumPy has them. One that may raise is a branch, and such loops are not vectorised."""
    return _compile(function, error_model="numpy")


def callee(function: Function) -> Function:
    """The function, compiled into each kernel that calls it."""
    return _register(function, nopython=True)


def borrowing(function: Function) -> Function:
    """`callee` for functions that make no array and return none: their arguments outlive them."""
    return _register(function, _nrt=False)


def making(function: Function) -> Function:
    """`callee` for functions that make arrays and are called by borrowing ones."""
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
    """Functions that were not in the cache: how many this process has begun to compile, how many it compiles now."""

    begun: int = 0
    running: int = 0

    def count(self, step: int) -> None:
        """1: one begins, −1: it ends. Numba compiles under one lock."""
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
    """What the function returns, called with half a MiB for Python's frames in one piece.

    Python has frames in pieces of 16 KiB, and gives a piece back as soon as the first frame in it ends. Where calls go
    to and fro over the end of a piece, which compiling does half a million times, each asks the system for memory.
    Each thread has its own pieces: docs/develop/decisions/0062-compiling-asks-less.md.
    """
    return function(*arguments, **named)


# A frame as deep as this (never filled) gets a piece of 1 MiB, the rest of which is for the frames of what it calls.
call_in_room.__code__ = call_in_room.__code__.replace(co_stacksize=70_000)
