"""The supervisor: starts the processes of a fleet in order, watches them, starts them again, stops them in order."""

from collections.abc import Callable, Mapping, Sequence
from enum import Enum

from vtslam.common.bus import Bus
from vtslam.common.fleet_folder import FleetFolder
from vtslam.common.messages import Command, Control, ServiceState, ServiceStatus
from vtslam.common.shm.errors import SharedMemoryError
from vtslam.common.shm.frame_ring import FrameRingReader
from vtslam.common.topics import (
    CONTROL,
    EVERY_SERVICE,
    FLEET_EVENT,
    SECTION_ARCHIVED,
    SECTION_SEALED,
    STATUS,
)
from vtslam.services.pacing import Pacing
from vtslam.services.service_link import ServiceLink
from vtslam.services.supervisor.child_process import ChildProcess
from vtslam.services.supervisor.errors import FleetError, ProcessRefused
from vtslam.services.supervisor.processes import ARCHIVER, MAPPER, PROCESSES, RECORDER, SENSOR, TRACKER, VIEWER, Process
from vtslam.services.supervisor.progress import FleetProgress
from vtslam.services.supervisor.stall import StallWatch
from vtslam.storage.errors import WriteFailed

_POLL_S = 0.1  # between looks at the processes and at what they committed, when the bus is silent
_PARTING_S = 5.0  # that an expendable process has for its last step

Environment = Callable[[str, int], Mapping[str, str]]  # of a process by name, at its n-th start


class _Phase(Enum):
    """How far the fleet is with ending; each begins when a process has come to its end."""

    RUNNING = "running"
    FINISHING = "finishing the rest"  # the sensor has ended
    LAST_ENDING = "ending"  # and so has the second of the other two
    STORING = "storing the rest"  # all have but the archiver, and the recorder if there is one
    SHOWING = "showing the rest"  # and the viewer, if there is one
    ENDED = "ended"


