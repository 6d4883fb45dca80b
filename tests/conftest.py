"""Settings of all tests."""

import os

from hypothesis import settings

from tests.helpers.object_storage import bucket, moto

__all__ = ["bucket", "moto"]

# No deadlines: machines are noisy, and a first call compiles. In continuous integration the same examples every time,
# so that a failure there can be told from chance. Elsewhere and by `make test-random` new ones: a failure prints what
# gives its example again, `@reproduce_failure(…)`.
settings.register_profile("ci", deadline=None, max_examples=200, derandomize=True)
settings.register_profile("random", deadline=None, max_examples=200, print_blob=True)
settings.load_profile("ci" if os.environ.get("CI") and not os.environ.get("RANDOM_EXAMPLES") else "random")
