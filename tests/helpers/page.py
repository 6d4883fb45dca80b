"""The commands of a page of the documentation, as they stand there."""

from __future__ import annotations

import re
from pathlib import Path

_FENCED = re.compile(r"^```.*\n((?:.*\n)*?)^```$", re.MULTILINE)


def blocks(page: Path) -> list[str]:
    """What stands between fences."""
    return _FENCED.findall(page.read_text(encoding="utf-8"))


def spans(page: Path) -> list[str]:
    """What stands in the text as code, and has several words or is called."""
    found = re.findall(r"`([^`]+)`", _FENCED.sub("", page.read_text(encoding="utf-8")))
    return [span for span in found if re.search(r"[ (]", span)]
