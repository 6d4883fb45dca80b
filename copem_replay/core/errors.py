"""The errors a user can meet, the words their messages are made of, and files under URLs, which fail in one line.

    CopemError
    ├── InputError            what was given is wrong: one line per problem, exit code 2
    │   ├── ExperimentError   … in an experiment file (file:line: key: …)
    │   └── RecordingError    … in a recording (file: …)
    │       ├── EgoError
    │       └── EmptyWindowError
    └── OutputError           what was asked for cannot be written, exit code 2

Anything else that escapes is a defect of this project: traceback, exit code 70.
"""

from __future__ import annotations

import difflib
import importlib
import inspect
import math
import os
import re
import textwrap
import traceback
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote, urlsplit

from copem_replay.core.waiting import await_server


def escape_unprintable(text: str) -> str:
    """The text on one line, without characters that a terminal would act on: names in a recording may hold anything."""
    return text if text.isprintable() else "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


MOST_LISTED = 50
"""At most so many problems, or names in a message, are listed, then "and N more"."""
_COMPARED = 100
"""An unknown name is compared with at most so many known ones: 20 µs each, and a file may have 10 000 of both."""


class CopemError(Exception):
    """Base of all errors that are not defects.

    `problems` holds one line each: where, what was expected, what was found, what to do. The error's own text has the
    first 50 of them, and says how many more there are.

    >>> try:
    ...     cr.load_experiment({"version": 1, "runs": 0})
    ... except cr.CopemError as error:
    ...     print(error)
    experiment: runs: expected at least 1, found 0
    experiment: configurations: missing
    """

    def __init__(self, problems: str | Sequence[str]) -> None:
        lines = (problems,) if isinstance(problems, str) else problems
        self.problems: tuple[str, ...] = tuple(hide_credentials(escape_unprintable(line)) for line in lines)
        more = len(self.problems) - MOST_LISTED
        super().__init__("\n".join([*self.problems[:MOST_LISTED], *([f"and {more:,} more"] if more > 0 else [])]))


class InputError(CopemError):
    """The input is wrong: an experiment, a recording, results, or an argument.

    >>> cr.load_results("nowhere")
    Traceback (most recent call last):
    copem_replay.core.errors.InputError: nowhere: expected a results folder, found no such folder; ...
    """


class ExperimentError(InputError):
    """An experiment is wrong, or does not fit its recordings.

    >>> cr.load_experiment("nowhere.yaml")
    Traceback (most recent call last):
    copem_replay.core.errors.ExperimentError: nowhere.yaml: no such file
    """


class RecordingError(InputError):
    """A recording cannot be read or replayed.

    Each of `problems` reads `path: topic: reason`. `path`: the file or folder, `topic`: where in it, `reasons`: what is
    wrong, a line each, without either. `key`: the key of an experiment file that asks in vain, () where none does.

    >>> cr.read_recording("logs/tc016d.mcap", ego="99")
    Traceback (most recent call last):
    copem_replay.core.errors.EgoError: logs/tc016d.mcap: ego: no moving object '99'; there are 1 (car), ...
    """

    _about: str | None = None

    def __init__(
        self,
        reasons: str | Sequence[str],
        *,
        path: Path | RemoteFile | None = None,
        topic: str | None = None,
        key: tuple[str | int, ...] = (),
    ) -> None:
        self.reasons = (reasons,) if isinstance(reasons, str) else tuple(reasons)
        self.path, self.topic, self.key = path, topic, key
        super().__init__(self._lines(path, topic))

    def _lines(self, path: Path | RemoteFile | None, topic: str | None) -> list[str]:
        where = "".join(f"{place}: " for place in (path, topic, self._about) if place is not None)
        return [f"{where}{reason}" for reason in self.reasons]

    def within(self, path: Path, topic: str | None = None) -> list[str]:
        """Return the problems without the path and topic that are these, for messages that name them already."""
        lines = self._lines(None if self.path == path else self.path, None if self.topic == topic else self.topic)
        return [hide_credentials(escape_unprintable(line)) for line in lines]


class EgoError(RecordingError):
    """The ego that is asked for is not in the recording; the line names `ego` as its place."""

    _about = "ego"

    def __init__(self, reasons: str | Sequence[str], *, path: Path) -> None:
        super().__init__(reasons, path=path, key=("ego",))


