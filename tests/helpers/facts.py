"""What is known of a frame, as tests make it up."""

from dataclasses import replace

from vtslam.services.frame_facts import FrameFacts

_FACTS = FrameFacts(
    frame_id=0,
    section_id=0,
    is_head=False,
    held_out=False,
    state="ok",
    tracked_section_id=0,
    rescued=False,
    covered_share=0.5,
    color_loss=0.1,
    depth_loss_m=0.02,
    position_sigma_m=0.001,
    rotation_sigma_rad=0.002,
    exposure_gain=(1.0, 1.0, 1.0),
    exposure_offset=(0.0, 0.0, 0.0),
    map_loss=0.3,
    gaussians_added=4,
    gaussians=40,
    track_renders=5,
    map_renders=6,
    read_s=0.0,
    track_s=0.0,
    map_s=0.0,
    total_s=0.0,
)


def frame_facts(frame_id: int, **others: object) -> FrameFacts:
    """Facts of a frame that was tracked, all plausible; ``others`` replace them by name."""
    return replace(_FACTS, **{"frame_id": frame_id, **others})  # type: ignore[arg-type]
