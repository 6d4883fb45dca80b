"""Settings of all tests."""

import os

import pytest
from hypothesis import settings

from copem_replay.core.extras import has_extra
from tests.helpers.object_storage import bucket, moto

__all__ = ["bucket", "moto"]

EXTRAS = has_extra("command", "fit")
collect_ignore = [] if EXTRAS else ["extras"]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip tests of the core that use an extra, where the folder of extras is not there."""
    for item in items if not EXTRAS else ():
        if item.get_closest_marker("extras"):
            item.add_marker(pytest.mark.skip(reason="copem_replay/extras is not there"))


# No deadlines: machines are noisy, and a first call compiles. In continuous integration the same examples every time,
# so that a failure there can be told from chance. Elsewhere and by `make test-random` new ones: a failure prints what
# gives its example again, `@reproduce_failure(…)`.
settings.register_profile("ci", deadline=None, max_examples=200, derandomize=True)
settings.register_profile("random", deadline=None, max_examples=200, print_blob=True)
settings.load_profile("ci" if os.environ.get("CI") and not os.environ.get("RANDOM_EXAMPLES") else "random")
