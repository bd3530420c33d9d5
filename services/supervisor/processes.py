"""The processes of a fleet: who there is, who is started after whom, and what each is made of."""

from dataclasses import dataclass

from vtslam.common.settings import Settings
from vtslam.common.topics import Role


@dataclass(frozen=True, slots=True, kw_only=True)
class Process:
    """One row of the table.

    Attributes:
        name: Its name, for status and orders.
        role: What it may publish.
        after: Processes that are ready before it is started, as far as the fleet has them.
        is_expendable: Whether the fleet goes on without it: it is not started again, and nobody waits for it.
        ends_itself: Whether it may come to its end without being told to.
    """

    name: str
    role: Role
    after: tuple[str, ...] = ()
    is_expendable: bool = False
    ends_itself: bool = False


SENSOR = Process(name="sensor", role=Role.SENSOR, after=("mapper", "tracker", "recorder"), ends_itself=True)
TRACKER = Process(name="tracker", role=Role.TRACKER)
MAPPER = Process(name="mapper", role=Role.MAPPER)
ARCHIVER = Process(name="archiver", role=Role.ARCHIVER)
RECORDER = Process(name="recorder", role=Role.RECORDER)
VIEWER = Process(name="viewer", role=Role.VIEWER, is_expendable=True, ends_itself=True)

LIVE_SOURCE = "live:"  # in run.toml: frames come from publishers

PROCESSES = (MAPPER, TRACKER, SENSOR, ARCHIVER)  # of every fleet


def processes_of(settings: Settings) -> tuple[Process, ...]:
    """The processes of a fleet with these settings."""
    recorder = (RECORDER,) if settings.recorder.file else ()
    return (*PROCESSES, *recorder, *((VIEWER,) if settings.viewer.is_wanted else ()))


def process_named(name: str) -> Process:
    """The process of a name; KeyError if there is none."""
    return {process.name: process for process in (*PROCESSES, RECORDER, VIEWER)}[name]
