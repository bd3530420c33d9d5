"""What tests of whole fleets share."""

import pytest
from helpers.fleet_runs import SmallRecording, result_bytes, small_plan, write_small_recording


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> SmallRecording:
    folder = tmp_path_factory.mktemp("small")
    files = write_small_recording(folder / "recording")
    small_plan(files).execute(folder / "run")
    return SmallRecording(files, result_bytes(folder / "run"))
