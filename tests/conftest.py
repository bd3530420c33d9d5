"""Settings of all tests, and a look at what they leave behind."""

from collections.abc import Iterator

import pytest
from helpers.processes import leftovers
from hypothesis import settings

# Fixed examples, and no limit on the time of one: a busy machine must not fail a test.
settings.register_profile("steady", deadline=None, derandomize=True, database=None)
settings.load_profile("steady")


def pytest_addoption(parser: pytest.Parser) -> None:
    """How much of what takes long is tried."""
    parser.addoption("--recorder-kills", type=int, default=4, help="times that a recorder is killed")
    parser.addoption("--bag-frames", type=int, default=4, help="frames of a real recording that are played as a bag")


@pytest.fixture(scope="session", autouse=True)
def _nothing_is_left() -> Iterator[None]:
    """No process, socket or shared memory of a fleet outlives the tests."""
    before = leftovers()
    yield
    left = [each for each in leftovers() if each not in before]
    assert not left
