"""Settings of all tests."""

import os

from hypothesis import settings

from tests.helpers.object_storage import bucket, moto

__all__ = ["bucket", "moto"]

# No deadlines: machines are noisy, and a first call compiles. In continuous integration the same examples every time,
# so that a failure there can be told from chance; elsewhere new ones.
settings.register_profile("here", deadline=None)
settings.register_profile("ci", deadline=None, derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "here")
