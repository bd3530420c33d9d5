"""One process of a fleet as its supervisor sees it: started, heard of, dead, started again."""

import os
import subprocess
import sys
from collections.abc import Mapping

from vtslam.common.fleet_folder import FleetFolder
from vtslam.common.messages import ServiceState, ServiceStatus
from vtslam.services.supervisor.child import REFUSED
from vtslam.services.supervisor.errors import FleetError, ProcessRefused
from vtslam.services.supervisor.processes import Process

_MODULE = "vtslam.services.supervisor.child"
_MAX_DEATHS = 5  # without a commit in between
_BACK_OFF_S = (0.0, 0.0, 0.2, 0.5, 1.0, 2.0)  # before a start, by such deaths
_MISSING_S = 3.0  # without a token on the bus although the process runs: it is stopped as a whole
_START_S = 120.0  # to the first heartbeat
_READY = frozenset(set(ServiceState) - {ServiceState.STARTING})


class ChildProcess:
    """A process and its history.

    Args:
        process: What it is.
        fleet: Name of the fleet.
        folder: The fleet's folder.
        hang_s: Silence of its work loop that is a hang.
        run_lock: Descriptor of the run folder's lock for a process that writes there; it keeps its number.
        own_session: The kernel may share processors out among sessions first (autogroups). Processes that take turns
            are quicker with a session each; those that work all the time answer at once only within a common one.

    Attributes:
        epoch: How often it was started.
        status: What it said last, in this epoch; None if nothing.
        finished: Whether it came to its end.
        is_told_to_end: Whether it was, in this epoch.
        deaths: How often it died or was killed.
        hangs: How often it was killed for being silent.
    """

    def __init__(
        self,
        process: Process,
        *,
        fleet: str,
        folder: FleetFolder,
        hang_s: float,
        run_lock: int | None = None,
        own_session: bool = True,
    ) -> None:
        self.process, self._fleet, self._folder, self._hang_s = process, fleet, folder, hang_s
        self._handed_down = () if run_lock is None else (run_lock,)
        self._own_session = own_session
        self.epoch = self.deaths = self.hangs = 0
        self.status: ServiceStatus | None = None
        self.finished = self.is_told_to_end = False
        self.peak_rss_mb = 0.0
        self._ended_counts: dict[str, int] | None = None
        self._popen: subprocess.Popen[bytes] | None = None
        self._start_at_s = 0.0
        self._heard_s = self._present_s = 0.0
        self._deaths_here, self._frames_then = 0, -1

    @property
    def pid(self) -> int | None:
        """Its process, if it runs."""
        return None if self._popen is None else self._popen.pid

    @property
    def counters(self) -> Mapping[str, int]:
        """What it has counted: in all once it has ended, which its last message may not tell; before, as it said."""
        if self._ended_counts is not None:
            return self._ended_counts
        return {} if self.status is None else self.status.counters

    @property
    def is_ready(self) -> bool:
        """Whether it works, or has come to its end."""
        return self.finished or (self.status is not None and self.status.state in _READY)

    @property
    def is_waiting(self) -> bool:
        """Whether it runs, and said last that there is nothing for it to do."""
        return self._popen is not None and self.status is not None and self.status.state is ServiceState.READY

    def is_due(self, now_s: float) -> bool:
        """Whether it should be started now."""
        return self._popen is None and not self.finished and now_s >= self._start_at_s

    def start(self, now_s: float, frames: int, environment: Mapping[str, str]) -> str | None:
        """Start it; the one before it is dead. From the thread that lives as long as the fleet: see `child`.

        Returns:
            What to tell the user if that was refused, which is a death like others.

        Raises:
            FleetError: It died too often without a commit in between.
        """
        assert self._popen is None
        self.epoch, self.status, self.is_told_to_end = self.epoch + 1, None, False
        self._heard_s = self._present_s = now_s
        words = [self.process.name, self._fleet, "--base", str(self._folder.path.parent)]
        words += ["--epoch", str(self.epoch), "--parent", str(os.getpid())]
        words += [word for each in self._handed_down for word in ("--run-lock", str(each))]
        try:
            self._popen = subprocess.Popen(
                [sys.executable, "-m", _MODULE, *words],
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", **environment},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=self._handed_down,
                # Ctrl-C in a terminal is for the supervisor, hence a session or a process group of its own.
                start_new_session=self._own_session,
                process_group=None if self._own_session else 0,
            )
        except OSError as error:  # no memory, or too many processes, for now
            return self._died(f"could not be started: {error.strerror}", now_s, frames)
        return None

    def heard(self, status: ServiceStatus, now_s: float) -> None:
        """Take in a heartbeat; those of former starts are nobody's."""
        if status.epoch == self.epoch:
            self.status, self._heard_s = status, now_s
            self.peak_rss_mb = max(self.peak_rss_mb, status.gauges.get("peak_rss_mb", 0.0))

    def seen(self, *, on_bus: bool, now_s: float) -> None:
        """Note whether it is on the bus; before its first heartbeat it need not be."""
        if on_bus or self.status is None:
            self._present_s = now_s

    def reap(self, now_s: float, frames: int) -> str | None:
        """See whether it has ended; what to tell the user if it died.

        Raises:
            ProcessRefused: It said that going on is of no use.
            FleetError: It died too often without a commit in between.
        """
        code = None if self._popen is None else self._popen.poll()
        if code is None:
            return None
        self._popen = None
        counts = self._folder.counts(self.process.name, self.epoch)  # which it leaves when it has come to its end
        if code == 0 and (self.is_told_to_end or (self.process.ends_itself and counts is not None)):
            self.finished, self._ended_counts = True, counts
            return None
        if code == REFUSED:
            why = self._folder.failure(self.process.name)
            if self.process.is_expendable:
                return self._died(why, now_s, frames)
            self.finished = True
            raise ProcessRefused(self.process.name, why)
        return self._died(_end_in_words(code), now_s, frames)

    def kill_if_hung(self, now_s: float, frames: int) -> str | None:
        """Kill it if it is silent for too long and others need it; what to tell the user then."""
        if self._popen is None or self.process.is_expendable:
            return None
        if now_s - self._present_s > _MISSING_S:
            why = "left the bus while it ran"
        elif now_s - self._heard_s > (limit_s := _START_S if self.status is None else self._hang_s):
            why = f"silent for {limit_s:g} s"
        else:
            return None
        return self.kill_as_hung(why, now_s, frames)

    def kill_as_hung(self, why: str, now_s: float, frames: int) -> str:
        """Kill it; what to tell the user. Raises FleetError if it died too often without a commit in between."""
        self.kill()
        self.hangs += 1
        return self._died(why, now_s, frames)

    def kill(self) -> None:
        """End it at once, and wait for that."""
        if self._popen is not None:
            self._popen.kill()
            self._popen.wait()
            self._popen = None

    def _died(self, how: str, now_s: float, frames: int) -> str:
        self.deaths += 1
        if self.process.is_expendable:
            self.finished = True
            return f"{self.process.name}: {how}; the fleet goes on without it"
        self._deaths_here = self._deaths_here + 1 if frames == self._frames_then else 1
        self._frames_then = frames
        text = f"{self.process.name}: {how} after {frames} frames"
        if self._deaths_here > _MAX_DEATHS:
            raise FleetError(f"{text}, for the {self._deaths_here}th time without a commit in between")
        self._start_at_s = now_s + _BACK_OFF_S[self._deaths_here]
        return f"{text}; started again"


def _end_in_words(code: int) -> str:
    if code == 0:
        return "ended without being told to"
    return f"killed by signal {-code}" if code < 0 else f"ended with status {code}"
