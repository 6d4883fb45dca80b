"""Files elsewhere: URLs that fsspec opens. Nothing of it is loaded where all files are on this machine.

Access data (endpoints, profiles, keys) are in fsspec's own environment and files, never in an experiment; a URL is
written and said without its user and its query.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import PurePosixPath
from typing import Any
from urllib.parse import unquote, urlsplit

from copem_replay.core.errors import CopemError, InputError

_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*)://")
_STAMPS = ("ETag", "etag", "md5Hash", "Last-Modified", "LastModified", "last_modified", "updated", "created")
"""Under one of these a file system says what changes with a file's content. Not `mtime`: whoever writes a file there
(`rsync -t`) says of what time it is."""


@dataclass(frozen=True, repr=False)
class Remote:
    """A file under a URL. `info`: what a listing said of it; None: it was named, not found."""

    url: str  # as it was given
    info: Mapping[str, Any] | None = field(default=None, compare=False)

    def __str__(self) -> str:
        """Without user and query, as it may be written."""
        return bare(self.url)

    __repr__ = __str__

    @property
    def path(self) -> PurePosixPath:
        """Its path there, from the bucket or host on."""
        return PurePosixPath("/" + str(self).partition("://")[2])

    @property
    def name(self) -> str:
        """The last part of it."""
        return self.path.name

    @cached_property
    def there(self) -> Mapping[str, Any] | None:
        """Its entry in the file system; None: there is no such file. Raises InputError: it cannot be asked."""
        if self.info is not None:
            return self.info
        fs, path = file_system(self.url)
        with in_one_line(self.url):
            fs.invalidate_cache()
            try:
                found: Mapping[str, Any] = fs.info(path)
            except FileNotFoundError as error:
                if (cause := error.__cause__) is not None and self.url.lower().startswith("http"):
                    raise cause from None  # which may be another than that there is none
                return None
        return found

    @property
    def stamp(self) -> tuple[int | None, str] | None:
        """Size and what changes with the content; None: the file system says no such thing."""
        said = self.there or {}
        tag = next((said[key] for key in _STAMPS if said.get(key)), None)
        return None if tag is None else (said.get("size"), str(tag))

    def fetch(self, to: str) -> None:
        """Copy it to a path on this machine. Raises InputError."""
        fs, path = file_system(self.url)
        with in_one_line(self.url):
            fs.get_file(path, to)


def is_url(text: str) -> bool:
    """Whether this is a URL, not a path."""
    return _SCHEME.match(text) is not None


def local_path(text: str) -> str:
    """A path as it is, and that of a `file://` URL, which is on this machine."""
    return unquote(urlsplit(text).path) if text.lower().startswith("file://") else text


def bare(url: str) -> str:
    """A URL without user and query."""
    scheme, _, rest = url.partition("://")
    host, slash, path = rest.partition("?")[0].partition("/")
    return f"{scheme}://{host.rpartition('@')[2]}{slash}{path}"


def matches(pattern: str) -> list[Remote]:
    """The files that a URL names, sorted; with `*`, `**` or `[…]` those that match. Raises InputError."""
    if not re.search(r"[*\[]", bare(pattern)):
        return [Remote(pattern)]
    if pattern.startswith(("http://", "https://")):
        raise InputError(f"{bare(pattern)}: a web server lists nothing; expected the URL of a file, without `*`")
    fs, path = file_system(pattern)
    with in_one_line(pattern):
        fs.invalidate_cache()
        found: dict[str, dict[str, Any]] = fs.glob(path, detail=True)
    scheme = pattern.partition("://")[0]
    files = {name: info for name, info in found.items() if info.get("type") != "directory"}
    return [Remote(f"{scheme}://{name.lstrip('/')}", files[name]) for name in sorted(files)]


def file_system(url: str, what: str = "") -> tuple[Any, str]:
    """What opens a URL, and what the file is called there. Raises InputError with what to install.

    `what`: begins the line.
    """
    protocol, said = url.partition("://")[0].lower(), f"{what}{bare(url)}"
    try:
        from fsspec.core import url_to_fs
        from fsspec.registry import known_implementations
    except ImportError:
        raise InputError(f"{said}: fsspec is not installed: pip install 'copem-replay[cluster]'") from None
    known = known_implementations.get(protocol)
    try:
        fs, path = url_to_fs(url)
    except ImportError:
        package = str((known or {}).get("class", protocol)).partition(".")[0]
        if package == "fsspec":  # which has it, but not what it needs
            package = f"'fsspec[{'http' if protocol == 'https' else protocol}]'"
        raise InputError(f"{said}: {protocol}:// is not installed: pip install {package}") from None
    except ValueError as error:
        if known is None:
            reason = f"expected a protocol that fsspec knows (s3, gs, az, https, …), found {protocol!r}"
            raise InputError(f"{said}: {reason}") from None
        raise InputError(f"{said}: {_without_secrets(str(error))}") from None
    return fs, path


@contextmanager
def in_one_line(url: str, failed: type[CopemError] = InputError, what: str = "") -> Iterator[None]:
    """Whatever goes wrong with a URL as one line: the errors of protocols' packages have no base of their own."""
    try:
        yield
    except CopemError:
        raise
    except FileNotFoundError:
        raise failed(f"{what}{bare(url)}: no such file, folder or bucket") from None
    except PermissionError as error:
        raise failed(f"{what}{bare(url)}: access is denied ({_without_secrets(str(error))})") from None
    except Exception as error:
        said = _without_secrets(str(error))
        raise failed(f"{what}{bare(url)}: {said or type(error).__name__}") from None


def _without_secrets(text: str) -> str:
    """An error in one line, without users and queries of URLs in it."""
    text = re.sub(r"://[^\s/@'\"]*@", "://", " ".join(text.split()))
    return re.sub(r"(://[^\s?'\"]*)\?[^\s'\")]*", r"\1", text)[:300]
