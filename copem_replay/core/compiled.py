"""Compiled functions: decorators for the inner ones, and the place where their code is cached.

At each call Numba counts, atomically, references to each array that is handed over. For a function called for each
entry this takes several times as long as its work. `borrowing` and `making` say whether references are counted; the
option is private to Numba, and functions that are called inherit it:
docs/develop/decisions/0039-counted-references.md.

Numba caches code beside the source or in the user's cache. Where neither can be written, the cache is a folder of the
user's own under the system's temporary one. An index in a cache names the classes of arguments. Numba reads it before
it compares it with the source, so an index that names a class that is gone fails: indices older than their source are
removed first. Any other code in the cache that cannot be used (truncated, of a module that is gone) is compiled again:
Numba itself would raise, at every call, what reading it raises.

Cached code is run. So the folder must be the user's, without rights for others, and no link; where something else is in
its place, a folder of this process alone is made.
"""

from __future__ import annotations

import importlib.util
import os
import secrets
import stat
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

Function = TypeVar("Function", bound=Callable[..., Any])


def kernel(function: Function) -> Function:
    """The function, compiled at its first call: kept in the cache, and without Python's global lock."""
    return _compile(function)


def borrowing(function: Function) -> Function:
    """`kernel` for functions that make no array and return none: their arguments outlive them."""
    return _compile(function, _nrt=False)


def making(function: Function) -> Function:
    """`kernel` for functions that make arrays and are called by borrowing ones."""
    return _compile(function, _nrt=True)


def _compile(function: Function, **options: bool) -> Function:
    return cast("Function", _kernel_class()(function, {"nogil": True, **options}))


@cache
def _kernel_class() -> Any:
    # Imported by kernels alone: the place of the cache is prepared before.
    from copem_replay.core.callees import Kernel, watch_compiling

    watch_compiling(compiling.count)
    return Kernel


@dataclass
class Compiling:
    """Kernels that were not in the cache: how many this process has begun to compile, how many it compiles now."""

    begun: int = 0
    running: int = 0

    def count(self, step: int) -> None:
        """1: one begins, −1: it ends. Numba compiles under one lock."""
        self.running += step
        self.begun += step > 0


compiling = Compiling()
"""Of this process."""


VARIABLE = "NUMBA_CACHE_DIR"
"""The environment variable that names Numba's cache."""


@cache
def cache_note() -> str | None:
    """Prepare the place for compiled code, once. Returns a note for the user, or None."""
    watch_numba()
    return prepare_cache(Path(__file__).parents[1])


def recompiled_note() -> str | None:
    """A note where cached code could not be used in this process and was compiled again, or None."""
    if not _unusable:
        return None
    (name, why), more = _unusable[0], len(_unusable) - 1
    others = f", and {more} more," if more else ""
    return f"compiled code of {name}{others} could not be read from its cache ({why}): compiled again"


def prepare_cache(package: Path, environment: Mapping[str, str] = os.environ) -> str | None:
    """Provide a place for compiled code, before Numba is imported. Returns a note for the user, or None."""
    folders = _package_folders(package)
    _remove_stale(folders)
    if _is_writable(environment.get(VARIABLE)) or all(_is_writable(f"{folder}/__pycache__") for folder in folders):
        return None
    home = environment.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    if _is_writable(f"{home}/numba"):
        return None
    try:
        folder, why = _own_folder()
    except OSError:  # not even there: Numba says so, where something is compiled
        return None
    os.environ[VARIABLE] = folder
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = folder
    cached = f"compiled code is cached in {folder}{why}, as neither {package} nor {home} can be written"
    return f"{cached}; {VARIABLE} names another"


def _package_folders(package: Path) -> list[str]:
    """The package, and all packages in it."""
    return [folder for folder, _, files in os.walk(package) if "__init__.py" in files]


def _remove_stale(folders: list[str]) -> None:
    """Remove indices of compiled code that are older than the module they are of (`module.function-line.py311.nbi`)."""
    for folder in folders:
        with suppress(OSError), os.scandir(f"{folder}/__pycache__") as files:
            for index in files:
                if index.name.endswith(".nbi"):
                    with suppress(OSError):
                        source = os.stat(f"{folder}/{index.name.partition('.')[0]}.py")
                        if index.stat().st_mtime_ns < source.st_mtime_ns:
                            os.remove(index.path)


