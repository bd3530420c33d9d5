"""The examples in the package's own description."""

import doctest
import tempfile
from pathlib import Path

import pytest

import vtslam


def test_the_documented_examples_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))

    results = doctest.testmod(vtslam)

    assert results.failed == 0
    assert results.attempted > 10


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'rum'"):
        vtslam.rum  # noqa: B018
