"""Where compiled code is cached: by Numba beside the source or in the user's cache, else in a folder of the user's own
under the system's temporary one.

An index in a cache names the classes of arguments. Numba reads it before it compares it with the source, so that one
which names a class that has gone fails: indices older than their source are removed first.

What is in a cache is run. So that folder has to be the user's, with no rights of others, and no link; where another is
in its place, one of this process alone is made.
"""

from __future__ import annotations

import os
import stat
import sys
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"


@cache
def cache_note() -> str | None:
    """Prepare the place for compiled code, once. Returns a note for the user, or None."""
    return prepare_cache(Path(__file__).parents[1])


def prepare_cache(package: Path, environment: Mapping[str, str] = os.environ) -> str | None:
    """Have a place for compiled code, before Numba is imported. Returns a note for the user, or None."""
    folders = _folders(package)
    _remove_stale(folders)
    if _writable(environment.get(VARIABLE)) or all(_writable(f"{folder}/__pycache__") for folder in folders):
        return None
    home = environment.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    if _writable(f"{home}/numba"):
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


def _folders(package: Path) -> list[str]:
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


def _writable(folder: str | None) -> bool:
    """Whether files can be made in a folder; it is made, as Numba makes it, where it is not there."""
    if not folder:
        return False
    try:
        os.makedirs(folder, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK | os.X_OK)


def _own_folder() -> tuple[str, str]:
    """A folder that no other user can write, and what is odd about it. Raises OSError."""
    import atexit
    import shutil
    import tempfile

    folder = f"{tempfile.gettempdir()}/copem_replay-{os.geteuid()}"
    with suppress(FileExistsError):
        os.mkdir(folder, 0o700)
    found = os.lstat(folder)
    if stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid() and not found.st_mode & 0o077:
        return folder, ""
    mine = tempfile.mkdtemp(prefix=f"copem_replay-{os.geteuid()}-")
    atexit.register(shutil.rmtree, mine, ignore_errors=True)
    return mine, f" for this process alone ({folder} is not a folder of this user alone)"
