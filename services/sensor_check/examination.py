"""Gathers what frames of a recording show, and says what is wrong with them."""

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.geometry import se3
from vtslam.common.geometry.camera import Camera
from vtslam.services.sensor_check.edges import EdgeEvidence
from vtslam.services.sensor_check.findings import CheckFinding, judged
from vtslam.services.sensor_check.motion import (
    depth_scale_error,
    focal_lengths_swapped,
    tracked_corners,
    unexplained_px,
    with_depth,
)

NEIGHBOURS = 4  # frames before and after the middle one of a burst
BURST = 2 * NEIGHBOURS + 1
_BURSTS = 16
_FRAMES = 400  # that are looked at, at most
_REDUCED_WIDTH = 400  # images are reduced by a whole number to at most this
_BLANK_LEVELS = 3.0  # standard deviation of gray, 0..255
_BLANK_DEPTH_SHARE = 0.01


@dataclass(slots=True)
class Evidence:
    """What the frames looked at have shown.

    Attributes:
        camera: Intrinsics of the frames.
        reduction: Pixels of the frames per pixel of the reduced images.
        edges: Agreement of colour and depth.
        frames: Frames looked at.
        blank_color, blank_depth: Those that show nothing.
        pairs: Successive frames looked at that both show something.
        frozen_color, frozen_depth: Frames whose colour or depth is that of the frame before, to the byte.
        flow_share: Frame and median motion of its corners since the frame before, over the width.
        followed_share: Frame and share of the corners found again.
        depth_middle_m, depth_far_m: Median and 95th percentile of depth of each frame that has it.
        scale_errors: Depth over what true poses make of it.
        unexplained_px: Corners' motion that the camera does not explain, with its focal lengths as they are, and
            exchanged.
    """

    camera: Camera
    reduction: int
    edges: EdgeEvidence = field(default_factory=lambda: EdgeEvidence(NEIGHBOURS))
    frames: int = 0
    blank_color: list[int] = field(default_factory=list)
    blank_depth: list[int] = field(default_factory=list)
    pairs: int = 0
    frozen_color: list[int] = field(default_factory=list)
    frozen_depth: list[int] = field(default_factory=list)
    flow_share: list[tuple[int, float]] = field(default_factory=list)
    followed_share: list[tuple[int, float]] = field(default_factory=list)
    depth_middle_m: list[float] = field(default_factory=list)
    depth_far_m: list[float] = field(default_factory=list)
    scale_errors: list[float] = field(default_factory=list)
    unexplained_px: list[tuple[float, float]] = field(default_factory=list)


@dataclass(frozen=True, slots=True, kw_only=True)
class Looks:
    """Which frames of a recording are looked at.

    Attributes:
        frames: All of them, in order: the first ones, and others spread over the recording; every one of a short one.
        ends: Those that end a burst, `BURST` successive frames of `frames` that are looked at thoroughly.
    """

    frames: list[int]
    ends: frozenset[int]


