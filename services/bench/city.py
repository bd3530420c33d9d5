"""A long drive through the simulated town as a fleet: does anything grow, does the map stay within its memory?"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from vtslam.common.metrics_trajectory import segment_drift_pct, trajectory_errors
from vtslam.common.trajectory_io import read_trajectory
from vtslam.services.bench.fleet_watch import FleetWatch, Window
from vtslam.services.frame_facts import FrameFacts
from vtslam.services.run_plan import RunPlan
from vtslam.services.run_record import RunSummary
from vtslam.services.sensor.sources.base import Source
from vtslam.services.sensor.sources.registry import open_source
from vtslam.services.supervisor.fleet_run import FleetHooks
from vtslam.storage.run_folder import RunFolder

_SAMPLED_FRAMES = 40  # of the recording, for its size as files
_JPEG_QUALITY = 90


@dataclass(frozen=True, slots=True, kw_only=True)
class CityDrive:
    """What is driven, and in how much memory.

    Attributes:
        frames: Frames; None for the whole drive.
        size: Width and height in pixels.
        budget_mb: Of the map store, 10^6 bytes.
        trajectory: KITTI pose file to drive along; None for laps around a block.
        laps: Laps, without ``trajectory``.
        pose_prior: "M,DEG", standard deviations of the poses that are given along; None for none.
    """

    frames: int | None
    size: tuple[int, int]
    budget_mb: int
    trajectory: Path | None
    laps: int
    pose_prior: str | None

    @property
    def uri(self) -> str:
        """The source."""
        drive = f"trajectory={self.trajectory.absolute()}" if self.trajectory else f"laps={self.laps}"
        prior = f"&prior={self.pose_prior}" if self.pose_prior else ""
        return f"sim:city?{drive}{prior}"

    @property
    def assignments(self) -> list[str]:
        """The settings that it asks for."""
        words = [f'source.size="{self.size[0]}x{self.size[1]}"', f"fleet.map_budget_mb={self.budget_mb}"]
        return words if self.frames is None else [*words, f'source.frames="0:{self.frames}"']


def bench_city(drive: CityDrive, plan: RunPlan, *, on_frame: Callable[[FrameFacts], None]) -> dict[str, Any]:
    """Run it.

    Args:
        drive: What is driven.
        plan: The run of it.
        on_frame: Called after each frame.

    Raises:
        SourceError, FleetError, StorageError: See `RunPlan.execute_in_fleet`.
    """
    watch, events = FleetWatch(), list[str]()

    def frame_done(facts: FrameFacts) -> None:
        watch.on_frame(facts)
        on_frame(facts)

    with TemporaryDirectory(prefix="vtslam-city-") as name:
        run = Path(name, "run")
        start_s = time.perf_counter()
        hooks = FleetHooks(on_frame=frame_done, on_step=watch.on_step, on_event=events.append)
        summary = plan.execute_in_fleet(run, hooks)
        seconds = time.perf_counter() - start_s
        values = {**_of_run(summary, seconds), **_costs(watch, _windows(drive, summary.frames)), **_map_of(run, watch)}
        values |= _errors(read_trajectory(run / "trajectory.txt").poses, plan.source)
    values |= {"disk_mb_per_s": round(values["map_disk_mb"] / seconds, 3), "events": events}
    return values | {"recording_mb": round(_recording_mb(plan.source), 3)}


def _of_run(summary: RunSummary, seconds: float) -> dict[str, Any]:
    return {
        "frames": summary.frames,
        "sections": summary.sections,
        "gaussians": summary.gaussians,
        "weak": summary.weak,
        "lost": summary.lost,
        "seconds": round(seconds, 1),
    }


def _windows(drive: CityDrive, frames: int) -> tuple[Window, Window]:
    """The frames of the second and the last whole lap; of the second and last quarter where there are no three."""
    if drive.trajectory is None:
        lap = len(open_source(f"sim:city?laps={drive.laps}")) // drive.laps
        laps = frames // lap
        if laps >= 3:
            return (lap, 2 * lap), ((laps - 1) * lap, laps * lap)
    return (frames // 4, frames // 2), (3 * frames // 4, frames)


def _costs(watch: FleetWatch, windows: tuple[Window, Window]) -> dict[str, Any]:
    second, last = (watch.cpu_s_per_frame(window) for window in windows)
    growth = watch.rss_growth()
    known = [each for each in growth.values() if each is not None]
    return {
        "time_growth": _ratio(sum(last.values()), sum(second.values())),
        "time_growth_by_process": {name: _ratio(last[name], second[name]) for name in last},
        "cpu_s_per_frame": {name: round(last[name], 4) for name in last},
        "rss_growth": round(max(known), 4) if known else None,
        "rss_growth_by_process": {name: each and round(each, 4) for name, each in growth.items()},
        "rss_mb": {name: round(max(values), 1) for name, values in watch.rss_mb.items()},
        "sections_reloaded": sum(
            counts.get("sections.reloaded", 0) + counts.get("sections.read", 0) for counts in watch.counters.values()
        ),
        "shm_peak_mb": round(watch.map_peak_mb, 3),
    }


def _ratio(value: float, base: float) -> float | None:
    return round(value / base, 4) if base > 0.0 else None


def _map_of(path: Path, watch: FleetWatch) -> dict[str, Any]:
    """The map's size: in memory, had it all been kept there, and on disk."""
    with RunFolder.open(path) as run:
        on_disk = sum(row.num_bytes for row in run.catalog.sections())
    return {"map_mb": round(watch.map_mb, 3), "map_disk_mb": round(1e-6 * on_disk, 3)}


def _errors(estimated: npt.NDArray[np.float64], source: Source) -> dict[str, Any]:
    truth = source.ground_truth()
    assert truth is not None
    truth = truth[: len(estimated)]
    drift = segment_drift_pct(estimated, truth)
    return {
        "ate_rmse_m": round(trajectory_errors(estimated, truth).ate_rmse_m, 4),
        "drift_pct": None if drift is None else round(drift, 4),
        "driven_m": round(float(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum()), 1),
    }


def _recording_mb(source: Source) -> float:
    """The recording as JPEG and lossless PNG depth, 10^6 bytes, from frames evenly along it."""
    indices = np.unique(np.linspace(0, len(source) - 1, min(len(source), _SAMPLED_FRAMES)).astype(int))
    total = 0
    for index in indices.tolist():
        frame = source.frame(index)
        bgr = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR)
        total += len(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1])
        total += len(cv2.imencode(".png", frame.depth)[1])
    return 1e-6 * total * len(source) / len(indices)
