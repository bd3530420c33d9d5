"""Pictures that show a run to people: what was seen, what the map shows instead, and where they differ."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.splat.engine import Rendering
from vtslam.storage.atomic import replace_file
from vtslam.storage.errors import WriteFailed

Picture = npt.NDArray[np.uint8]  # [H,W,3], blue first, as OpenCV writes files

ERROR_GAIN = 5.0
_BAR_PX, _GAP_PX = 22, 4
_BACKGROUND, _INK = (255, 255, 255), (40, 40, 40)


def frame_picture(frame: Frame, rendering: Rendering) -> Picture:
    """Two rows of labelled tiles: colour seen, rendered, their difference; depth seen, rendered, their difference."""
    seen, rendered = frame.rgb_float(), rendering.rgb
    depth_m, valid = frame.depth_m(), frame.depth > 0
    near_m, far_m = np.percentile(depth_m[valid], (1, 99)) if valid.any() else (0.0, 1.0)
    depth_error_m = np.abs(rendering.depth_m - depth_m) * valid
    color = [
        (f"frame {frame.frame_id}: input", _bgr(seen)),
        ("rendered from the map", _bgr(rendered)),
        (f"difference x{ERROR_GAIN:g}", _bgr(ERROR_GAIN * np.abs(rendered - seen))),
    ]
    depth = [
        (f"depth input, {near_m:.1f} to {far_m:.1f} m", _tinted(depth_m, near_m, far_m) * valid[..., None]),
        ("depth rendered", _tinted(rendering.depth_m, near_m, far_m)),
        ("difference (white: 5 cm)", _gray(depth_error_m / 0.05)),
    ]
    return stacked([beside([labelled(tile, text) for text, tile in row]) for row in (color, depth)])


def write_picture(path: Path, picture: Picture) -> None:
    """Write a picture as the file type that the name ends in; raises WriteFailed."""
    try:
        written, encoded = cv2.imencode(path.suffix, picture)
    except cv2.error:
        written = False
    if not written:
        raise WriteFailed(f"{path}: expected a name that ends in .png or .jpg")
    replace_file(path, [encoded.tobytes()])


def labelled(tile: npt.NDArray[np.uint8], text: str) -> Picture:
    """``tile`` under a line of text."""
    bar = np.full((_BAR_PX, tile.shape[1], 3), _BACKGROUND, np.uint8)
    write(bar, text, (2, 15))
    return np.concatenate([bar, tile])


def write(picture: Picture, text: str, at: tuple[int, int], *, scale: float = 0.42, thickness: int = 1) -> None:
    """Put text (ASCII) into a picture, its lower left corner at pixel ``at`` (column, row)."""
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, scale, _INK, thickness, cv2.LINE_AA)


def beside(tiles: Sequence[Picture]) -> Picture:
    """Tiles of one height in a row."""
    gap = np.full((tiles[0].shape[0], _GAP_PX, 3), _BACKGROUND, np.uint8)
    parts = [part for tile in tiles for part in (gap, tile)]
    return np.concatenate(parts[1:], axis=1)


def in_columns(pictures: Sequence[Picture], columns: int) -> Picture:
    """Pictures of one size in rows of ``columns``, the last one padded with white."""
    blank = np.full_like(pictures[0], 255)
    padded = [*pictures, *[blank] * (-len(pictures) % columns)]
    return stacked([beside(padded[first : first + columns]) for first in range(0, len(padded), columns)])


def stacked(pictures: Sequence[Picture]) -> Picture:
    """Pictures one below the other, left-aligned on white."""
    width = max(picture.shape[1] for picture in pictures)
    padded = [
        cv2.copyMakeBorder(p, 0, _GAP_PX, 0, width - p.shape[1], cv2.BORDER_CONSTANT, value=_BACKGROUND)
        for p in pictures
    ]
    return np.concatenate([np.asarray(p, np.uint8) for p in padded])


def _bgr(rgb: npt.NDArray[np.floating]) -> Picture:
    """Colour 0..1 (clamped) as a picture."""
    return np.ascontiguousarray(_bytes(rgb)[..., ::-1])


def _gray(values: npt.NDArray[np.floating]) -> Picture:
    return np.repeat(_bytes(values)[..., None], 3, axis=2)


def _tinted(depth_m: npt.NDArray[np.floating], near_m: float, far_m: float) -> Picture:
    share = (depth_m - near_m) / max(far_m - near_m, 1e-6)
    return np.asarray(cv2.applyColorMap(_bytes(share), cv2.COLORMAP_TURBO), np.uint8)


def _bytes(values: npt.NDArray[np.floating]) -> npt.NDArray[np.uint8]:
    return np.asarray(np.clip(values, 0.0, 1.0) * 255.0 + 0.5, np.uint8)
