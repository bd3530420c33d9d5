"""What running as processes costs: against one process, start-up left out, and what is late in realtime."""

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from vtslam.services.bench.live_recording import write_live_recording
from vtslam.services.frame_facts import FrameFacts
from vtslam.services.pacing import Pacing
from vtslam.services.process_facts import private_rss_mb
from vtslam.services.run_plan import RunPlan
from vtslam.services.sensor.sources.registry import open_source
from vtslam.services.supervisor.fleet_run import FleetHooks
from vtslam.services.supervisor.supervisor import Supervisor

PARTS = ("ratios", "latency", "realtime")
_LATENCY_HZ, _REALTIME_HZ = 30.0, 60.0
_LOOK_S = 0.25  # between looks at memory, each of which takes a millisecond of the process that hands messages on
_LATENCY_SECTION = 4  # frames: sections shall be sealed although few of such frames are mapped


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetBench:
    """How much is measured.

    Attributes:
        rounds: Runs of each kind for the ratios, taking turns.
        live_seconds: Length of the realtime runs.
        live_sizes: Width and height of their frames, pixels: for latency, and for realtime.
    """

    rounds: int
    live_seconds: float
    live_sizes: tuple[tuple[int, int], tuple[int, int]]


def bench_fleet(
    plan: RunPlan, parts: Sequence[str], bench: FleetBench, *, on_part: Callable[[str], None]
) -> dict[str, Any]:
    """Measure.

    Args:
        plan: The run that the ratios are of; its settings hold for the realtime runs too, whose frames are of the
            simulated room.
        parts: Some of `PARTS`.
        bench: How much.
        on_part: Told what begins.
    """
    values: dict[str, Any] = {}
    if "ratios" in parts:
        values |= _ratios(plan, bench.rounds, on_part)
    if "latency" in parts:
        on_part("descriptors, while sections are published")
        section = replace(plan.settings.section, length=_LATENCY_SECTION)
        short = replace(plan, settings=replace(plan.settings, section=section))
        watched = _watched(short, bench.live_seconds, size=bench.live_sizes[0], rate_hz=_LATENCY_HZ)
        names = ("descriptor_p50_ms", "descriptor_p99_ms")
        values |= {name: _rounded(watched.gauge("tracker", name)) for name in names}
        values |= {"descriptor_hz": _rounded(watched.rate_hz()), "descriptor_sections": watched.sections}
    if "realtime" in parts:
        on_part("realtime")
        watched = _watched(plan, bench.live_seconds, size=bench.live_sizes[1], rate_hz=_REALTIME_HZ)
        values |= {
            "pose_age_p99_ms": _rounded(watched.gauge("tracker", "pose_age_p99_ms")),
            "published": watched.counter("sensor", "frames.published"),
            "processed": watched.counter("tracker", "frames.tracked"),
            "dropped": watched.counter("tracker", "frames.dropped"),
            "mapped": watched.frames,
            "published_hz": _rounded(watched.rate_hz()),
            "rss_growth": _rounded(watched.rss_growth()),
        }
    return values


# --- beside one process -----------------------------------------------------------------------------------------------


class _Stopwatch:
    """From the first committed frame to the last one, in seconds."""

    def __init__(self) -> None:
        self._first_s: float | None = None
        self.seconds = 0.0

    def __call__(self, facts: FrameFacts) -> None:
        now_s = time.perf_counter()
        self._first_s = now_s if self._first_s is None else self._first_s
        self.seconds = now_s - self._first_s


def _ratios(plan: RunPlan, rounds: int, on_part: Callable[[str], None]) -> dict[str, Any]:
    """Seconds from the first committed frame to the last of each kind, and what they are times those of one process."""
    seconds: dict[str, list[float]] = {"in_process": [], "lockstep": [], "pipelined": []}
    for number in range(rounds):
        for name, spent in seconds.items():
            on_part(f"{name.replace('_', ' ')}, round {number + 1} of {rounds}")
            watch = _Stopwatch()
            with TemporaryDirectory(prefix="vtslam-bench-") as folder:
                if name == "in_process":
                    plan.execute(Path(folder, "run"), on_frame=watch)
                else:
                    _paced(plan, Pacing(name)).execute_in_fleet(Path(folder, "run"), FleetHooks(on_frame=watch))
            spent.append(watch.seconds)
    alone = statistics.median(seconds["in_process"])
    values: dict[str, Any] = {"frames": len(plan.source), "rounds": rounds}
    values |= {f"{name}_s": [round(each, 3) for each in spent] for name, spent in seconds.items()}
    for name in ("lockstep", "pipelined"):
        values[f"{name}_ratio"] = round(statistics.median(seconds[name]) / alone, 4) if alone > 0 else None
    return values


def _paced(plan: RunPlan, pacing: Pacing, *, replay_hz: float = 0.0) -> RunPlan:
    fleet = replace(plan.settings.fleet, pacing=pacing.value, replay_hz=replay_hz)
    return replace(plan, settings=replace(plan.settings, fleet=fleet))


# --- realtime ---------------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class _Watched:
    """A realtime run as its supervisor saw it.

    Attributes:
        frames, sections: In the map.
        rss_mb: Private memory of all services, at looks while all of them ran.
        published: (seconds, frames published), likewise.
    """

    frames: int = 0
    sections: int = 0
    rss_mb: list[float] = field(default_factory=list)
    published: list[tuple[float, int]] = field(default_factory=list)
    _supervisor: Supervisor | None = None

    def look(self, supervisor: Supervisor) -> None:
        self._supervisor = supervisor
        now_s = time.perf_counter()
        if self.published and now_s - self.published[-1][0] < _LOOK_S:
            return
        children = supervisor.children.values()
        pids = [child.pid for child in children if child.pid is not None and child.is_ready]
        if len(pids) == len(children):
            self.rss_mb.append(sum(private_rss_mb(pid) for pid in pids))
            self.published.append((now_s, self.counter("sensor", "frames.published")))

    def counter(self, service: str, name: str) -> int:
        return 0 if self._supervisor is None else self._supervisor.children[service].counters.get(name, 0)

    def gauge(self, service: str, name: str) -> float:
        status = None if self._supervisor is None else self._supervisor.children[service].status
        return 0.0 if status is None else status.gauges.get(name, 0.0)

    def rate_hz(self) -> float:
        """Frames published a second."""
        if len(self.published) < 2:
            return 0.0
        (start_s, before), (end_s, after) = self.published[0], self.published[-1]
        return (after - before) / (end_s - start_s)

    def rss_growth(self) -> float:
        """Private memory in the last quarter of the run over that in the second one, less 1; medians."""
        quarter = len(self.rss_mb) // 4
        if quarter == 0:
            return 0.0
        return statistics.median(self.rss_mb[-quarter:]) / statistics.median(self.rss_mb[quarter : 2 * quarter]) - 1.0


def _watched(plan: RunPlan, seconds: float, *, size: tuple[int, int], rate_hz: float) -> _Watched:
    """A realtime run over a recording of so many seconds."""
    watched = _Watched()
    with TemporaryDirectory(prefix="vtslam-bench-") as name:
        recording = Path(name, "recording")
        recording.mkdir()
        uri = write_live_recording(recording, frames=max(round(rate_hz * seconds), 1), size=size)
        live = replace(_paced(plan, Pacing.REALTIME, replay_hz=rate_hz), source=open_source(uri))
        summary = live.execute_in_fleet(Path(name, "run"), FleetHooks(on_step=watched.look))
    watched.frames, watched.sections = summary.frames, summary.sections
    return watched


def _rounded(value: float) -> float:
    return round(value, 3)
