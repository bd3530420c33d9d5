"""Settings of all tests, and a look at what they leave behind."""

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.processes import keep_bytecode, leftovers, remove_own_shared_memory, take_own_shared_memory

from vtslam.common.fleet_folder import shared_memory_folder

_MOST_WORKERS = 8
_HEAVIEST = ("system", "property", "parity", "unit", "golden")  # folders, in the order of their tests' weight


def pytest_addoption(parser: pytest.Parser) -> None:
    """How much of what takes long is tried."""
    parser.addoption("--recorder-kills", type=int, default=4, help="times that a recorder is killed")
    parser.addoption("--bag-frames", type=int, default=4, help="frames of a real recording that are played as a bag")


def pytest_configure(config: pytest.Config) -> None:
    """Each process of the tests has its own part of shared memory, and compiles no module a second time."""
    take_own_shared_memory()
    if hasattr(config, "cache"):
        keep_bytecode(config.cache.mkdir("bytecode"))
    from hypothesis import settings

    # Fixed examples, and no limit on the time of one: a busy machine must not fail a test.
    settings.register_profile("steady", deadline=None, derandomize=True, database=None)
    settings.load_profile("steady")


def pytest_unconfigure() -> None:
    """Give the shared memory back."""
    remove_own_shared_memory()


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """As many processes as cores; none beside this one for the tests of one file."""
    is_one_file = len(config.args) == 1 and ".py" in config.args[0]
    return 0 if is_one_file else min(len(os.sched_getaffinity(0)), _MOST_WORKERS)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The heaviest first: at the end, small files fill up what is left of the processes' time."""
    items.sort(key=lambda item: _HEAVIEST.index(item.path.parent.name))


@pytest.fixture(scope="session", autouse=True)
def _nothing_is_left() -> Iterator[None]:
    """No process, socket or shared memory of a fleet outlives the tests."""
    yield
    assert leftovers() == []


@pytest.fixture
def folder_in_memory() -> Iterator[Path]:
    """A folder for tests that write so much that a disk's own time would count."""
    with tempfile.TemporaryDirectory(dir=shared_memory_folder()) as name:
        yield Path(name)