class EmptyWindowError(RecordingError):
    """The window holds no message of the truth.

    >>> cr.read_recording("logs/tc016d.mcap", window_s=(60, None))
    Traceback (most recent call last):
    copem_replay.core.errors.EmptyWindowError: logs/tc016d.mcap: ...
    """


class OutputError(CopemError):
    """A result cannot be written to its place.

    >>> cr.write_report("out/tc016d", "report.pdf")
    Traceback (most recent call last):
    copem_replay.core.errors.OutputError: report.pdf: expected a name that ends with .html or .htm, found report.pdf
    """


# Words of notes, messages and tables.


def wrap_line(line: str, width: int | None) -> list[str]:
    """A line in as many as it takes to fit, broken at spaces, the further ones indented; None: as it is.

    What has no spaces stays whole, so that paths and addresses can be copied.
    """
    if width is None or len(line) <= width:
        return [line]
    indent = " " * (len(line) - len(line.lstrip()))
    further = f"{indent}    "
    return textwrap.wrap(
        line, max(width, len(further) + 1), subsequent_indent=further,
        break_long_words=False, break_on_hyphens=False, drop_whitespace=True,
    )  # fmt: skip


def quote_value(value: object) -> str:
    """Return the value as an error quotes it: on one line, shortened."""
    text = "nothing" if value is None else repr(value)
    text = " ".join(text.split())
    return text if len(text) <= 60 else text[:57] + "…"


def count_noun(number: int, noun: str, plural: str = "") -> str:
    """`1 message`, `2 messages`; `plural` where it is not the noun with an s."""
    return f"{number} {noun if number == 1 else plural or noun + 's'}"


def name_first(names: Sequence[str], most: int, room: float = math.inf) -> str:
    """`a, b and 3 more`: the first `most` names; fewer, one at least, where that would take over `room` characters."""
    kept = range(min(most, len(names)), 0, -1)
    told = [", ".join(names[:k]) + f" and {len(names) - k} more" * (k < len(names)) for k in kept]
    return next((words for words in told if len(words) <= room), told[-1] if told else "")


def unknown_name_message(noun: str, name: object, known: Iterable[str]) -> str:
    """A message that a name is unknown, with the likely name, or else the known ones."""
    names = list(dict.fromkeys(known))
    near = difflib.get_close_matches(str(name), names[:_COMPARED], n=1)
    more = [f"… ({len(names):,} in all)"] if len(names) > MOST_LISTED else []
    hint = f"; did you mean {near[0]}?" if near else f"; there are {', '.join([*names[:MOST_LISTED], *more]) or 'none'}"
    return f"no {noun} is named {str(name)!r}{hint}"


def near_name_hint(name: str, known: Iterable[str]) -> str:
    """`; did you mean …?` with the known name that is alike, or the only one of this initial and about this length."""
    names = list(dict.fromkeys(known))
    alike = [one for one in names if one[:1] == name[:1] and abs(len(one) - len(name)) <= 1]
    near = difflib.get_close_matches(name, names, n=1) or (alike if len(alike) == 1 else [])
    return f"; did you mean {near[0]}?" if near else ""


# Files under URLs, which fsspec opens; it is not loaded where all files are on this machine. Access data (endpoints,
# profiles, keys) are in fsspec's own environment and files, never in an experiment; a URL is written and shown without
# its user, its query and what is behind `#`.

PROTOCOLS = (
    "s3", "s3a", "gs", "gcs", "az", "abfs", "abfss", "https", "http", "sftp", "ftp", "hdfs", "webhdfs", "memory",
)  # fmt: skip
"""Protocols of URLs that are opened: fsspec knows more, which read files of this machine, run programs, or open what a
file elsewhere names."""
_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*)(::\S*)?://")
_STAMPS = ("ETag", "etag", "md5Hash", "Last-Modified", "LastModified", "last_modified", "updated", "created")
"""Entries of a file system's listing that change with a file's content. Not `mtime`: the program that writes a file
(`rsync -t`) can set it."""


