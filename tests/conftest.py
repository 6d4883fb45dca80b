"""Settings of all tests: how many examples are drawn, which tests are slow, and which need an extra."""

import os
from pathlib import Path

import pytest
from hypothesis import settings

from copem_replay.core.extras import has_extra
from tests.helpers.drawn import examples
from tests.helpers.object_storage import bucket, moto

__all__ = ["bucket", "moto"]

EXTRAS = has_extra("command", "fit")
collect_ignore = [] if EXTRAS else ["extras"]

SLOW = Path(__file__).with_name("slow.txt")
"""The tests that `make quick` leaves out: seconds and name, a line each, as `tools/slow_tests.py` measures them."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what is slow, and skip tests of the core that use an extra, where the folder of extras is not there."""
    slow = {line.split()[1] for line in SLOW.read_text(encoding="utf-8").splitlines()}
    for item in items:
        if item.nodeid.partition("[")[0] in slow:
            item.add_marker("slow")
        if not EXTRAS and item.get_closest_marker("extras"):
            item.add_marker(pytest.mark.skip(reason="copem_replay/extras is not there"))


# No deadlines: machines are noisy, and a first call compiles. In continuous integration the same examples every time,
# so that a failure there can be told from chance. Elsewhere and by `make test-random` new ones: a failure prints what
# gives its example again, `@reproduce_failure(…)`.
settings.register_profile("ci", deadline=None, max_examples=examples(), derandomize=True)
settings.register_profile("random", deadline=None, max_examples=examples(), print_blob=True)
settings.load_profile("ci" if os.environ.get("CI") and not os.environ.get("RANDOM_EXAMPLES") else "random")
