"""Waiting for a server: what it is asked runs in a thread of its own, and is given up when nothing comes.

Packages of protocols have timeouts of their own, of minutes and with repetitions: a server that accepts and never
answers took ten minutes in silence. Here the time without a byte counts, whatever the package does.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import TypeVar

IDLE_LIMIT_S = 30.0
"""Time without a byte after which a server is given up."""
WORK_LIMIT_S = 300.0
"""The same where a server may work for long, or takes in much: listing a bucket, writing a file."""
TOLD_AFTER_S = 5.0
"""Time without a byte after which the wait is told of, once."""

Answer = TypeVar("Answer")
_tell: list[Callable[[str], None]] = []


def tell_waits(tell: Callable[[str], None]) -> None:
    """From now on call `tell` with a line whenever a server lets this process wait."""
    _tell[:] = [tell]


def await_server(where: str, ask: Callable[[Callable[..., None]], Answer], *, works: bool = False) -> Answer:
    """The result of `ask`, or its exception. `ask` gets a function to call whenever a byte has come.

    `where`: the server, in words. `works`: it may be silent for as long as `WORK_LIMIT_S`. Raises TimeoutError when it
    has been silent for too long; the thread is left behind then, and ends with the process.
    """
    limit_s = WORK_LIMIT_S if works else IDLE_LIMIT_S
    answers: list[Answer] = []
    failures: list[BaseException] = []
    ended, heard_s = threading.Event(), [time.monotonic()]

    def received(*_: object, **__: object) -> None:
        heard_s[0] = time.monotonic()

    def run() -> None:
        try:
            answers.append(ask(received))
        except BaseException as error:  # of this thread; raised in the one that waits
            failures.append(error)
        ended.set()

    threading.Thread(target=run, daemon=True, name="copem-replay-server").start()
    noted = False
    while not ended.wait(max(heard_s[0] + (limit_s if noted else min(limit_s, TOLD_AFTER_S)) - time.monotonic(), 0.0)):
        silent_s = time.monotonic() - heard_s[0]
        if silent_s >= TOLD_AFTER_S and not noted:
            noted = True
            for tell in _tell:
                tell(f"{where}: waiting, no byte for {TOLD_AFTER_S:g} s; given up after {limit_s:g} s")
        if silent_s >= limit_s:
            raise TimeoutError(f"no byte came for {limit_s:g} s; is it reachable from here?")
    if failures:
        raise failures[0]
    return answers[0]
