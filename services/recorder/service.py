"""The recorder as a service: frames from the ring, poses and events, into a file."""

import numpy as np
import numpy.typing as npt

from vtslam.common.bus import Bus
from vtslam.common.fleet_folder import FleetFolder
from vtslam.common.messages import ServiceState, ServiceStatus
from vtslam.common.shm.errors import FrameGone, SharedMemoryError
from vtslam.common.shm.frame_ring import FrameRingReader
from vtslam.common.shm.ring_layout import FrameDescriptor
from vtslam.common.topics import EVERY_SERVICE, MAPPER_COMMITTED, SECTION_SEALED, SENSOR_FRAME, STATUS
from vtslam.services.frame_journal import JournalReader
from vtslam.services.service_link import HEARTBEAT_S, ServiceLink
from vtslam.storage.recording.writer import RecordingWriter

_ODD_STATES = ("weak", "lost")  # of tracking


class RecorderService:
    """Records every frame of the ring, in order, and the pose of each once it is committed.

    Where the ring says that it is recorded, frames wait there for this service. Otherwise those that were overwritten
    first are missing in the recording, and counted. Poses are those that were told and those of the fleet's journal: a
    mapper that dies may not have told, and the journal does not keep them for long.

    Args:
        bus: Its session.
        link: What it says of itself and is told.
        folder: The fleet's folder.
        recording: Where to; closed at the end.
    """

    def __init__(self, bus: Bus, link: ServiceLink, folder: FleetFolder, recording: RecordingWriter) -> None:
        self._bus, self._link, self._folder, self._recording = bus, link, folder, recording
        self._journal = JournalReader(folder.journal_path)
        self._frames = bus.subscriber(SENSOR_FRAME, newest_only=True)  # wakes; what there is, is in the ring
        self._commits = bus.subscriber(MAPPER_COMMITTED)
        self._sealed = bus.subscriber(SECTION_SEALED)
        self._statuses = bus.subscriber(STATUS, service=EVERY_SERVICE)
        self._states: dict[str, tuple[int, ServiceState]] = {}  # of each service: its start, what it said last
        self._ring: FrameRingReader | None = None
        self._sequence: int | None = None  # of the last frame looked at
        self._first_frame_id = self._last_frame_id = self._last_pose_id = -1
        self._time_ns = 0  # of the last frame

    def step(self) -> float | None:
        """See `Steps`.

        Raises:
            WriteFailed: The recording cannot be written.
        """
        self._link.poll()
        stopping = self._link.stopping  # known before the last look at what there is
        self._frames.receive()
        busy = self._take_frame()
        self._take_poses()
        self._take_events()
        if busy:
            self._link.tell(ServiceState.WORKING, self._last_frame_id)
            return 0.0
        if stopping:
            self._recording.close()
            self._link.tell(ServiceState.FINISHED, self._last_frame_id)
            return None
        self._link.tell(ServiceState.READY, self._last_frame_id)
        return HEARTBEAT_S

    def _take_frame(self) -> bool:
        """Record the next frame; false if there is none."""
        descriptor = self._next_frame()
        if descriptor is None or self._ring is None:
            return False
        missed = 0 if self._sequence is None else descriptor.sequence - self._sequence - 1
        try:
            frame = self._ring.copied(descriptor)
        except FrameGone:
            missed += 1
        else:
            self._recording.add_frame(frame)
            if self._first_frame_id < 0:
                self._first_frame_id = frame.frame_id
            self._last_frame_id, self._time_ns = frame.frame_id, frame.capture_time_ns
            self._link.count("frames.recorded")
        if missed:
            self._link.count("frames.missed", missed)
        self._sequence = descriptor.sequence
        self._ring.record(descriptor.sequence)
        return True

    def _next_frame(self) -> FrameDescriptor | None:
        try:
            self._ring = self._ring or FrameRingReader(self._folder.ring_path)
        except SharedMemoryError:
            return None  # not made yet
        if self._sequence is None:
            self._sequence = self._ring.recorded
        newer = self._ring.after(self._sequence or 0)
        return newer[0] if newer else None

    def _take_poses(self) -> None:
        if self._first_frame_id < 0:
            return
        found: dict[int, tuple[int, npt.NDArray[np.float64]]] = {}  # by frame: capture time, pose
        while (received := self._commits.receive()) is not None:
            commit = received.message
            found[commit.frame_id] = commit.capture_time_ns, commit.T_world_camera
        odd: dict[int, str] = {}
        for line in self._journal.new_lines():  # lines of durable sections are deleted, read or not
            facts = line.frame.facts
            found[facts.frame_id] = line.frame.capture_time_ns, line.frame.T_world_camera
            if facts.state in _ODD_STATES:
                odd[facts.frame_id] = facts.state
        for frame_id, (time_ns, T_world_camera) in sorted(found.items(), key=lambda item: item[0]):
            if self._add_pose(frame_id, time_ns, T_world_camera) and frame_id in odd:
                self._event("tracker", f"frame {frame_id}: {odd[frame_id]}", warning=True)

    def _add_pose(self, frame_id: int, capture_time_ns: int, T_world_camera: npt.NDArray[np.float64]) -> bool:
        """Record a pose unless it was, or belongs to a frame before the recording; whether it was done now."""
        if frame_id <= self._last_pose_id or frame_id < self._first_frame_id:
            return False
        self._last_pose_id = frame_id
        self._recording.add_pose(frame_id, capture_time_ns, T_world_camera)
        return True

    def _take_events(self) -> None:
        while (sealed := self._sealed.receive()) is not None:
            about = sealed.message
            self._event("mapper", f"section {about.section_id}: {about.frames} frames, {about.gaussians} Gaussians")
        while (status := self._statuses.receive()) is not None:
            self._take_status(status.message)

    def _take_status(self, status: ServiceStatus) -> None:
        """Note a change of state; that a service is ready or works by turns is none."""
        state = ServiceState.WORKING if status.state is ServiceState.READY else status.state
        if self._states.get(status.service) == (status.epoch, state):
            return
        self._states[status.service] = status.epoch, state
        text = f"start {status.epoch}: {state.value}" + (f": {status.detail}" if status.detail else "")
        self._event(status.service, text, warning=state is ServiceState.DEGRADED)

    def _event(self, service: str, text: str, *, warning: bool = False) -> None:
        if self._first_frame_id < 0:
            return  # there is no time to file it under yet
        now_ns = self._bus.clock.wall_ns()
        self._recording.add_event(service, text, wall_time_ns=now_ns, capture_time_ns=self._time_ns, warning=warning)
