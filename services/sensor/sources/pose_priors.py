"""Frames with poses from elsewhere: a trajectory file, or a recording's true poses made worse on purpose."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from vtslam.common.external_pose import ExternalPose
from vtslam.common.frame import Frame
from vtslam.common.geometry import se3
from vtslam.common.trajectory_io import TrajectoryError, read_trajectory
from vtslam.services.sensor.sources.base import Source, SourceAround, SourceError, with_option

OPTIONS = ("poses", "poses_sigma", "prior")
_DEFAULT_SIGMA = "0.05,1"
_SAME_TIME_NS = 10_000_000
_NOISE_KEY = 0x7072696F72  # of the random numbers of priors

PoseAt = Callable[[int], npt.NDArray[np.float64] | None]  # T_world_camera [4,4] at a time in ns
PriorOf = Callable[[Frame, int], ExternalPose | None]  # a frame and its index


@runtime_checkable
class RecordsPoses(Protocol):
    """A recording with poses in it."""

    def pose_topics(self) -> list[str]:
        """Where they are."""
        ...

    def poses(self, topic: str) -> PoseAt | None:
        """Poses over time; None if there is no such topic. Raises SourceError if they are not the camera's."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _WithPriors(SourceAround):
    """A source whose frames have pose priors."""

    prior_of: PriorOf

    def frame(self, index: int) -> Frame:
        frame = self.inner.frame(index)
        return replace(frame, pose_prior=self.prior_of(frame, index))


def with_pose_priors(source: Source, options: dict[str, str], *, recording: Source | None = None) -> Source:
    """The source with the priors that options of its URI ask for.

    - ``poses=FILE``: the trajectory (TUM) of another sensor or program, each frame taking the pose within 10 ms of its
      time, if there is one; ``poses_sigma=M,DEG`` are its standard deviations per axis (default 0.05,1).
    - ``poses=TOPIC``: the same from transforms in the recording, interpolated.
    - ``prior=M,DEG``: the recording's true poses, with Gaussian errors of these standard deviations per axis, which
      are drawn by the number of the frame and therefore the same at each reading.

    Args:
        source: The source.
        options: Those of `OPTIONS` that were given, at least one.
        recording: The recording itself, if ``source`` is a changed form of it.

    Raises:
        SourceError: An option is malformed, the file cannot be read, or there are no true poses.
    """
    if "prior" in options:
        if len(options) > 1:
            raise SourceError("options of pose priors: expected prior, or poses and poses_sigma; found both")
        prior_of = _from_truth(source, _parsed_sigma("prior", options["prior"]))
    elif "poses" in options:
        options = {"poses_sigma": _DEFAULT_SIGMA, **options}
        sigma = _parsed_sigma("poses_sigma", options["poses_sigma"])
        pose_at = _recorded_poses(recording or source, options["poses"])
        if pose_at is None:
            options["poses"] = str(Path(options["poses"]).absolute())
            pose_at = _poses_of_file(Path(options["poses"]))
        prior_of = _from_poses(pose_at, sigma)
    else:
        raise SourceError("option poses_sigma: expected beside poses=FILE, found alone")
    uri = source.uri
    for key, value in options.items():
        uri = with_option(uri, key, value)
    return _WithPriors(inner=source, uri=uri, prior_of=prior_of)


def _from_truth(source: Source, sigma: npt.NDArray[np.float64]) -> PriorOf:
    truth = source.ground_truth()
    if truth is None:
        raise SourceError(f"{source.uri}: option prior needs true poses, and the recording has none")

    def prior_of(frame: Frame, index: int) -> ExternalPose | None:
        if not np.isfinite(truth[index]).all():
            return None
        rng = np.random.Generator(np.random.Philox(key=[_NOISE_KEY, index]))
        error = se3.exp(sigma * rng.standard_normal(6))
        T_world_camera = se3.orthonormalized(se3.inverse(error @ se3.inverse(truth[index])))
        return ExternalPose(T_world_camera=T_world_camera, covariance=np.diag(sigma**2))

    return prior_of


def _from_poses(pose_at: PoseAt, sigma: npt.NDArray[np.float64]) -> PriorOf:
    def prior_of(frame: Frame, index: int) -> ExternalPose | None:
        T_world_camera = pose_at(frame.capture_time_ns)
        if T_world_camera is None:
            return None
        return ExternalPose(T_world_camera=T_world_camera, covariance=np.diag(sigma**2))

    return prior_of


def _recorded_poses(source: Source, topic: str) -> PoseAt | None:
    """Poses by a topic of the recording; None if it has no such topic and there may be a file of that name."""
    if not isinstance(source, RecordsPoses):
        return None
    pose_at = source.poses(topic)
    if pose_at is None and not Path(topic).exists():
        known = ", ".join(source.pose_topics()) or "(the recording has none)"
        raise SourceError(f"{topic}: expected a readable trajectory or a topic of transforms {known}, found neither")
    return pose_at


def _poses_of_file(path: Path) -> PoseAt:
    try:
        trajectory = read_trajectory(path)
    except TrajectoryError as error:
        raise SourceError(str(error)) from error
    times_ns, poses = trajectory.capture_times_ns, trajectory.poses

    def pose_at(time_ns: int) -> npt.NDArray[np.float64] | None:
        place = int(np.searchsorted(times_ns, time_ns))
        near = [i for i in (place - 1, place) if 0 <= i < len(times_ns)]
        best = min(near, key=lambda i: abs(int(times_ns[i]) - time_ns), default=None)
        if best is None or abs(int(times_ns[best]) - time_ns) > _SAME_TIME_NS:
            return None
        return np.asarray(poses[best])

    return pose_at


def _parsed_sigma(option: str, text: str) -> npt.NDArray[np.float64]:
    """Standard deviations of a twist, float64 [6]: metres, then radians."""
    metres, comma, degrees = text.partition(",")
    try:
        sigma = float(metres), float(degrees)
    except ValueError:
        sigma = (np.nan, np.nan)
    if not comma or not np.isfinite(sigma).all() or min(sigma) < 0.0 or max(sigma) > 1e5:
        raise SourceError(f"option {option}: expected M,DEG, as in 0.3,0.5; found {text!r}")
    return np.array([sigma[0]] * 3 + [np.deg2rad(sigma[1])] * 3)
