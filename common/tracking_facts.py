"""What tracking says of a pose besides the pose itself."""

from dataclasses import dataclass
from enum import StrEnum


class TrackingState(StrEnum):
    """How far a pose can be trusted."""

    OK = "ok"
    WEAK = "weak"  # few usable pixels
    LOST = "lost"  # no usable pixels, or the map does not agree with the frame


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingQuality:
    """Facts about one estimated pose.

    Attributes:
        color_loss: Mean over the mask of sum_c |I - I'| at the last render.
        depth_loss_m: Mean over the mask of |D - D'| at the last render.
        covered_share: Pixels in the mask over all pixels.
        renders: Renders spent.
        section_id: The section it was tracked against; -1 if none.
        rescued: Whether RGB-D odometry replaced the guess.
    """

    color_loss: float
    depth_loss_m: float
    covered_share: float
    renders: int
    section_id: int
    rescued: bool
