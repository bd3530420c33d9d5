"""Facts per frame as JSON lines: one object a line, in the order of the frames."""

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from vtslam.storage.atomic import replace_file
from vtslam.storage.errors import RunFolderError


def write_rows(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Replace ``path`` by ``rows``; numpy scalars become numbers, and numbers that are not finite become null.

    Raises:
        RunFolderError: A value has no JSON form.
        WriteFailed: The operating system refused.
    """
    lines = []
    for number, row in enumerate(rows, start=1):
        try:
            lines.append(json.dumps(_plain(row), allow_nan=False, ensure_ascii=False))
        except TypeError as error:
            raise RunFolderError(f"{path}: row {number} cannot be written: {error}") from error
    replace_file(path, ["".join(f"{line}\n" for line in lines).encode()])


def read_rows(path: Path) -> list[dict[str, Any]]:
    """The rows of :func:`write_rows`.

    Raises:
        RunFolderError: The file is missing, or a line is not a JSON object.
    """
    try:
        lines = path.read_bytes().splitlines()
    except OSError as error:
        raise RunFolderError(f"{path}: cannot read: {error.strerror}") from error
    rows = []
    for number, line in enumerate(lines, start=1):
        try:
            row = json.loads(line, parse_constant=_refuse_constant)
        except (ValueError, RecursionError) as error:
            raise RunFolderError(f"{path}:{number}: expected a JSON object, found {line[:40]!r} ({error})") from error
        if not isinstance(row, dict):
            raise RunFolderError(f"{path}:{number}: expected a JSON object, found {line[:40]!r}")
        rows.append(row)
    return rows


def _plain(value: Any) -> Any:  # noqa: ANN401
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value


def _refuse_constant(text: str) -> NoReturn:
    raise ValueError(f"{text} is not JSON")