@dataclass(frozen=True, repr=False)
class RemoteFile:
    """A file under a URL. `info`: its entry in a listing; None: it was named, not listed."""

    url: str  # as it was given
    info: Mapping[str, Any] | None = field(default=None, compare=False)

    def __str__(self) -> str:
        """Its URL without user and query, fit to be written."""
        return strip_credentials(self.url)

    __repr__ = __str__

    @property
    def path(self) -> PurePosixPath:
        """Its path from the bucket or host on."""
        return PurePosixPath("/" + str(self).partition("://")[2])

    @property
    def name(self) -> str:
        """The last part of its path."""
        return self.path.name

    @cached_property
    def there(self) -> Mapping[str, Any] | None:
        """Its entry in the file system; None: there is no such file. Raises InputError where that cannot be asked."""
        if self.info is not None:
            return self.info
        fs, path = open_file_system(self.url)
        with reraise_in_one_line(self.url):
            fs.invalidate_cache()
            try:
                entry: Mapping[str, Any] = await_server(str(self), lambda _: fs.info(path))
            except FileNotFoundError as error:
                if (cause := error.__cause__) is not None and self.url.lower().startswith("http"):
                    raise cause from None  # the server may have failed for another reason
                return None
        return entry

    @property
    def stamp(self) -> tuple[int | None, str] | None:
        """Size, and a tag that changes with the content; None: the file system has no such tag."""
        entry = self.there or {}
        tag = next((entry[key] for key in _STAMPS if entry.get(key)), None)
        return None if tag is None else (entry.get("size"), str(tag))

    def fetch(self, to: str) -> None:
        """Copy it to a path on this machine. Raises InputError."""
        fs, path = open_file_system(self.url)
        with reraise_in_one_line(self.url):
            from fsspec.callbacks import Callback

            await_server(
                str(self), lambda received: fs.get_file(path, to, callback=Callback(hooks={"heard": received}))
            )


def is_url(text: str) -> bool:
    """Whether this is a URL, not a path."""
    return _SCHEME.match(text) is not None


def local_path(text: str) -> str:
    """A path as it is, and that of a `file://` URL, which is on this machine."""
    of_a_file = text.lower().startswith("file://") and "::" not in text
    return unquote(urlsplit(text).path) if of_a_file else text


def strip_credentials(url: str) -> str:
    """A URL without user, query and what is behind `#`; of a chain of URLs (`a::b`) each."""
    return "::".join(map(_strip_one, url.split("::")))


def _strip_one(url: str) -> str:
    scheme, separator, rest = url.partition("://")
    if not separator:
        return url
    rest = re.split(r"[?#]", rest, maxsplit=1)[0]
    host, slash, path = rest.partition("/")
    if "@" in path and not re.fullmatch(r"[^:]*(:\d*)?", host) and "@" not in host:  # a slash in the password
        return f"{scheme}://{path.rpartition('@')[2]}"
    return f"{scheme}://{host.rpartition('@')[2]}{slash}{path}"


def find_remote_files(pattern: str) -> list[RemoteFile]:
    """The files that a URL names, sorted; with `*`, `**` or `[…]` those that match. Raises InputError."""
    if not re.search(r"[*\[]", strip_credentials(pattern)):
        return [RemoteFile(pattern)]
    if pattern.startswith(("http://", "https://")):
        raise InputError(
            f"{strip_credentials(pattern)}: a web server lists nothing; expected the URL of a file, without `*`"
        )
    fs, path = open_file_system(pattern)
    with reraise_in_one_line(pattern):
        fs.invalidate_cache()
        check_answering(pattern, fs, re.split(r"[*\[]", path, maxsplit=1)[0].rpartition("/")[0])
        listing: dict[str, dict[str, Any]] = await_server(
            strip_credentials(pattern), lambda _: fs.glob(path, detail=True), works=True
        )
    scheme = pattern.partition("://")[0]
    files = {name: info for name, info in listing.items() if info.get("type") != "directory"}
    return [RemoteFile(f"{scheme}://{name.lstrip('/')}", files[name]) for name in sorted(files)]


def check_answering(url: str, fs: Any, path: str) -> None:
    """Ask for a path, which takes a server no time: a listing may take minutes. Raises TimeoutError."""
    with suppress(FileNotFoundError, PermissionError):
        await_server(strip_credentials(url), lambda _: fs.info(path))


