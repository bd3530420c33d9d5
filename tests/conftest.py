"""Settings of all tests."""

from hypothesis import settings

# Fixed examples, and no limit on the time of one: a busy machine must not fail a test.
settings.register_profile("steady", deadline=None, derandomize=True, database=None)
settings.load_profile("steady")