def _is_writable(folder: str | None) -> bool:
    """Whether files can be made in a folder; it is made, as Numba makes it, where it is not there."""
    if not folder:
        return False
    try:
        os.makedirs(folder, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK | os.X_OK)


def _own_folder() -> tuple[str, str]:
    """A folder that no other user can write, and words on where it is, for the note. Raises OSError."""
    import atexit
    import shutil
    import tempfile

    user = os.geteuid() if hasattr(os, "geteuid") else 0  # Windows: a temporary folder per user, and all files of 0
    folder = f"{tempfile.gettempdir()}/copem_replay-{user}"
    with suppress(FileExistsError):
        os.mkdir(folder, 0o700)
    status = os.lstat(folder)
    if stat.S_ISDIR(status.st_mode) and status.st_uid == user and not status.st_mode & 0o077:
        return folder, ""
    own = tempfile.mkdtemp(prefix=f"copem_replay-{user}-")
    atexit.register(shutil.rmtree, own, ignore_errors=True)
    return own, f" for this process alone ({folder} is not a folder of this user alone)"


# Two places of Numba are changed when it is imported, as it offers none for this. The methods that read and write its
# cache are replaced, for the functions of this package alone: cached code may be of no use, or another's.

_CACHING, _ALGEBRA = "numba.core.caching", "numba.np.linalg"
_unusable: list[tuple[str, str]] = []
"""The functions whose cached code could not be used in this process, and why."""


class _NumbaWatch:
    """An entry of `sys.meta_path` that changes a module of Numba as soon as it is imported."""

    def __init__(self, name: str, change: Callable[[Any], None]) -> None:
        self.name, self.change = name, change

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> Any:
        """The specification of that one module, once; None for all others."""
        if name != self.name:
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(name)
        if spec is not None and spec.loader is not None:
            run = spec.loader.exec_module

            def run_and_change(module: Any) -> None:
                run(module)
                self.change(module)

            spec.loader.exec_module = run_and_change  # type: ignore[method-assign]
        return spec


def watch_numba() -> None:
    """From now on cached code of this package that cannot be used is compiled again, whoever imports Numba."""
    for name, change in ((_CACHING, _tolerate), (_ALGEBRA, _assume_blas)):
        if name in sys.modules:
            change(sys.modules[name])
        else:
            sys.meta_path.insert(0, _NumbaWatch(name, change))


def _assume_blas(algebra: Any) -> None:
    """SciPy is there, with its BLAS: to see that, Numba imports scipy.linalg in every process, a tenth of a second."""
    algebra.ensure_blas = lambda: None


def _tolerate(caching: Any) -> None:
    """Replace how Numba's caches load and save.

    What cannot be loaded is forgotten, and there is nothing. Numba's own way first loads all that compiling needs, a
    tenth of a second. Cached code needs the runtime alone.

    A file of code has a name of its own. Numba numbers the files of a function by its index: where two processes
    compile it at once for other arguments, one's code would have the name that the other's index gives.
    """
    from numba.core.runtime.nrt import rtsys

    caches = caching.FunctionCache
    load, save = caches.load_overload, caches.save_overload

    def is_ours(function: Any) -> bool:
        return bool(function.__module__.startswith(f"{__package__.partition('.')[0]}."))

    def save_apart(self: Any, sig: Any, data: Any) -> None:
        if is_ours(self._py_func):
            file = self._cache_file
            file._data_name_pattern = f"{file._index_name.removesuffix('.nbi')}.{secrets.token_hex(4)}.{{number:d}}.nbc"
        save(self, sig, data)

    def load_or_forget(self: Any, sig: Any, target_context: Any) -> Any:
        function = self._py_func
        if not is_ours(function):
            return load(self, sig, target_context)
        try:
            rtsys.initialize(target_context)
            with self._guard_against_spurious_io_errors():
                return self._load_overload(sig, target_context)
        except MemoryError:
            raise
        except Exception as error:  # whatever unpickling anything raises
            why = " ".join(f"{type(error).__name__}: {error}".split())[:200]
            _unusable.append((f"{function.__module__}.{function.__qualname__}", why))
            with suppress(OSError):  # of a cache that cannot be written nothing is taken, either
                self.flush()
            return None

    caches.load_overload, caches.save_overload = load_or_forget, save_apart