class Supervisor:
    """Watches the processes of one fleet.

    Args:
        bus: A session of the supervisor, in the hub.
        fleet: Name of the fleet.
        folder: The fleet's folder.
        progress: Told of what is sealed and durable; looked at for frames.
        hang_s: Silence of a work loop that is a hang.
        run_lock: Of the run folder, handed down to the archiver.
        processes: The processes of the fleet.
        pacing: Who waits for whom; decides who ends after whom.
        on_event: Told, in words, of what the user should know.
        environment: Variables for a process, for tests and experiments.

    Attributes:
        progress: As given.
        refusal: Why the recording could not be read to its end, if so.
    """

    def __init__(
        self,
        bus: Bus,
        *,
        fleet: str,
        folder: FleetFolder,
        progress: FleetProgress,
        hang_s: float,
        run_lock: int | None = None,
        processes: Sequence[Process] = PROCESSES,
        pacing: Pacing = Pacing.LOCKSTEP,
        on_event: Callable[[str], None] = lambda text: None,
        environment: Environment = lambda name, epoch: {},
    ) -> None:
        self._bus, self._folder, self.progress, self._pacing = bus, folder, progress, pacing
        self._on_event, self._environment = on_event, environment
        self._children = {
            process.name: ChildProcess(
                process,
                fleet=fleet,
                folder=folder,
                hang_s=hang_s,
                run_lock=run_lock if process.name == ARCHIVER.name else None,
                own_session=pacing is not Pacing.REALTIME,
            )
            for process in processes
        }
        self._link = ServiceLink(bus, 1)
        self._alive = bus.watch_alive()
        self._heartbeats = bus.subscriber(STATUS, service=EVERY_SERVICE)
        self._sealed = bus.subscriber(SECTION_SEALED)
        self._archived = bus.subscriber(SECTION_ARCHIVED)
        self._events = bus.subscriber(FLEET_EVENT)
        self._orders = {name: bus.publisher(CONTROL, service=name) for name in self._children}
        self._ordered: dict[str, tuple[Command, int]] = {}  # the last order of each process, and its epoch then
        self._told: set[str] = set()  # processes that were said to wait
        self._stall, self._stalled_at = StallWatch(folder.ring_path, hang_s), -1  # the latter: frames at the last stall
        self._phase = _Phase.RUNNING
        self._parting_ends_s: float | None = None
        self.refusal: ProcessRefused | None = None

    @property
    def children(self) -> Mapping[str, ChildProcess]:
        """The processes by name."""
        return self._children

    def stop(self) -> None:
        """End the fleet in order: what was published is mapped, the open section sealed. Further calls do nothing."""
        self._link.stopping = True

    def step(self) -> float | None:
        """See `Steps`.

        Raises:
            FleetError: A process cannot be kept alive.
            WriteFailed: The run folder cannot be written.
        """
        self._listen()
        self._watch()
        self._advance()
        self.progress.step()
        if self._phase is _Phase.ENDED:
            self._tell(ServiceState.FINISHED)
            return None
        self._start_due()
        self._tell(ServiceState.WORKING if self._phase is _Phase.RUNNING else ServiceState.DRAINING)
        return _POLL_S

    def kill_all(self) -> None:
        """End all processes at once, and wait for that."""
        for child in self._children.values():
            child.kill()

    # --- watching ---------------------------------------------------------------------------------------------------

    def _now_s(self) -> float:
        return 1e-9 * self._bus.clock.monotonic_ns()

    def _listen(self) -> None:
        while (received := self._heartbeats.receive()) is not None:
            child = self._children.get(received.message.service)
            if child is not None:
                child.heard(received.message, 1e-9 * received.arrival_time_ns)
                self._tell_of(received.message)
        while (sealed := self._sealed.receive()) is not None:
            self.progress.sealed(sealed.message)
        while (archived := self._archived.receive()) is not None:
            self.progress.archived(archived.message)
        while (event := self._events.receive()) is not None:
            if event.message.service != self._bus.member.name:
                self._on_event(f"{event.message.service}: {event.message.text}")

    def _tell_of(self, status: ServiceStatus) -> None:
        """Tell the user once if a process works, but not as it should."""
        if status.state is ServiceState.DEGRADED and status.service not in self._told:
            self._told.add(status.service)
            self._on_event(f"{status.service}: {status.detail}")

    def _watch(self) -> None:
        now_s, names = self._now_s(), self._alive.names()
        for name, child in self._children.items():
            child.seen(on_bus=name in names, now_s=now_s)
            try:
                event = child.reap(now_s, self.progress.num_frames)
            except ProcessRefused as refusal:
                if name == ARCHIVER.name:
                    raise WriteFailed(str(refusal)) from refusal
                if name != SENSOR.name:
                    raise
                self.refusal = refusal  # what was read before is mapped to its end
                event = None
            self._tell_of_death(event or child.kill_if_hung(now_s, self.progress.num_frames))
        self._end_stall(now_s)

    def _end_stall(self, now_s: float) -> None:
        """Start tracker and mapper again if frames wait and neither of them does anything, whatever they lack."""
        frames, workers = self.progress.num_frames, [self._children[each.name] for each in (TRACKER, MAPPER)]
        waits = self._pacing is not Pacing.REALTIME and all(child.is_waiting for child in workers)
        if not self._stall.is_there(now_s, frames, waits=waits):
            return
        why = f"did nothing for {self._stall.limit_s:g} s although frames wait"
        if self._stalled_at == frames:
            raise FleetError(f"{TRACKER.name}, {MAPPER.name}: {why} after {frames} frames, for the 2nd time")
        self._stalled_at = frames
        for child in workers:
            self._tell_of_death(child.kill_as_hung(why, now_s, frames))

    def _tell_of_death(self, event: str | None) -> None:
        if event is not None:
            self._link.event("restarted", event)
            self._on_event(event)

    def _start_due(self) -> None:
        now_s = self._now_s()
        for name, child in self._children.items():
            ready = all(self._children[other].is_ready for other in child.process.after if other in self._children)
            if child.is_due(now_s) and (ready or child.epoch > 0):
                environment = self._environment(name, child.epoch + 1)
                self._tell_of_death(child.start(now_s, self.progress.num_frames, environment))

    def _tell(self, state: ServiceState) -> None:
        for name, child in self._children.items():
            self._link.counters[f"{name}.deaths"] = child.deaths
            self._link.counters[f"{name}.hangs"] = child.hangs
        self._link.gauges["map_peak_mb"] = 1e-6 * self.progress.map_peak_bytes
        self._link.tell(state, self.progress.num_frames - 1, detail=f"{self._pacing}, {self._phase.value}")

    # --- ending -----------------------------------------------------------------------------------------------------

    def _advance(self) -> None:
        """The sensor ends first, then the others, each when nothing is left of what the one before it gave.

        Where every frame is mapped, the mapper knows by itself when that is, and needs the tracker until then.
        In realtime the tracker says what was dropped to the last frame, and the mapper takes what there is.
        The archiver ends when all is written, a recorder when there is nothing new to record; a viewer is told, and
        given a moment.
        """
        sensor, mapper, tracker = (self._children[process.name] for process in (SENSOR, MAPPER, TRACKER))
        second, last = (tracker, mapper) if self._pacing is Pacing.REALTIME else (mapper, tracker)
        if self._phase is _Phase.RUNNING:
            if self._link.stopping:
                self._end(sensor)
            if sensor.finished:
                self._phase = _Phase.FINISHING
        if self._phase is _Phase.FINISHING:
            self._order(second, Command.DRAIN, through_frame_id=self._last_published())
            if second.finished:
                self._phase = _Phase.LAST_ENDING
        if self._phase is _Phase.LAST_ENDING:
            if last is mapper:
                self._order(mapper, Command.DRAIN, through_frame_id=self._last_published())
            else:
                self._end(tracker)
            if last.finished:
                self._phase = _Phase.STORING
        if self._phase is _Phase.STORING:
            self._order(self._children[ARCHIVER.name], Command.DRAIN)
            recorder = self._children.get(RECORDER.name)
            if recorder is not None:
                self._order(recorder, Command.STOP)  # one that died is started again, and records the rest
            if all(child.finished for child in self._children.values() if not child.process.is_expendable):
                self._phase = _Phase.SHOWING
        if self._phase is _Phase.SHOWING:
            viewer = self._children.get(VIEWER.name)
            if viewer is None or viewer.finished or self._has_parted(viewer):
                self._phase = _Phase.ENDED

    def _has_parted(self, child: ChildProcess) -> bool:
        """Let an expendable process end by itself for a moment, then at once."""
        self._end(child)
        if self._parting_ends_s is None:
            self._parting_ends_s = self._now_s() + _PARTING_S
        if self._now_s() >= self._parting_ends_s:
            child.kill()
            child.finished = True
        return child.finished

    def _end(self, child: ChildProcess) -> None:
        """Let a process end; one that does not run stays so."""
        if child.pid is None:
            child.finished = True
        else:
            self._order(child, Command.STOP)

    def _order(self, child: ChildProcess, command: Command, *, through_frame_id: int = -1) -> None:
        """Give an order once to each start of a process; the bus keeps it for one that is not listening yet."""
        name = child.process.name
        if child.pid is None or self._ordered.get(name) == (command, child.epoch):
            return
        self._ordered[name] = command, child.epoch
        child.is_told_to_end = True
        self._orders[name].publish(
            Control(command=command, through_frame_id=through_frame_id, epoch=child.epoch, why="the run ends")
        )

    def _last_published(self) -> int:
        try:
            return FrameRingReader(self._folder.ring_path).published - 1
        except SharedMemoryError:
            return -1  # the sensor ended before it made the ring
