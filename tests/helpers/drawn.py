"""How many examples a test draws."""

from __future__ import annotations

import os

ALL = bool(os.environ.get("ALL_EXAMPLES"))
"""Whether tests draw as many as they name, or 200 (`make test-long`, every night); else 50 at most."""


def examples(count: int = 200) -> int:
    """So many where all are drawn, else 50 at most."""
    return count if ALL else min(count, 50)
