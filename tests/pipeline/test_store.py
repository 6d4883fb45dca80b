"""Stores: bytes by name, in a folder or under a URL, from any process."""

from __future__ import annotations

import pickle
import subprocess
import sys
from pathlib import Path

import pytest

from copem_replay.core.errors import InputError, OutputError
from copem_replay.pipeline.parts import open_store
from tests.helpers.object_storage import Bucket


@pytest.mark.parametrize("kind", ["folder", "file", "memory", "s3"])
def test_what_is_written_is_there_for_every_process_that_has_the_address(
    kind: str, tmp_path: Path, bucket: Bucket
) -> None:
    address = {
        "folder": str(tmp_path / "kept"),
        "file": (tmp_path / "kept").as_uri(),
        "memory": f"memory://{tmp_path.name}/kept",
        "s3": f"{bucket.url}/kept/",
    }[kind]
    store = open_store(address)
    assert store.read("parts/ab/1.arrows") is None
    store.write("parts/ab/1.arrows", b"one")
    store.write("parts/ab/1.arrows", b"other")
    store.write("logs/2.json", b"")
    assert (store.read("parts/ab/1.arrows"), store.read("logs/2.json")) == (b"other", b"")
    assert store.exists("logs/2.json")
    assert not store.exists("logs/3.json")
    other = pickle.loads(pickle.dumps(store))
    other.write("logs/3.json", b"3")
    store.refresh()
    assert [store.exists(name) for name in ("parts/ab/1.arrows", "logs/2.json", "logs/3.json")] == [True] * 3
    assert store.read("logs/3.json") == b"3"


def test_a_process_of_its_own_writes_what_this_one_reads(bucket: Bucket) -> None:
    store = open_store(f"{bucket.url}/kept")
    code = "import pickle, sys; pickle.load(sys.stdin.buffer).write('logs/1.json', b'from elsewhere')"
    subprocess.run([sys.executable, "-c", code], input=pickle.dumps(store), check=True)
    assert store.read("logs/1.json") is None, "not there when it was listed"
    store.refresh()
    assert store.exists("logs/1.json")
    assert store.read("logs/1.json") == b"from elsewhere"


def test_one_request_writes_a_part_and_one_listing_says_what_is_there(bucket: Bucket) -> None:
    store = open_store(f"{bucket.url}/kept")
    for k in range(5):
        store.write(f"parts/ab/{k}.arrows", bytes(1000))
    before = len(bucket.requests())
    again = open_store(f"{bucket.url}/kept")
    assert [again.exists(f"parts/ab/{k}.arrows") for k in range(7)] == [True] * 5 + [False] * 2
    assert [again.read(f"parts/cd/{k}.arrows") for k in range(7)] == [None] * 7
    again.write("parts/cd/1.arrows", bytes(6_000_000))
    since = bucket.requests()[before:]
    assert [method for method, path in since if "list-type" in path] == ["GET"]
    assert [method for method, path in since if "list-type" not in path] == ["HEAD", "PUT"], "whether it answers"


def test_what_cannot_be_kept_is_said_in_one_line(bucket: Bucket, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(address: str) -> str:
        with pytest.raises((InputError, OutputError)) as error:
            open_store(address)
        (line,) = error.value.problems
        return line

    assert refused("s3://there-is-none/kept") == "--pieces: s3://there-is-none/kept: no such file, folder or bucket"
    assert refused("drives://here").startswith("--pieces: drives://here: expected a protocol of s3,")
    query = refused(f"{bucket.url}/kept?token=secret")
    assert query == f"--pieces: {bucket.url}/kept: expected a URL without a query, names are put behind it"
    assert "127.0.0.1" in refused("http://nobody:secret@127.0.0.1:1/kept")
    assert "secret" not in refused("http://nobody:secret@127.0.0.1:1/kept")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", "/nowhere")
    monkeypatch.setenv("AWS_CONFIG_FILE", "/nowhere")
    type(bucket.fs).clear_instance_cache()
    try:
        assert refused(f"{bucket.url}/kept") == f"--pieces: {bucket.url}/kept: Unable to locate credentials"
    finally:
        type(bucket.fs).clear_instance_cache()


@pytest.mark.parametrize(
    ("absent", "url", "said"),
    [
        ("fsspec", "s3://b/x", "s3://b/x: fsspec is not installed: pip install 'copem-replay[cluster]'"),
        ("s3fs", "s3://b/x", "s3://b/x: s3:// is not installed: pip install s3fs"),
        ("gcsfs", "gs://b/x", "gs://b/x: gs:// is not installed: pip install gcsfs"),
        ("adlfs", "az://b/x", "az://b/x: az:// is not installed: pip install adlfs"),
        ("aiohttp", "https://b/x", "https://b/x: https:// is not installed: pip install 'fsspec[http]'"),
    ],
)
def test_what_is_not_installed_is_said_with_what_to_type(absent: str, url: str, said: str) -> None:
    code = f"""
import sys
sys.modules[{absent!r}] = None
from copem_replay.pipeline.parts import open_store
try:
    open_store({url!r})
except Exception as error:
    print(type(error).__name__, error)
"""
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout == f"InputError --pieces: {said}\n"


def test_fsspec_is_not_loaded_for_what_lies_on_this_machine(tmp_path: Path) -> None:
    code = f"""
import sys
from copem_replay.pipeline.parts import open_store
open_store({str(tmp_path)!r}).write("logs/1.json", b"")
assert "fsspec" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True)
