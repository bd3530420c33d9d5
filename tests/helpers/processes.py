"""What tests that start processes share."""

import os
from pathlib import Path

_SOURCE = Path(__file__).resolve().parents[2] / "src"


def source_environment() -> dict[str, str]:
    """The environment, with this checkout's package first on the path."""
    paths = [str(_SOURCE), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
