"""Small recordings through a fleet and through one process, and what to compare of them."""

import json
import os
import signal
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from threading import Thread

from helpers.recordings import ReplicaRecording, filled

from vtslam.services.frame_facts import FrameFacts
from vtslam.services.network import Door
from vtslam.services.run_plan import RunPlan, plan_run
from vtslam.services.run_record import RunSummary
from vtslam.services.sensor.sources.registry import open_source
from vtslam.services.supervisor.child_process import ChildProcess
from vtslam.services.supervisor.fleet_run import FleetHooks
from vtslam.services.supervisor.live_run import run_live
from vtslam.services.supervisor.supervisor import Supervisor

FRAMES, SECTION = 20, 6
ASSIGNMENTS = (
    f"source.frames=0:{FRAMES}",
    f"section.length={SECTION}",
    "section.candidate_interval=3",
    "mapper.iterations_head=6",
    "mapper.iterations_regular=3",
    "mapper.iterations_seal=4",
    "mapper.keep_moments=true",
    "holdout=4",
    "splat.threads=1",
    "fleet.pacing=lockstep",
)


def write_small_recording(folder: Path) -> ReplicaRecording:
    """Some frames of the simulated room as files, since the room takes a second to build at every start."""
    source = open_source("sim:room?frames=60", size=(64, 48))
    frames = [source.frame(index) for index in range(FRAMES)]
    camera = {**source.camera.as_dict(), "scale": 1.0 / source.depth_scale_m}
    poses = source.ground_truth()
    assert poses is not None
    recording = ReplicaRecording(
        folder=folder, rgb=[f.rgb for f in frames], depth=[f.depth for f in frames], poses=poses[:FRAMES]
    )
    (folder / "results").mkdir(parents=True)
    words = {"width": "w", "height": "h"}
    (folder / "cam_params.json").write_text(
        json.dumps({"camera": {words.get(key, key): value for key, value in camera.items()}})
    )
    return filled(recording)


def small_plan(recording: ReplicaRecording, *assignments: str, source: str = "") -> RunPlan:
    """The plan of a run; ``source`` is added to the recording's URI."""
    return plan_run(recording.uri + source, family="tum", assignments=[*ASSIGNMENTS, *assignments])


def result_bytes(run: Path) -> dict[str, bytes]:
    """The files of a run that must not depend on how it was run, by name."""
    paths = [run / "trajectory.txt", *sorted((run / "sections").glob("*.vts"))]
    return {path.name: path.read_bytes() for path in paths}


@dataclass(frozen=True, slots=True)
class SmallRecording:
    """The recording, and the result of mapping it in one process."""

    files: ReplicaRecording
    undisturbed: dict[str, bytes]


@dataclass(slots=True)
class Disturbance:
    """Signals to processes of a fleet once so many frames are committed, and fail points of their starts.

    Attributes:
        signals: (frames, process, signal), each sent once.
        failpoints: By (process, start), as in ``shm.commit.before_flip:3``.
        events: What the supervisor told.
        pids: All that were seen.
        children: The processes as their supervisor sees them.
        map_peak_bytes, map_sealed_bytes: See `FleetProgress`.
        on_step: Called after each step of the supervisor, and after a stop that was asked for in it.
    """

    signals: list[tuple[int, str, signal.Signals]] = field(default_factory=list)
    failpoints: dict[tuple[str, int], str] = field(default_factory=dict)
    events: list[str] = field(default_factory=list)
    pids: set[int] = field(default_factory=set)
    children: Mapping[str, ChildProcess] = field(default_factory=dict)
    frames: int = 0
    map_peak_bytes: int = 0
    map_sealed_bytes: int = 0
    on_step: Callable[[], None] = lambda: None

    @property
    def deaths(self) -> dict[str, int]:
        """By process, up to now."""
        return {name: child.deaths for name, child in self.children.items()}

    @property
    def hangs(self) -> dict[str, int]:
        """By process, up to now."""
        return {name: child.hangs for name, child in self.children.items()}

    def hooks(self, should_stop: Callable[[], bool] = lambda: False) -> FleetHooks:
        return FleetHooks(
            on_frame=lambda facts: self._count(facts.frame_id),
            on_event=self.events.append,
            on_step=self._step,
            should_stop=should_stop,
            environment=self._environment,
        )

    def _count(self, frame_id: int) -> None:
        assert frame_id == self.frames, "every frame once, in order"
        self.frames += 1

    def _environment(self, name: str, epoch: int) -> dict[str, str]:
        return {"VTSLAM_FAILPOINT": self.failpoints.get((name, epoch), "")}

    def _step(self, supervisor: Supervisor) -> None:
        self.children = supervisor.children
        self.map_peak_bytes, self.map_sealed_bytes = supervisor.progress.map_peak_bytes, supervisor.progress.map_bytes
        for child in supervisor.children.values():
            if child.pid is not None:
                self.pids.add(child.pid)
        for wanted in [each for each in self.signals if each[0] <= self.frames]:
            pid = supervisor.children[wanted[1]].pid
            if pid is not None and supervisor.children[wanted[1]].is_ready:
                os.kill(pid, wanted[2])
                self.signals.remove(wanted)
        self.on_step()


class CutOff(BaseException):
    """Stands for the end of the process, which nothing is done about."""


def cut_off_at(frame_id: int) -> Callable[[FrameFacts], None]:
    """What to call after each frame, to end the run there."""

    def on_frame(facts: FrameFacts) -> None:
        if facts.frame_id == frame_id:
            raise CutOff

    return on_frame


def fleet_run(
    recording: ReplicaRecording,
    out: Path,
    disturbance: Disturbance | None = None,
    *,
    should_stop: Callable[[], bool] = lambda: False,
) -> RunSummary:
    """The small recording through a fleet."""
    return small_plan(recording).execute_in_fleet(out, (disturbance or Disturbance()).hooks(should_stop))


def live_run(
    out: Path, fleet: str, disturbance: Disturbance, publish: Callable[[], None], *, door: Door | None = None
) -> RunSummary:
    """A live fleet that ends once ``publish``, in a thread of its own, has returned."""
    failed: list[BaseException] = []

    def work() -> None:
        try:
            publish()
        except BaseException as error:
            failed.append(error)

    publisher = Thread(target=work)

    def is_done() -> bool:
        if publisher.ident is None:
            publisher.start()
        return not publisher.is_alive()

    try:
        hooks = disturbance.hooks(is_done)
        return run_live(out, hooks, fleet=fleet, preset="fast", family="tum", assignments=ASSIGNMENTS, door=door)
    finally:
        publisher.join()
        assert not failed, failed
