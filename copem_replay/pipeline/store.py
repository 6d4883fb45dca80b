"""Where pieces are kept: bytes by name, in a folder or under a URL. A name is complete, or it is not there.

Two that write the same name write the same bytes. A store is pickled as its address: every process opens its own.
"""

from __future__ import annotations

import os
import tempfile
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import urlsplit

from copem_replay.core.errors import InputError, OutputError
from copem_replay.core.remote import bare, file_system, in_one_line, is_url, local_path

_SAID = "--pieces: "
MARK = "pieces.txt"
"""Written once under a URL: a bucket that is missing, or not ours, is found out before anything is computed."""


class Store(Protocol):
    """Bytes by name. `where`: its address, as it may be written."""

    where: str

    def exists(self, name: str) -> bool:
        """Whether there is such a name."""

    def read(self, name: str) -> bytes | None:
        """What is kept under a name; None: there is no such name. Raises InputError, OSError."""

    def write(self, name: str, content: bytes) -> None:
        """Keep something under a name. Raises OutputError."""

    def names(self) -> set[str]:
        """All names, listed anew: what other processes have written is among them."""

    def refresh(self) -> None:
        """Find what other processes have written since."""


def store_at(address: str | Path) -> Store:
    """The store in a folder, or under a URL. Raises InputError, OutputError."""
    if isinstance(address, Path) or not is_url(address := local_path(address)):
        return Folder(Path(address))
    return Bucket(address)


class Folder:
    """On this machine, or where this machine sees it: a temporary name, then the right one."""

    def __init__(self, root: Path) -> None:
        self.root, self.where = root, str(root)
        try:
            for name in ("pieces", "logs"):
                (root / name).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{_SAID}{root}: cannot be written: {error.strerror or error}") from error

    def exists(self, name: str) -> bool:
        """Whether there is such a file."""
        return (self.root / name).is_file()

    def read(self, name: str) -> bytes | None:
        """What is in a file; None: there is none. Raises OSError."""
        try:
            return (self.root / name).read_bytes()
        except FileNotFoundError:
            return None

    def write(self, name: str, content: bytes) -> None:
        """Complete under its name, or not there. Raises OutputError."""
        place = self.root / name
        try:
            place.parent.mkdir(exist_ok=True)
            with tempfile.NamedTemporaryFile(dir=place.parent, prefix=f".{place.name}.", delete=False) as file:
                try:
                    file.write(content)  # not waited for until it is on the disk: what a crash damages has no seal
                    file.close()
                    os.replace(file.name, place)
                except BaseException:
                    Path(file.name).unlink(missing_ok=True)
                    raise
        except OSError as error:
            raise OutputError(f"{place}: cannot be written: {error.strerror or error}") from error

    def names(self) -> set[str]:
        """All files but those that are being written."""
        files = (path for path in self.root.rglob("[!.]*") if path.is_file())
        return {path.relative_to(self.root).as_posix() for path in files}

    def refresh(self) -> None:
        """Nothing to do: each file is looked for when it is asked for."""


class Bucket:
    """Object storage, by fsspec: one request writes a whole object, and one listing says what is there."""

    def __init__(self, url: str) -> None:
        self.url, self.where = url.rstrip("/"), bare(url).rstrip("/")
        if urlsplit(url).query:
            raise InputError(f"{_SAID}{self.where}: expected a URL without a query, names are put behind it")
        if MARK not in self._listed:
            self.write(MARK, b"pieces of copem-replay\n")

    def __getstate__(self) -> dict[str, Any]:
        """Its address alone: connections are of one process."""
        return {"url": self.url, "where": self.where}

    @cached_property
    def _opened(self) -> tuple[Any, str]:
        fs, path = file_system(self.url, _SAID)
        return fs, path.rstrip("/")

    @cached_property
    def _listed(self) -> set[str]:
        return self.names()

    def exists(self, name: str) -> bool:
        """Whether it was there when it was listed last, or was written since."""
        return name in self._listed

    def read(self, name: str) -> bytes | None:
        """What is in an object; None: it was not there when it was listed last. Raises InputError."""
        fs, path = self._opened
        if name not in self._listed:
            return None
        with in_one_line(f"{self.url}/{name}", what=_SAID):
            try:
                content: bytes = fs.cat_file(f"{path}/{name}")
            except FileNotFoundError:  # removed since
                return None
        return content

    def write(self, name: str, content: bytes) -> None:
        """One request: complete, or not there. Raises OutputError."""
        fs, path = self._opened
        with in_one_line(f"{self.url}/{name}", OutputError, _SAID):
            fs.pipe_file(f"{path}/{name}", content)
        if "_listed" in self.__dict__:
            self._listed.add(name)

    def names(self) -> set[str]:
        """All objects. Raises InputError."""
        fs, path = self._opened
        with in_one_line(self.url, what=_SAID):
            fs.invalidate_cache()
            found = fs.find(path)
        self._listed = {name.partition(f"{path}/")[2] for name in found}
        return self._listed

    def refresh(self) -> None:
        """List anew."""
        self.names()
