"""Who lives on the bus, by liveliness tokens that vanish with their process."""

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from vtslam.common.topics import Role

_MAX_CHANGES = 1024  # kept unread; `alive` is right in any case


@dataclass(frozen=True, slots=True, kw_only=True)
class AliveChange:
    """A member that came or went.

    Attributes:
        role, name: Which one.
        origin: Which start of it.
        alive: Whether it came.
    """

    role: Role
    name: str
    origin: str
    alive: bool


class AliveWatcher:
    """Members that live now, and changes as they come. Filled by the bus from any thread.

    Args:
        notify: Called after each change.
    """

    def __init__(self, notify: Callable[[], None]) -> None:
        self._notify = notify
        self._lock = threading.Lock()
        self._alive: set[tuple[Role, str, str]] = set()
        self._changes: deque[AliveChange] = deque(maxlen=_MAX_CHANGES)

    def changed(self, key: str, *, alive: bool) -> None:
        """Take over a token's coming or going; tokens of unknown roles are nobody's."""
        role_text, name, origin = key.split("/")[-3:]
        if role_text not in list(Role):
            return
        member = Role(role_text), name, origin
        with self._lock:
            if (member in self._alive) == alive:
                return
            (self._alive.add if alive else self._alive.discard)(member)
            self._changes.append(AliveChange(role=member[0], name=name, origin=origin, alive=alive))
        self._notify()

    def receive(self) -> AliveChange | None:
        """The next change, or None; does not wait."""
        with self._lock:
            return self._changes.popleft() if self._changes else None

    def roles(self) -> frozenset[Role]:
        """Roles of which a member lives."""
        with self._lock:
            return frozenset(role for role, _, _ in self._alive)

    def names(self) -> frozenset[str]:
        """Names of the members that live."""
        with self._lock:
            return frozenset(name for _, name, _ in self._alive)
