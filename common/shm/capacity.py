"""What a section costs the map store while it is mapped, and so how many Gaussians it may have."""

from dataclasses import dataclass
from functools import lru_cache

from vtslam.common.geometry.camera import Camera
from vtslam.common.shm.active_layout import MOMENT_COLUMNS, RECORD_BYTES
from vtslam.common.shm.blocks import CONTROL_BYTES, aligned
from vtslam.common.shm.growing_file import CHUNK_ROWS, ColumnLayout, ColumnTypes
from vtslam.common.shm.sealed_block import sealed_bytes_of
from vtslam.common.shm.section_columns import LEARNED_COLUMNS, ROW, TIE_COLUMNS, ImageLayout

_WRITTEN, _PINNED = 1, 1  # buffers of learned columns besides those kept: the next one, and one that a reader still has


@dataclass(frozen=True, slots=True, kw_only=True)
class MappingCost:
    """The most bytes that an active section takes until it is sealed, beside a finished one before it that is as large.

    Attributes:
        fixed_bytes: Of images, tables and records.
        bytes_each: Of a Gaussian.
    """

    fixed_bytes: int
    bytes_each: int

    @classmethod
    @lru_cache(maxsize=8)  # asked several times for each frame
    def of(cls, camera: Camera, *, frames: int, views: int, with_moments: bool, kept_generations: int) -> "MappingCost":
        """Of sections of at most ``frames`` frames.

        Args:
            camera: Of the frames.
            frames: Of a section, at most.
            views: Of those, the ones that keep their depth in a finished section.
            with_moments: Whether the optimiser's moments are kept, in two files that take turns.
            kept_generations: Of the active section.
        """
        ties, learned, moments = (_row_bytes(each) for each in (TIE_COLUMNS, LEARNED_COLUMNS, MOMENT_COLUMNS))
        moments = moments if with_moments else 0
        buffers = kept_generations + _WRITTEN + _PINNED
        growing = ties + buffers * learned + 2 * moments
        # Sealing writes all once more, but needs no buffer to write to, and the moments once.
        sealing = ties + (buffers - _WRITTEN) * learned + moments + (ties + learned)
        image_bytes = ImageLayout(camera).frame_bytes
        fixed = CONTROL_BYTES + aligned(frames * ROW.itemsize) + frames * image_bytes + buffers * RECORD_BYTES
        fixed += CHUNK_ROWS * growing  # columns grow by whole chunks
        fixed += 2 * sealed_bytes_of(camera, frames=frames, views=views, gaussians=0)
        fixed += 2 * (CONTROL_BYTES + RECORD_BYTES + image_bytes)  # last commits: of the section before, and a new one
        return cls(fixed_bytes=fixed, bytes_each=max(growing, sealing) + ties + learned)

    def gaussians_within(self, budget_bytes: int) -> int:
        """The most that fit; 0 if nothing does."""
        return max((budget_bytes - self.fixed_bytes) // self.bytes_each, 0)

    def bytes_with(self, gaussians: int) -> int:
        """What so many take."""
        return self.fixed_bytes + gaussians * self.bytes_each


def _row_bytes(columns: ColumnTypes) -> int:
    return ColumnLayout(columns, 0, head_bytes=0).row_bytes
