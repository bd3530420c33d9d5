"""Depth images at an eighth of their size: between which depths every part of an image lies, never too narrow."""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

BLOCK_PX = 8
# A point's depth is compared with a bilinear mean of pixels beside it, whose place is rounded to 1/32 of a pixel:
# what is seen within a block may be made of pixels this far outside.
_MARGIN_PX = 2


@dataclass(frozen=True, slots=True, eq=False)
class CoarseDepth:
    """Bounds of raw depth by block of 8x8 pixels.

    Attributes:
        nearest, farthest: uint16 [ceil(H/8),ceil(W/8)]: no bilinear sample within the block is outside of these; holes
            and what lies beyond the image count as 0.
    """

    nearest: npt.NDArray[np.uint16]
    farthest: npt.NDArray[np.uint16]

    @classmethod
    def of(cls, depth: npt.NDArray[np.uint16]) -> "CoarseDepth":
        """The bounds of a depth image uint16 [H,W]."""
        kernel = np.ones((2 * _MARGIN_PX + 1,) * 2, np.uint8)
        rows, columns = (-(-size // BLOCK_PX) * BLOCK_PX for size in depth.shape)
        frame = np.zeros((rows + 2 * _MARGIN_PX, columns + 2 * _MARGIN_PX), np.uint16)
        frame[_MARGIN_PX : _MARGIN_PX + depth.shape[0], _MARGIN_PX : _MARGIN_PX + depth.shape[1]] = depth
        inner = np.s_[_MARGIN_PX : _MARGIN_PX + rows, _MARGIN_PX : _MARGIN_PX + columns]
        blocks = (rows // BLOCK_PX, BLOCK_PX, columns // BLOCK_PX, BLOCK_PX)
        return cls(
            np.asarray(cv2.erode(frame, kernel)[inner], np.uint16).reshape(blocks).min(axis=(1, 3)),
            np.asarray(cv2.dilate(frame, kernel)[inner], np.uint16).reshape(blocks).max(axis=(1, 3)),
        )

    def packed(self) -> bytes:
        """As the catalogue keeps it."""
        return np.stack([self.nearest, self.farthest]).astype("<u2").tobytes()

    @classmethod
    def unpacked(cls, data: bytes, *, width: int, height: int) -> "CoarseDepth":
        """The bounds of :meth:`packed`'s bytes, for an image of ``width`` x ``height``.

        Raises:
            ValueError: There are too few or too many bytes.
        """
        shape = (2, -(-height // BLOCK_PX), -(-width // BLOCK_PX))
        nearest, farthest = np.frombuffer(data, "<u2").reshape(shape)
        return cls(nearest, farthest)
