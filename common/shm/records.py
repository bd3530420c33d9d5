"""What the map store takes and gives: sections, what is needed to go on mapping one, and the last commit."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.geometry.camera import Camera
from vtslam.common.section import Section
from vtslam.common.shm.blocks import MAX_KEPT

MAX_FACTS_BYTES = 60 * 1024
MAX_NEIGHBOURS = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class ActiveSpec:
    """What an active section can grow to; only what is used takes memory.

    Attributes:
        section_id: The section.
        camera: Of all its frames.
        depth_scale_m: Metres per unit of depth, of all its frames.
        depth_factor: Factor on depth when Gaussians are placed.
        max_frames: Frames at most, 1 to 65536.
        max_gaussians: Gaussians at most: pixels of a frame times frames, times 5 with the edge supplement.
        with_moments: Whether optimiser state is kept.
        pins: Readers that may look at it at a time, at most 24.
        kept_generations: How many of the newest generations can be pinned by number, 1 to 4.

    Raises:
        ValueError: A number is out of range.
    """

    section_id: int
    camera: Camera
    depth_scale_m: float
    depth_factor: float
    max_frames: int
    max_gaussians: int
    with_moments: bool
    pins: int = 8
    kept_generations: int = 1

    def __post_init__(self) -> None:
        if not 1 <= self.kept_generations <= MAX_KEPT:
            raise ValueError(f"expected 1 to {MAX_KEPT} kept generations, got {self.kept_generations}")
        if not (self.section_id >= 0 and 1 <= self.max_frames <= 65536 and 1 <= self.max_gaussians < 2**40):
            raise ValueError(
                "an active section needs an id of 0 or more, room for 1 to 65536 frames and for 1 to 2^40 Gaussians; "
                f"got {self.section_id}, {self.max_frames}, {self.max_gaussians}"
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AttributeMoments:
    """Adam's state of one attribute: moments float32 of the attribute's shape, and the steps taken."""

    m: npt.NDArray[np.float32]
    v: npt.NDArray[np.float32]
    step_count: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SectionMoments:
    """Adam's state of a section's learned attributes."""

    colors: AttributeMoments
    log_radii: AttributeMoments
    opacity_logits: AttributeMoments

    def in_order(self) -> tuple[AttributeMoments, AttributeMoments, AttributeMoments]:
        """The three of them, in the order of the columns."""
        return self.colors, self.log_radii, self.opacity_logits


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NewFrame:
    """A frame that a commit adds to the section, and whether mapping trains on it (held-out frames: no)."""

    frame: Frame
    trained: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Commit:
    """What a writer commits: the section as it is now, with all rows.

    Attributes:
        section: Frame table, Gaussians and anchor; former rows and ties are unchanged.
        new_frames: One for each row of the frame table beyond those of the last commit.
        neighbour_ids: Sections of Eq. 2, at most 8.
        moments: Optimiser state, if it is kept.
        facts: At most 60 KiB of the caller's: what tracker and mapper carry from frame to frame.
    """

    section: Section
    new_frames: tuple[NewFrame, ...]
    neighbour_ids: tuple[int, ...]
    moments: SectionMoments | None
    facts: bytes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ActiveState:
    """The active section as of one commit; all that is needed to go on mapping, bit for bit.

    Attributes:
        generation: Number of the commit, from 1.
        section: Without positions and surface: `Section.retied` computes them.
        frames: Every row's frame with its images.
        trained_rows: Rows that mapping trains on.
        neighbour_ids, moments, facts: As committed.
    """

    generation: int
    section: Section
    frames: Sequence[Frame]
    trained_rows: tuple[int, ...]
    neighbour_ids: tuple[int, ...]
    moments: SectionMoments | None
    facts: bytes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LastCommit:
    """The last commit of the fleet.

    Attributes:
        section_id: Its section, active or just sealed.
        frame_index: Row of the last frame in the section's frame table.
        frame: The last frame, a copy.
        facts: The caller's bytes.
        is_sealed: Whether the section is finished.
    """

    section_id: int
    frame_index: int
    frame: Frame
    facts: bytes
    is_sealed: bool
