"""Write into pages what their commands print: `python tools/page_outputs.py [PAGE …]`; none named: all with outputs.

A block after `<!-- output: COMMAND -->` is replaced by what the command prints, in the order of the page; with
`COMMAND | head N` by its first N lines. Blocks after `<!-- file: out/NAME -->` are written to that file first, then
commands in `<!-- before: COMMAND -->` are run. Files go into a scratch folder in place of `out/`. The tests of the
pages fail where a block differs; this writes it anew, and the difference is for a reader: `git diff`.
"""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

from processor import plain_environment

ROOT = Path(__file__).resolve().parents[1]
_BLOCK = re.compile(r"(<!-- output: (.*?) -->\n```text\n)(.*?)(```)", re.DOTALL)
_BEFORE = re.compile(r"<!-- before: (.*?) -->")
_FILE = re.compile(r"<!-- file: out/(.*?) -->\n```\w+\n(.*?)```", re.DOTALL)


def printed(command: str, scratch: Path) -> str:
    """What a command of a page prints to standard output, run from the project's folder."""
    command, _, most = command.partition(" | head ")
    words = [str(scratch / word) if word.startswith("out/") else word for word in shlex.split(command)]
    start = "import sys; from copem_replay.cli.main import main; sys.argv[0] = 'copem-replay'; sys.exit(main())"
    program = [sys.executable] if words[0] == "python" else [sys.executable, "-c", start]
    environment = plain_environment() | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([*program, *words[1:]], cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True)
    if done.returncode:
        raise SystemExit(f"`{command}` ended with {done.returncode}")
    lines = done.stdout.replace(f"{scratch}/", "").splitlines(keepends=True)
    return "".join([*lines[: int(most)], "…\n"] if most and int(most) < len(lines) else lines)


def renew_outputs(text: str) -> str:
    """The text of a page with what its commands print now."""
    with tempfile.TemporaryDirectory() as scratch:
        for name, content in _FILE.findall(text):
            (Path(scratch) / "out" / name).parent.mkdir(parents=True, exist_ok=True)
            (Path(scratch) / "out" / name).write_text(content, encoding="utf-8")
        for command in _BEFORE.findall(text):
            printed(command, Path(scratch))
        return _BLOCK.sub(lambda block: f"{block[1]}{printed(block[2], Path(scratch))}{block[4]}", text)


def write_outputs(page: Path) -> bool:
    """Replace the outputs of a page. Returns whether it has changed."""
    text = page.read_text(encoding="utf-8")
    new = renew_outputs(text)
    if new != text:
        page.write_text(new, encoding="utf-8")
    return new != text


def main() -> None:
    """The pages named, or all that have outputs."""
    pages = [Path(name).resolve() for name in sys.argv[1:]] or [ROOT / "README.md", *sorted(ROOT.glob("docs/**/*.md"))]
    for page in pages:
        if "<!-- output: " in page.read_text(encoding="utf-8"):
            print(f"{page.relative_to(ROOT)}: {'changed' if write_outputs(page) else 'as it was'}", flush=True)


if __name__ == "__main__":
    main()
