"""Which sealed sections stay in memory: a pure policy over plain facts (docs/protocol-shm.md, section 7)."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum

import numpy as np
import numpy.typing as npt

_ALIKE = 0.5  # least cosine between viewing directions that may see the same


@dataclass(frozen=True, slots=True, kw_only=True)
class ResidentFacts:
    """A sealed section in memory.

    Attributes:
        section_id: The section.
        num_bytes: What it takes.
        last_used: When it was used last, in any unit that grows.
        is_pinned: Whether a living process looks at it.
        is_verified: Whether its file on disk was read back and found right.
    """

    section_id: int
    num_bytes: int
    last_used: int
    is_pinned: bool
    is_verified: bool


class Admission(Enum):
    """Whether memory can be given."""

    OPEN = "open"  # it fits, perhaps after some sections have left
    STOPPED = "stopped"  # it does not fit until a section is verified or released
    IMPOSSIBLE = "impossible"  # it would not fit into an empty store


@dataclass(frozen=True, slots=True, kw_only=True)
class Eviction:
    """The answer of :func:`make_room`.

    Attributes:
        admission: Whether it fits once ``leaving`` have left.
        leaving: Sections to let go, in this order; none unless that makes it fit.
        missing_bytes: What is lacking if it does not fit even so.
    """

    admission: Admission
    leaving: tuple[int, ...]
    missing_bytes: int


def make_room(
    residents: Iterable[ResidentFacts],
    *,
    wanted_bytes: int,
    used_bytes: int,
    budget_bytes: int,
    wanted_soon: Iterable[int] = (),
) -> Eviction:
    """Which sections leave so that ``wanted_bytes`` fit.

    Only those that are verified and not pinned; first those not ``wanted_soon``, each group by least recent use, then
    by id.

    Args:
        residents: The sealed sections in memory.
        wanted_bytes: What is asked for.
        used_bytes: What all blocks take, the active section's included.
        budget_bytes: What they may take.
        wanted_soon: Sections that the predicted pose is near to.
    """
    soon = frozenset(wanted_soon)
    missing = used_bytes + wanted_bytes - budget_bytes
    may_leave = [r for r in residents if r.is_verified and not r.is_pinned]
    leaving: list[int] = []
    for resident in sorted(may_leave, key=lambda r: (r.section_id in soon, r.last_used, r.section_id)):
        if missing <= 0:
            break
        leaving.append(resident.section_id)
        missing -= resident.num_bytes
    if missing <= 0:
        return Eviction(admission=Admission.OPEN, leaving=tuple(leaving), missing_bytes=0)
    impossible = wanted_bytes > budget_bytes
    admission = Admission.IMPOSSIBLE if impossible else Admission.STOPPED
    return Eviction(admission=admission, leaving=(), missing_bytes=missing)


def predicted_position_m(
    older_m: npt.NDArray[np.float64], newer_m: npt.NDArray[np.float64], *, frames_ahead: float
) -> npt.NDArray[np.float64]:
    """Where a camera at positions float64 [3] (m, world) one frame apart will be, at constant velocity."""
    return newer_m + frames_ahead * (newer_m - older_m)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewPlaces:
    """Where candidate views were taken, and which way they look.

    Attributes:
        section_ids: int64 [V].
        positions_m: float64 [V,3], world.
        directions: float64 [V,3], world, of length 1.
    """

    section_ids: npt.NDArray[np.int64]
    positions_m: npt.NDArray[np.float64]
    directions: npt.NDArray[np.float64]


def wanted_soon(
    places: ViewPlaces,
    predicted_m: npt.NDArray[np.float64],
    direction: npt.NDArray[np.float64],
    *,
    radius_m: float,
    at_most: int,
) -> list[int]:
    """Sections with a view within ``radius_m`` of a predicted position, nearest first (ties by id).

    Args:
        places: Views of all sections, resident or not; those that look more than 60 degrees another way do not count.
        predicted_m: The predicted camera position float64 [3] (m, world).
        direction: The way that the camera looks, float64 [3] of length 1.
        radius_m: How far a view is still near.
        at_most: How many sections to name.
    """
    distances = np.linalg.norm(places.positions_m - predicted_m, axis=1)
    near = np.flatnonzero((distances <= radius_m) & (places.directions @ direction >= _ALIKE))
    nearest: dict[int, float] = {}
    for row in near.tolist():
        section_id = int(places.section_ids[row])
        nearest[section_id] = min(float(distances[row]), nearest.get(section_id, np.inf))
    return sorted(nearest, key=lambda i: (nearest[i], i))[: max(at_most, 0)]


def to_prefetch(wanted: Iterable[int], resident: Iterable[int], loading: Iterable[int]) -> list[int]:
    """Of the sections wanted soon, those to load, in the same order."""
    there = frozenset(resident) | frozenset(loading)
    return [section_id for section_id in wanted if section_id not in there]
