"""Failures and wrong answers of a user's own code: the file and the line.

For components that an experiment names (`kind: package.module:Class`). A failure of built-in code stays a defect.
"""

from __future__ import annotations

import importlib
import inspect
import os
import traceback
from pathlib import Path
from typing import Any

FAILURES = (Exception, SystemExit)
"""Exceptions that a user's code may raise; an interrupt is none of them."""


def is_own(component: type[Any]) -> bool:
    """Whether a class is a user's own, not built in."""
    return not component.__module__.startswith("copem_replay.")


def failed(error: BaseException, component: type[Any] | None = None) -> str:
    """`ValueError: why (file:line)`: the innermost line in the file of the class, else the innermost of a user's."""
    why = " ".join(f"{type(error).__name__}: {error}".split()).removesuffix(":")
    if isinstance(error, SyntaxError):  # says where by itself
        return why
    frames = [f for f in traceback.extract_tb(error.__traceback__) if not _is_machinery(f.filename)]
    mine = [f for f in frames if f.filename == _file_of(component)]
    place = [f"{f.filename}:{f.lineno}" for f in (mine or frames)[-1:]]
    return f"{why} ({place[0]})" if place else why


def written_at(component: type[Any], *methods: str) -> str:
    """` (file:line)` of the first of some methods that is a user's own, else of the class; empty for built-in ones."""
    if not is_own(component):
        return ""
    for name in methods:
        method = getattr(component, name, None)
        code = getattr(inspect.unwrap(method), "__code__", None) if callable(method) else None
        if code is not None and not _is_machinery(code.co_filename):
            return f" ({code.co_filename}:{code.co_firstlineno})"
    try:
        return f" ({inspect.getsourcefile(component)}:{inspect.getsourcelines(component)[1]})"
    except (OSError, TypeError):  # written where no file is
        return ""


def _file_of(component: type[Any] | None) -> str | None:
    try:
        return None if component is None else inspect.getfile(component)
    except (OSError, TypeError):
        return None


_MACHINERY = (f"{Path(__file__).parents[1]}{os.sep}", f"{Path(importlib.__file__).parent}{os.sep}", "<frozen importlib")


def _is_machinery(file: str) -> bool:
    """Whether a file is of this package or Python's import, not a user's."""
    return file.startswith(_MACHINERY)