def open_file_system(url: str, prefix: str = "") -> tuple[Any, str]:
    """The file system of a URL, and the path of the file in it. Raises InputError that says what to install.

    `prefix`: the beginning of the line.
    """
    protocol, place = url.partition("://")[0].lower(), f"{prefix}{strip_credentials(url)}"
    if "::" in url:
        raise InputError(f"{place}: expected the URL of a file, found URLs within a URL (`::`)")
    if protocol not in PROTOCOLS:
        raise InputError(f"{place}: expected a protocol of {', '.join(PROTOCOLS)}, found {protocol!r}")
    try:
        from fsspec.core import url_to_fs
        from fsspec.registry import known_implementations
    except ImportError:
        raise InputError(f"{place}: fsspec is not installed: pip install 'copem-replay[cluster]'") from None
    try:
        fs, path = url_to_fs(url)
    except ImportError:
        package = str(known_implementations.get(protocol, {}).get("class", protocol)).partition(".")[0]
        if package == "fsspec":  # fsspec has the protocol, but not the package it needs
            package = f"'fsspec[{'http' if protocol == 'https' else protocol}]'"
        raise InputError(f"{place}: {protocol}:// is not installed: pip install {package}") from None
    except ValueError as error:
        raise InputError(f"{place}: {_hide_credentials(str(error))}") from None
    return fs, path


@contextmanager
def reraise_in_one_line(url: str, failed: type[CopemError] = InputError, prefix: str = "") -> Iterator[None]:
    """Raise any failure with a URL as `failed`, in one line: errors of protocols' packages share no base."""
    try:
        yield
    except CopemError:
        raise
    except FileNotFoundError:
        raise failed(f"{prefix}{strip_credentials(url)}: no such file, folder or bucket") from None
    except PermissionError as error:
        raise failed(f"{prefix}{strip_credentials(url)}: access is denied ({_hide_credentials(str(error))})") from None
    except Exception as error:
        message = _hide_credentials(str(error))
        raise failed(f"{prefix}{strip_credentials(url)}: {message or type(error).__name__}") from None


def _hide_credentials(text: str) -> str:
    """An error in one line, without users and queries of URLs in it."""
    return hide_credentials(" ".join(text.split()))[:300]


_A_URL = re.compile(r"(?<![\w+.-])([A-Za-z][A-Za-z0-9+.-]+:/{1,2})([^\s'\"<>)]+)")
"""Also with one slash, which is what is left of two where a URL was taken for a path."""


def hide_credentials(text: str) -> str:
    """A text whose URLs have no user, no query and nothing behind `#`."""
    if ":/" not in text:
        return text

    def strip(match: re.Match[str]) -> str:
        begin, rest = match[1], match[2]
        if not begin.endswith("//") and begin.removesuffix(":/").lower() not in PROTOCOLS:
            return match[0]  # `rsu:/objects`: a topic
        end = rest[len(rest.rstrip(".,;:")) :]  # of the sentence around it
        whole = strip_credentials(f"{begin.rstrip('/')}//{rest.removesuffix(end)}")
        return begin + whole.partition("://")[2] + end

    return _A_URL.sub(strip, text)


# What code of the user's own raises.

FAILURES = (Exception, SystemExit)
"""Exceptions that a user's code may raise; an interrupt is none of them."""


def is_own(component: type[Any]) -> bool:
    """Whether a class is the user's, not built in."""
    return not component.__module__.startswith("copem_replay.")


def describe_failure(error: BaseException, component: type[Any] | None = None) -> str:
    """`ValueError: why (file:line)`: the innermost line in the file of the class, else the innermost of a user's."""
    why = " ".join(f"{type(error).__name__}: {error}".split()).removesuffix(":")
    if isinstance(error, SyntaxError):  # says where by itself
        return why
    frames = [f for f in traceback.extract_tb(error.__traceback__) if not _is_machinery(f.filename)]
    own_frames = [f for f in frames if f.filename == _source_file_of(component)]
    place = [f"{f.filename}:{f.lineno}" for f in (own_frames or frames)[-1:]]
    return f"{why} ({place[0]})" if place else why


def describe_source_line(component: type[Any], *methods: str) -> str:
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


def _source_file_of(component: type[Any] | None) -> str | None:
    try:
        return None if component is None else inspect.getfile(component)
    except (OSError, TypeError):
        return None


_MACHINERY = (f"{Path(__file__).parents[1]}{os.sep}", f"{Path(importlib.__file__).parent}{os.sep}", "<frozen importlib")


def _is_machinery(file: str) -> bool:
    """Whether a file is of this package or Python's import, not a user's."""
    return file.startswith(_MACHINERY)
