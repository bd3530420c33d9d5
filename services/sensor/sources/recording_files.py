"""What readers of recordings share: listing numbered files, poses as text, and intrinsics from options."""

import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from vtslam.common.geometry import se3
from vtslam.common.geometry.camera import Camera
from vtslam.services.sensor.sources.base import SourceError, SourceUri
from vtslam.services.sensor.sources.image_files import FramePaths

INTRINSICS_OPTIONS = ("fx", "fy", "cx", "cy")


def folder_of(uri: SourceUri) -> Path:
    """The absolute path of the folder a URI names.

    Raises:
        SourceError: It is missing, or not a folder.
    """
    folder = Path(os.path.abspath(os.path.expanduser(uri.path)))
    if not uri.path or not folder.is_dir():
        found = "a file" if folder.is_file() and uri.path else "none"
        raise SourceError(f"{folder if uri.path else uri}: expected a folder of a recording, found {found}")
    return folder


def check_options(uri: SourceUri, known: Iterable[str]) -> None:
    """Refuse options that the reader does not know.

    Raises:
        SourceError: There is one.
    """
    known = sorted([*known, "range", "size"])  # the last two are taken by the registry
    for key in uri.options:
        if key not in known:
            raise SourceError(f"{uri.scheme}: expected options among {', '.join(known)}; found {key!r}")


def positive_option(uri: SourceUri, key: str, default: float) -> float:
    """Option ``key`` as a finite positive number, or ``default`` where it is not given.

    Raises:
        SourceError: It is not such a number.
    """
    text = uri.options.get(key)
    if text is None:
        return default
    value = _number(text)
    if value is None or not 0.0 < value < float("inf"):
        raise SourceError(f"{uri.scheme}: option {key}: expected a positive number, found {text!r}")
    return value


def integer_centred_camera(uri: SourceUri, *, width: int, height: int, intrinsics: Mapping[str, float]) -> Camera:
    """The camera of ``fx fy cx cy`` given with pixel centres at whole numbers, each replaceable by an option."""
    values = {key: positive_option(uri, key, intrinsics[key]) for key in INTRINSICS_OPTIONS}
    return Camera.from_integer_centred(width=width, height=height, **values)


def numbered_files(folder: Path, pattern: str) -> dict[int, Path]:
    """The files of ``folder`` whose whole name matches ``pattern``, by the number in its first group.

    Raises:
        SourceError: Two have one number.
    """
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        match = re.fullmatch(pattern, path.name)
        if match is None:
            continue
        number = int(match.group(1))
        if number in found:
            raise SourceError(f"{path}: expected one file per frame, found {found[number].name} for the same frame")
        found[number] = path
    return found


def numbered_pairs(folder: Path, *, color: str, depth: str) -> list[FramePaths]:
    """The image files of frames 0, 1, 2, ... of ``folder``.

    Args:
        folder: Where they lie.
        color: The colour images' name with ``*`` for the digits and for the extension, as in ``frame*.*``.
        depth: The depth images' name with ``*`` for the digits, as in ``depth*.png``.

    Raises:
        SourceError: There are none, a colour image has no depth image or the reverse, or a number is missing.
    """
    names = {"colour": color, "depth": depth}
    found = {kind: numbered_files(folder, _name_pattern(name)) for kind, name in names.items()}
    numbers = sorted(found["colour"].keys() | found["depth"].keys())
    if not numbers:
        raise SourceError(f"{folder}: expected colour images {color} and depth images {depth}, found none")
    for expected, number in enumerate(numbers):
        if number != expected:
            raise SourceError(
                f"{folder}: expected frames numbered from 0 without gaps, found {len(numbers)} up to number "
                f"{numbers[-1]} and none of number {expected}"
            )
        for kind, other in (("colour", "depth"), ("depth", "colour")):
            if number not in found[kind]:
                missing = folder / names[kind].replace("*", f"{number:06d}", 1)
                raise SourceError(f"{missing}: expected a {kind} image beside {found[other][number].name}, found none")
    return [FramePaths(color=found["colour"][number], depth=found["depth"][number]) for number in numbers]


def _name_pattern(name: str) -> str:
    return re.escape(name).replace(r"\*", r"(\d+)", 1).replace(r"\*", "(?:png|jpg|jpeg)")


def read_lines(path: Path) -> list[str]:
    """The lines of a text file without blank lines at its end.

    Raises:
        SourceError: It cannot be read.
    """
    try:
        return path.read_text(encoding="utf-8", errors="replace").rstrip().splitlines()
    except OSError as error:
        raise SourceError(f"{path}: expected a readable text file, found {error.strerror}") from error


def parse_numbers(text: str, count: int, *, where: str) -> list[float]:
    """``count`` numbers separated by blanks; NaN and infinity pass.

    Raises:
        SourceError: Another count, or a word that is no number; the text begins with ``where``.
    """
    words = text.split()
    if len(words) != count:
        raise SourceError(f"{where}: expected {count} numbers, found {len(words)}")
    values = [_number(word) for word in words]
    for word, value in zip(words, values, strict=True):
        if value is None:
            raise SourceError(f"{where}: expected a number, found {word!r}")
    return [value for value in values if value is not None]


def checked_pose(values: list[float], *, where: str) -> npt.NDArray[np.float64]:
    """The rigid motion [4,4] of 16 row-major numbers, its rotation made exactly orthonormal.

    Raises:
        SourceError: A number is not finite, or the matrix is not rigid within 1e-3.
    """
    matrix = np.array(values, np.float64).reshape(4, 4)
    if not np.isfinite(matrix).all():
        raise SourceError(f"{where}: expected a finite pose, found {values}")
    if not se3.is_rigid(matrix):
        raise SourceError(f"{where}: expected a rigid motion T_world_camera, found {values}")
    return se3.orthonormalized(matrix)


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
