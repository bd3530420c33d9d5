"""Which of the things that could happen next does, on the bus in memory: drawn by a seed, or tried out one by one.

Also when a service is killed. All is deterministic: an equal schedule and equal kills give an equal course.
"""

import random
from collections.abc import Callable, Sequence
from typing import Protocol


class Schedule(Protocol):
    """Chooses what happens next."""

    def choose(self, events: Sequence[str]) -> int:
        """The index of one of ``events``, of which there is at least one."""
        ...


class SeededSchedule:
    """Any order, drawn by a seed."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)

    def choose(self, events: Sequence[str]) -> int:
        """See `Schedule`."""
        return self._random.randrange(len(events))


class ScriptedSchedule:
    """Given choices, then always the first; `taken` tells what was chosen, of how many."""

    def __init__(self, choices: Sequence[int] = ()) -> None:
        self._choices = tuple(choices)
        self.taken: list[tuple[int, int]] = []

    def choose(self, events: Sequence[str]) -> int:
        """See `Schedule`."""
        place = len(self.taken)
        choice = self._choices[place] if place < len(self._choices) else 0
        assert choice < len(events), "the course differs from the one that the script was made from"
        self.taken.append((choice, len(events)))
        return choice


def try_schedules(run: Callable[[Schedule], None], *, limit: int) -> tuple[int, bool]:
    """Call ``run`` with one schedule after the other, depth first, until all were tried or ``limit`` is reached.

    Returns:
        How many were tried, and whether those are all there are.
    """
    choices: list[int] | None = []
    for count in range(1, limit + 1):
        schedule = ScriptedSchedule(choices or ())
        run(schedule)
        choices = _next_choices(schedule.taken)
        if choices is None:
            return count, True
    return limit, False


def _next_choices(taken: list[tuple[int, int]]) -> list[int] | None:
    for place in range(len(taken) - 1, -1, -1):
        choice, out_of = taken[place]
        if choice + 1 < out_of:
            return [*(earlier for earlier, _ in taken[:place]), choice + 1]
    return None


class Kills(Protocol):
    """Decides at which points services die."""

    def dies(self, service: str, point: str) -> bool:
        """Whether ``service`` dies at the point it passes now."""
        ...


class NoKills:
    """Nobody dies."""

    def dies(self, service: str, point: str) -> bool:
        """See `Kills`."""
        return False


class KillAt:
    """One service dies, at the ``passage``-th point that it passes, counted from 0."""

    def __init__(self, service: str, passage: int) -> None:
        self._service, self._left = service, passage

    def dies(self, service: str, point: str) -> bool:
        """See `Kills`."""
        if service != self._service:
            return False
        self._left -= 1
        return self._left == -1


class SeededKills:
    """Each passage of a point is deadly with some probability, a bounded number of times in all."""

    def __init__(self, seed: int, *, probability: float, limit: int) -> None:
        self._random = random.Random(seed)
        self._probability, self._left = probability, limit

    def dies(self, service: str, point: str) -> bool:
        """See `Kills`."""
        if self._left == 0 or self._random.random() >= self._probability:
            return False
        self._left -= 1
        return True
