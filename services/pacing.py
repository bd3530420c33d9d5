"""Who waits for whom in a fleet: the pace at which frames go through sensor, tracker and mapper."""

from dataclasses import dataclass
from enum import StrEnum

from vtslam.common.settings import FleetSettings


class Pacing(StrEnum):
    """Who waits for whom."""

    LOCKSTEP = "lockstep"  # every frame, tracked when all before it are committed
    PIPELINED = "pipelined"  # every frame, tracked while the one before it is mapped
    REALTIME = "realtime"  # nobody waits: the newest frame is tracked, the newest pose mapped


@dataclass(frozen=True, slots=True, kw_only=True)
class Pace:
    """The pace of one fleet.

    Attributes:
        pacing: Who waits for whom.
        lead: Frames that tracking is ahead of mapping; 0 unless pipelined.
        replay_hz: Frames per second of a recording that is replayed in realtime; 0 as they were captured.
    """

    pacing: Pacing = Pacing.LOCKSTEP
    lead: int = 0
    replay_hz: float = 0.0

    @property
    def credit(self) -> int:
        """Frames in the ring that are not committed: those at work, and the next one ready."""
        return 2 + self.lead

    @property
    def is_realtime(self) -> bool:
        """Whether frames are dropped rather than waited for."""
        return self.pacing is Pacing.REALTIME


def pace_of(settings: FleetSettings, *, live: bool) -> Pace:
    """The pace that is set; unless one is, lockstep for recordings and realtime for live sources."""
    pacing = Pacing(settings.pacing or (Pacing.REALTIME if live else Pacing.LOCKSTEP))
    return Pace(pacing=pacing, lead=settings.lead if pacing is Pacing.PIPELINED else 0, replay_hz=settings.replay_hz)
