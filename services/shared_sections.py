"""The mapper's active section as the map store keeps it, and back: going on from it gives the same bytes."""

from vtslam.common.frame import Frame
from vtslam.common.optim.adam import Adam
from vtslam.common.settings import MapperSettings
from vtslam.common.shm.records import ActiveState, AttributeMoments, Commit, NewFrame, SectionMoments
from vtslam.services.mapper.state import ActiveSection, Moments, TrainingView


def commit_of(active: ActiveSection, frame: Frame, *, held_out: bool, keep_moments: bool, facts: bytes) -> Commit:
    """What to commit after ``frame`` was mapped.

    Args:
        active: The section afterwards.
        frame: The last row of its frame table.
        held_out: Whether mapping left the frame out.
        keep_moments: As the mapper's setting; without, a restarted mapper needs none.
        facts: What else has to survive.
    """
    moments = None
    if keep_moments and active.moments is not None:
        m = active.moments
        moments = SectionMoments(
            colors=_stored(m.colors), log_radii=_stored(m.log_radii), opacity_logits=_stored(m.opacity_logits)
        )
    return Commit(
        section=active.section,
        new_frames=(NewFrame(frame=frame, trained=not held_out),),
        neighbour_ids=active.neighbour_ids,
        moments=moments,
        facts=facts,
    )


def active_section_of(state: ActiveState, settings: MapperSettings) -> ActiveSection:
    """The active section of a commit, with positions and surface computed anew."""
    section = state.section.retied()
    moments = None
    if state.moments is not None:
        s, m = settings, state.moments
        moments = Moments(
            colors=_adam(m.colors, s.learning_rate_color, s.adam_epsilon),
            log_radii=_adam(m.log_radii, s.learning_rate_log_radius, s.adam_epsilon),
            opacity_logits=_adam(m.opacity_logits, s.learning_rate_opacity, s.adam_epsilon),
        )
    views = tuple(
        TrainingView(frame_index=row, frame=state.frames[row], exposure=section.frames[row].exposure)
        for row in state.trained_rows
    )
    return ActiveSection(section=section, views=views, neighbour_ids=state.neighbour_ids, moments=moments)


def _stored(adam: Adam) -> AttributeMoments:
    return AttributeMoments(m=adam.m, v=adam.v, step_count=adam.step_count)


def _adam(moments: AttributeMoments, rate: float, epsilon: float) -> Adam:
    adam = Adam(moments.m.shape, lr=rate, eps=epsilon)
    adam.m, adam.v, adam.step_count = moments.m, moments.v, moments.step_count
    return adam