def planned_looks(num_frames: int) -> Looks:
    """What to look at of a recording of ``num_frames`` frames, at least one."""
    length = min(BURST, num_frames)
    starts = np.linspace(0, num_frames - length, min(_BURSTS, -(-num_frames // BURST))).astype(int)
    frames = {int(start) + step for start in starts for step in range(length)}
    if num_frames <= _FRAMES:
        frames = set(range(num_frames))
    else:
        glances = np.linspace(0, num_frames - 2, (_FRAMES - len(frames)) // 2).astype(int)
        frames.update(int(frame) + step for frame in glances for step in (0, 1))
    return Looks(frames=sorted(frames), ends=frozenset(int(start) + length - 1 for start in starts))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Seen:
    """A frame, its reduced images, and whether it shows anything."""

    frame: Frame
    gray: npt.NDArray[np.uint8]
    depth_m: npt.NDArray[np.float32]
    shown: bool


def examine(
    frames: Iterable[Frame], looks: Looks, *, family: str, truth: npt.NDArray[np.float64] | None
) -> list[CheckFinding]:
    """What is wrong with a recording, and what is not.

    Args:
        frames: Those of ``looks.frames``.
        looks: See `planned_looks`.
        family: Its kind (`vtslam.common.preset_loading.FAMILIES`), for what depths are usual.
        truth: True poses ``T_world_camera`` float64 [F,4,4] by frame id, NaN where not known; None if nowhere.
    """
    evidence: Evidence | None = None
    window: deque[_Seen] = deque(maxlen=BURST)
    for frame in frames:
        if evidence is None:
            evidence = Evidence(camera=frame.camera, reduction=-(-frame.camera.width // _REDUCED_WIDTH))
        before = window[-1] if window else None
        window.append(_seen(frame, evidence))
        if before is not None and before.frame.frame_id + 1 == frame.frame_id and before.shown and window[-1].shown:
            _look_for_frozen(before.frame, frame, evidence)
        if frame.frame_id in looks.ends:
            _look_at_burst(list(window), evidence, truth)
    assert evidence is not None, "no frame"
    return judged(evidence, family=family)


def _look_at_burst(burst: Sequence[_Seen], evidence: Evidence, truth: npt.NDArray[np.float64] | None) -> None:
    for first, second in pairwise(burst):
        if first.shown and second.shown:
            _look_at_motion(second.frame.frame_id, first.gray, second.gray, evidence)
    middle, last = len(burst) // 2, len(burst) - 1
    if all(seen.shown for seen in burst):
        evidence.edges.add([seen.gray for seen in burst], [seen.depth_m for seen in burst], middle)
    for first_at, second_at in ((0, middle), (middle, last), (0, last)):
        if second_at > first_at and burst[first_at].shown and burst[second_at].shown:
            _look_at_geometry(burst[first_at], burst[second_at], evidence, truth)


def _seen(frame: Frame, evidence: Evidence) -> _Seen:
    """Note whether a frame shows anything, and how far away that is."""
    gray = _reduced_gray(frame, evidence.reduction)
    evidence.frames += 1
    known = frame.depth[frame.depth > 0]
    blank_color = float(gray.std()) < _BLANK_LEVELS
    blank_depth = known.size < _BLANK_DEPTH_SHARE * frame.depth.size
    evidence.blank_color += [frame.frame_id] if blank_color else []
    evidence.blank_depth += [frame.frame_id] if blank_depth else []
    if not blank_depth:
        middle, far = np.percentile(known[::7], [50, 95]) * frame.depth_scale_m
        evidence.depth_middle_m.append(float(middle))
        evidence.depth_far_m.append(float(far))
    depth_m = _reduced_depth(frame, evidence.reduction)
    return _Seen(frame=frame, gray=gray, depth_m=depth_m, shown=not (blank_color or blank_depth))


def _reduced_gray(frame: Frame, reduction: int) -> npt.NDArray[np.uint8]:
    gray = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
    height, width = gray.shape[0] // reduction, gray.shape[1] // reduction
    whole = gray[: height * reduction, : width * reduction]
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def _reduced_depth(frame: Frame, reduction: int) -> npt.NDArray[np.float32]:
    height, width = frame.depth.shape[0] // reduction, frame.depth.shape[1] // reduction
    chosen = frame.depth[reduction // 2 :: reduction, reduction // 2 :: reduction][:height, :width]
    return chosen.astype(np.float32) * np.float32(frame.depth_scale_m)


def _look_for_frozen(first: Frame, second: Frame, evidence: Evidence) -> None:
    evidence.pairs += 1
    if np.array_equal(first.rgb, second.rgb):
        evidence.frozen_color.append(second.frame_id)
    if np.array_equal(first.depth, second.depth):
        evidence.frozen_depth.append(second.frame_id)


def _look_at_motion(
    frame_id: int, first: npt.NDArray[np.uint8], second: npt.NDArray[np.uint8], evidence: Evidence
) -> None:
    tracks = tracked_corners(first, second)
    if np.isnan(tracks.followed_share):
        return
    evidence.flow_share.append((frame_id, tracks.flow_px / first.shape[1]))
    evidence.followed_share.append((frame_id, tracks.followed_share))


def _look_at_geometry(first: _Seen, second: _Seen, evidence: Evidence, truth: npt.NDArray[np.float64] | None) -> None:
    first_px, second_px, z_m = with_depth(tracked_corners(first.gray, second.gray), first.depth_m)
    camera = _reduced_camera(evidence.camera, evidence.reduction)
    if abs(camera.fx / camera.fy - 1.0) > 0.03:
        found = [unexplained_px(first_px, second_px, z_m, each) for each in (camera, focal_lengths_swapped(camera))]
        if found[0] is not None and found[1] is not None:
            evidence.unexplained_px.append((found[0], found[1]))
    ids = (first.frame.frame_id, second.frame.frame_id)
    if truth is not None and np.isfinite(truth[list(ids)]).all():
        T_second_first = se3.inverse(truth[ids[1]]) @ truth[ids[0]]
        error = depth_scale_error(first_px, second_px, z_m, camera, T_second_first)
        evidence.scale_errors += [] if error is None else [error]


def _reduced_camera(camera: Camera, reduction: int) -> Camera:
    """The camera of the reduced images, which leave out what is not a whole reduced pixel on the right and below."""
    width, height = camera.width // reduction, camera.height // reduction
    return replace(camera, width=width * reduction, height=height * reduction).resized(width, height)
