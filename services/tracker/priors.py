"""Poses that come with frames, as far as they count; those that do not are told of."""

from vtslam.common.external_pose import ExternalPose
from vtslam.common.frame import Frame
from vtslam.services.service_link import ServiceLink
from vtslam.services.tracker.state import TrackerState

_IGNORED = "priors.ignored"


def told_prior(frame: Frame, state: TrackerState, link: ServiceLink) -> ExternalPose | None:
    """`TrackerState.prior_of` a frame; each that does not count is counted, and the first an event."""
    prior = state.prior_of(frame)
    if prior is None and frame.pose_prior is not None:
        link.count(_IGNORED)
        if link.counters[_IGNORED] == 1:
            link.event("priors", ignored_text(frame))
    return prior


def ignored_text(frame: Frame) -> str:
    """What there is to say of the first frame whose prior does not count."""
    return (
        f"frame {frame.frame_id} comes with a pose, the first frame came without: its world is not the one of such "
        "poses, so they are ignored"
    )
