"""Which finished sections are in memory: facts in, decisions out."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vtslam.common.shm.residency import (
    Admission,
    ResidentFacts,
    ViewPlaces,
    make_room,
    predicted_position_m,
    wanted_soon,
)

_MARGIN = 1.25  # how much larger than any before it the next section may be without its mapper waiting
_LEAST_RADIUS_M = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class StoreFacts:
    """The map store at one time.

    Attributes:
        used_bytes, free_bytes: What all blocks take, and what they may take beside that.
        sealed_bytes: What each finished section in memory takes of it.
    """

    used_bytes: int
    free_bytes: int
    sealed_bytes: tuple[int, ...]

    @property
    def mapping_bytes(self) -> int:
        """What is taken by all but finished sections."""
        return self.used_bytes - sum(self.sealed_bytes)


Residents = Callable[[], Sequence[ResidentFacts]]  # finished sections in memory, in order; a look at all takes a while


class Residency:
    """Keeps as much free in the map store as mapping and sealing a section took so far, and a margin.

    The section sealed last always stays: the last commit is told by it, and the next section is mapped beside it.
    """

    def __init__(self) -> None:
        self._most_mapping = self._most_sealed = 0  # bytes: all but finished sections; one finished section

    def observe(self, facts: StoreFacts) -> None:
        """Learn what mapping takes."""
        self._most_mapping = max(self._most_mapping, facts.mapping_bytes)
        self._most_sealed = max(self._most_sealed, *facts.sealed_bytes, 0)

    def leaving(
        self, facts: StoreFacts, residents: Residents, *, squeeze: bool, spared: Iterable[int] = ()
    ) -> tuple[int, ...]:
        """The sections that are to leave, in this order.

        Args:
            facts: The store.
            residents: Asked for only if some may have to leave.
            squeeze: The mapper waits for memory: all go that may.
            spared: Sections that leave last.
        """
        wanted = self._kept_free(facts)
        if not squeeze and wanted <= facts.free_bytes:
            return ()
        may_leave = [each for each in residents()[:-1] if each.is_verified and not each.is_pinned]
        attainable = facts.free_bytes + sum(each.num_bytes for each in may_leave)
        wanted = attainable if squeeze else min(wanted, attainable)
        return make_room(
            may_leave,
            wanted_bytes=wanted,
            used_bytes=facts.used_bytes,
            budget_bytes=facts.used_bytes + facts.free_bytes,
            wanted_soon=spared,
        ).leaving

    def room_for(
        self, facts: StoreFacts, residents: Residents, num_bytes: int, *, spared: Iterable[int] = ()
    ) -> tuple[int, ...] | None:
        """What leaves so that a section of ``num_bytes`` can come back beside what mapping needs; None if it cannot."""
        wanted = self._kept_free(facts) + num_bytes
        if wanted <= facts.free_bytes:
            return ()
        plan = make_room(
            residents()[:-1],
            wanted_bytes=wanted,
            used_bytes=facts.used_bytes,
            budget_bytes=facts.used_bytes + facts.free_bytes,
            wanted_soon=spared,
        )
        return plan.leaving if plan.admission is Admission.OPEN else None

    def _kept_free(self, facts: StoreFacts) -> int:
        return max(int(_MARGIN * (self._most_mapping + self._most_sealed)) - facts.mapping_bytes, 0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraAt:
    """Where the camera was.

    Attributes:
        frame_id: At which frame.
        frame_index: Its row in its section.
        T_world_camera: float64 [4,4].
    """

    frame_id: int
    frame_index: int
    T_world_camera: npt.NDArray[np.float64]


def sections_ahead(
    places: ViewPlaces, older: CameraAt, newer: CameraAt, *, section_length: int, at_most: int
) -> list[int]:
    """Sections that the next head may overlap, by constant velocity: those with views near to where it will be.

    Near is less than what the camera covers in a section: a place comes near once a section at most.

    Args:
        places: The candidate views.
        older: Where the camera was.
        newer: Where it was some frames later.
        section_length: Frames of a section.
        at_most: How many sections to name.
    """
    position, before = newer.T_world_camera[:3, 3], older.T_world_camera[:3, 3]
    frames = max(newer.frame_id - older.frame_id, 1)
    ahead = max(section_length - newer.frame_index, 1)
    speed_m = float(np.linalg.norm(position - before)) / frames
    return wanted_soon(
        places,
        predicted_position_m(before, position, frames_ahead=ahead / frames),
        newer.T_world_camera[:3, 2],
        radius_m=max(speed_m * section_length, _LEAST_RADIUS_M),
        at_most=at_most,
    )
