"""The cache of compiled code: where it is, which code in it is of use, and who writes.

Numba asks a locator class for the place of each function's code; `NUMBA_CACHE_LOCATOR_CLASSES` may name any. The one
here is named only while a kernel of this package is decorated, so functions of others are cached as ever.

Code is of use for the sources it was made of: names of files carry a digest of the module's source, of all modules of
the package that it imports, and of the versions of NumPy and Numba. Numba itself looks at one file, and at processor
and system. Code of other sources is removed when the function's own is written. Beside a function's files are their
checksums: where one differs, nothing of the function is used, and it is compiled again.

Cached code is run. So the folder is the package's or the user's, without rights for others where it is under the
temporary one, and no link; where something else is in its place, a folder of this process alone is made.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import stat
import sys
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from threading import Lock, local
from typing import Any, NamedTuple

from copem_replay.core.files import try_lock

VARIABLE = "NUMBA_CACHE_DIR"
"""The environment variable that names Numba's cache."""
PACKAGE = Path(__file__).parents[1]


def cache_note() -> str | None:
    """A note for the user on a cache that is neither beside the package nor in the user's own cache, or None."""
    if "numba" not in sys.modules:  # nothing is compiled
        return None
    try:
        return _find_place(sys.modules["numba"].config.CACHE_DIR).note
    except OSError:
        return None


_naming = Lock()


@contextmanager
def keep_code() -> Iterator[None]:
    """While the block lasts, decorated functions have their code where `KernelLocator` says."""
    from numba.core import config

    _release_after_writing()
    with _naming:
        named = config.CACHE_LOCATOR_CLASSES
        config.CACHE_LOCATOR_CLASSES = f"{__name__}.{KernelLocator.__name__}"
        try:
            yield
        finally:
            config.CACHE_LOCATOR_CLASSES = named


class KernelLocator:
    """The locator that Numba asks for the place of a kernel's code."""

    def __init__(self, function: Any, file: str) -> None:
        from numba.core import config

        self._py_file = file  # which Numba names in warnings
        self._digest, self._line = _digest(file), function.__code__.co_firstlineno
        self._name = f"{Path(file).stem}.{function.__qualname__.replace('<', '').replace('>', '')}-"
        self._folder = Path(_find_place(config.CACHE_DIR).folder)
        python = f".py{sys.version_info[0]}{sys.version_info[1]}"
        self._files = f"{self._name}{self.get_disambiguator()}{python}{getattr(sys, 'abiflags', '')}"  # as Numba names
        self._sums = self._folder / f"{self._files}.json"
        self._forget_damaged()

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> KernelLocator | None:
        """The locator of a function; None: there is no folder that can be written, or no source."""
        try:
            return cls(function, file)
        except OSError:
            return None

    def get_cache_path(self) -> str:
        """The folder of the code."""
        return str(self._folder)

    def get_source_stamp(self) -> str:
        """A stamp that changes with the sources."""
        return self._digest

    def get_disambiguator(self) -> str:
        """The part of file names that tells functions and sources apart."""
        return f"{self._line}-{self._digest}"

    def ensure_cache_path(self) -> None:
        """Before Numba writes code: wait until no other process does, and remove the code of other sources."""
        self._folder.mkdir(parents=True, exist_ok=True)
        _writing.begin(self)
        python = self._files.rpartition(".")[2]
        for path in self._folder.iterdir():
            if path.name.startswith(self._name) and f".{python}." in path.name and self._digest not in path.name:
                with suppress(OSError):
                    path.unlink()

    def open_lock(self) -> int:
        """The file that is locked while a process writes."""
        return os.open(self._folder / "writing.lock", os.O_RDWR | os.O_CREAT | getattr(os, "O_CLOEXEC", 0), 0o600)

    def write_sums(self) -> None:
        """Write the checksums of this function's files."""
        files = [*self._folder.glob(f"{self._files}.nbi"), *self._folder.glob(f"{self._files}.*.nbc")]
        sums = {path.name: zlib.crc32(path.read_bytes()) for path in files}
        new = self._sums.with_suffix(f".{os.getpid()}.tmp")
        new.write_text(json.dumps(sums))
        os.replace(new, self._sums)

    def _forget_damaged(self) -> None:
        # Without its index Numba finds no code of a function. While a process writes, index and checksums differ.
        index = self._folder / f"{self._files}.nbi"
        if index.exists() and not self._is_whole(index.name):
            _writing.begin(self)
            try:
                if not self._is_whole(index.name):
                    index.unlink(missing_ok=True)
            finally:
                _writing.end()

    def _is_whole(self, index: str) -> bool:
        try:
            sums = json.loads(self._sums.read_bytes())
            return index in sums and all(
                zlib.crc32((self._folder / name).read_bytes()) == crc for name, crc in sums.items()
            )
        except (OSError, ValueError, TypeError, AttributeError):  # missing, or damaged itself
            return False


