"""Object storage on this machine: moto's server in a process of its own, and a bucket in it for each test."""

from __future__ import annotations

import itertools
import re
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

_NUMBERS = itertools.count()


@dataclass(frozen=True)
class Bucket:
    """`url`: of the bucket. `said`: where the server writes a line per request."""

    url: str
    endpoint: str
    said: Path
    fs: Any

    def put(self, path: Path, key: str) -> str:
        """Copy a file there. Returns its URL."""
        self.fs.pipe_file(f"{self.url}/{key}", path.read_bytes())
        return f"{self.url}/{key}"

    def requests(self) -> list[tuple[str, str]]:
        """Method and path of each request so far: GET of an object, of a listing, PUT, …"""
        mark = f"/moto-api/?mark={next(_NUMBERS)}"
        urllib.request.urlopen(self.endpoint + mark).close()
        while mark not in (said := self.said.read_text(encoding="utf-8")):
            pass  # on its way through a pipe
        found: list[tuple[str, str]] = re.findall(r'"([A-Z]+) (\S+) HTTP', said)
        return [one for one in found if "moto-api" not in one[1]]


@pytest.fixture(scope="session")
def moto(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Path]]:
    """Where the server listens, and what it says."""
    said = tmp_path_factory.mktemp("moto") / "requests"
    with said.open("w", encoding="utf-8") as file:
        command = [sys.executable, "-u", "-m", "moto.server", "-H", "127.0.0.1", "-p", "0"]
        server = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        assert server.stderr is not None
        address = next(found[1] for line in server.stderr if (found := re.search(r"(http://127\.0\.0\.1:\d+)", line)))
        # What it says from now on goes to the file, so that it never waits for a reader.
        copy = subprocess.Popen(["cat"], stdin=server.stderr, stdout=file)
        try:
            yield address, said
        finally:
            server.kill()
            server.wait()
            copy.wait()
            server.stderr.close()


@pytest.fixture
def bucket(moto: tuple[str, Path], monkeypatch: pytest.MonkeyPatch) -> Bucket:
    """An empty bucket, which this process and those it starts get to by their environment alone."""
    import fsspec.config
    import s3fs

    endpoint, said = moto
    given = {
        "FSSPEC_S3_ENDPOINT_URL": endpoint,
        "AWS_ACCESS_KEY_ID": "nobody",
        "AWS_SECRET_ACCESS_KEY": "secret",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_EC2_METADATA_DISABLED": "true",
    }
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setitem(fsspec.config.conf, "s3", {"endpoint_url": endpoint})  # fsspec looks at it when it is imported
    fs, name = s3fs.S3FileSystem(), f"drives-{next(_NUMBERS)}"
    fs.mkdir(name)
    return Bucket(f"s3://{name}", endpoint, said, fs)
