"""The processes of a fleet: who there is, who is started after whom, and what each is made of."""

from dataclasses import dataclass

from vtslam.common.topics import Role


@dataclass(frozen=True, slots=True, kw_only=True)
class Process:
    """One row of the table.

    Attributes:
        name: Its name, for status and orders.
        role: What it may publish.
        after: Processes that are ready before it is started.
    """

    name: str
    role: Role
    after: tuple[str, ...] = ()


SENSOR = Process(name="sensor", role=Role.SENSOR, after=("mapper", "tracker"))
TRACKER = Process(name="tracker", role=Role.TRACKER)
MAPPER = Process(name="mapper", role=Role.MAPPER)

LIVE_SOURCE = "live:"  # in run.toml: frames come from publishers

PROCESSES = (MAPPER, TRACKER, SENSOR)


def process_named(name: str) -> Process:
    """The process of a name; KeyError if there is none."""
    return {process.name: process for process in PROCESSES}[name]