# Numba names files of code by number: the first that its index does not have. Where two processes wrote code of one
# function for other arguments at once, the index of one would name the code of the other. So one writes at a time.


class _Writing(local):
    """The function whose code this thread writes, and its lock, while it does."""

    locator: KernelLocator | None = None
    lock: int = -1

    def begin(self, locator: KernelLocator) -> None:
        """Wait for the lock."""
        self.end()
        self.lock, self.locator = locator.open_lock(), locator
        while try_lock(self.lock) is False:
            time.sleep(0.002)

    def end(self) -> None:
        """Write checksums, and release the lock."""
        if self.locator is not None:
            with suppress(OSError):
                self.locator.write_sums()
            os.close(self.lock)
            self.locator = None


_writing = _Writing()


@cache
def _release_after_writing() -> None:
    """From now on what `ensure_cache_path` locks is released when Numba has written: it then leaves its own lock."""
    from numba.core.event import Event, Listener, register

    class Watch(Listener):  # type: ignore[misc]  # Numba has no types
        def on_start(self, event: Event) -> None:
            pass

        def on_end(self, event: Event) -> None:
            _writing.end()

    register("numba:compiler_lock", Watch())


# What code is made of.

_IMPORTED = re.compile(rb"^from (copem_replay[\w.]*) import (\([^)]*\)|.*)", re.MULTILINE)


@cache
def _digest(file: str) -> str:
    """A digest of a source, of all sources of this package that it imports, and of the versions of NumPy and Numba.

    Raises OSError: one cannot be read.
    """
    import numba
    import numpy

    sources, to_read = dict[str, bytes](), [os.path.abspath(file)]
    while to_read:
        if (path := to_read.pop()) not in sources:
            sources[path], imported = _read_source(path)
            to_read += imported
    versions = f"numpy {numpy.__version__} numba {numba.__version__}".encode()
    return hashlib.sha256(versions + b"".join(sorted(sources.values()))).hexdigest()[:16]


@cache
def _read_source(path: str) -> tuple[bytes, tuple[str, ...]]:
    """The digest of a source, and the files of the modules of this package that it imports."""
    text, files = Path(path).read_bytes(), list[str]()
    for name, imported in _IMPORTED.findall(text):
        place = f"{PACKAGE.parent}/{name.decode().replace('.', '/')}"
        if not os.path.isdir(place):
            files.append(f"{place}.py")
            continue
        files += [f"{place}/{one}.py" for one in ("__init__", *re.findall(r"\w+", imported.decode()))]
    return hashlib.sha256(text).digest(), tuple(filter(os.path.isfile, files))


# The folder.


class _Place(NamedTuple):
    folder: str
    note: str | None = None


@cache
def _find_place(named: str) -> _Place:
    """The folder for compiled code. `named`: the folder that the user names, or "". Raises OSError: there is none."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    apart = f"copem_replay-{hashlib.sha256(os.fsencode(PACKAGE)).hexdigest()[:8]}"  # beside code of other copies
    folders = [f"{PACKAGE}/__pycache__", f"{home}/numba/{apart}"]
    place = next(filter(_is_writable, [f"{named}/{apart}"] * bool(named) + folders), None)
    if place is not None:
        return _Place(place)
    folder, why = _own_folder()
    cached = f"compiled code is cached in {folder}{why}, as neither {PACKAGE} nor {home} can be written"
    return _Place(folder, f"{cached}; {VARIABLE} names another")


def _is_writable(folder: str) -> bool:
    """Whether files can be made in a folder; it is made where it is not there."""
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
