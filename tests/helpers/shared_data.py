"""Where the read-only recordings lie that some tests need and the project does not contain."""

import os
from pathlib import Path

import pytest

_REPOSITORY = Path(__file__).resolve().parents[2]


def shared_data(name: str) -> Path:
    """The folder ``name`` of the test data (VTSLAM_TEST_DATA, else beside the repository); skips the test without."""
    root = Path(os.environ.get("VTSLAM_TEST_DATA", _REPOSITORY.parent / "shared" / "data"))
    folder = root / name
    if not folder.is_dir():
        pytest.skip(f"needs {folder}, which is not there (set VTSLAM_TEST_DATA)")
    return folder
