"""The viewer's core: frames, sections and what services say become parts to show, within stated limits."""

from collections.abc import Iterable, Mapping, Set
from dataclasses import dataclass
from enum import Enum

import cv2
import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.metrics_images import psnr_db
from vtslam.common.metrics_trajectory import aligning_motion
from vtslam.common.section import Section
from vtslam.common.splat.engine import Rendering
from vtslam.services.frame_facts import FrameFacts
from vtslam.services.viewer import names
from vtslam.services.viewer.parts import (
    Color,
    DepthPicture,
    Figure,
    Frustum,
    Gaussians,
    Gone,
    Line,
    Part,
    Picture,
    Points,
    Tint,
    Word,
)
from vtslam.services.viewer.sampling import kept_rows, thinned_line

Poses = npt.NDArray[np.float64]  # [F,4,4], T_world_camera

ERROR_GAIN = 5.0  # of the picture of residuals
_MAX_WIDTH_PX = 640  # of pictures
_MAX_LINE_POINTS = 1000  # of the true path
_ALIGNED_FROM = 10  # frames; fewer are set on the first one
_STATE_SHARE = 10  # of the Gaussians of a section, one in so many shows its state
_SPLATS_SHARE = 5  # the first so-manieth of all Gaussians are sent as such, the others as points
_BUDGET_SHARE = 64  # no section gets more than one so-manieth of what is left

ESTIMATED, TRUE = (90, 160, 255), (80, 200, 100)  # colours of paths


class SectionState(Enum):
    """Where a section is, and the colour that says so."""

    ACTIVE = (255, 150, 40)
    RESIDENT = (70, 150, 255)
    ON_DISK = (150, 150, 150)

    @property
    def color(self) -> Color:
        """Its colour."""
        red, green, blue = self.value
        return red, green, blue


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """How much is sent at most.

    Attributes:
        section_gaussians: Gaussians of one section.
        gaussians: Of all finished sections together.
    """

    section_gaussians: int
    gaussians: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenFrame:
    """A committed frame.

    Attributes:
        frame: Its images.
        T_world_camera: float64 [4,4].
        rendering: Its section from there, as the frame's exposure shows it.
        facts: What is known of it.
    """

    frame: Frame
    T_world_camera: npt.NDArray[np.float64]
    rendering: Rendering
    facts: FrameFacts


class Scene:
    """Turns what there is into parts. Each finished section is sent once, thinned to what the limits leave for it.

    Args:
        limits: How much is sent.
        truth: float64 [F,4,4], true ``T_world_camera`` by frame, NaN where it is not known; None if nowhere.

    Attributes:
        gaussians_sent: Of finished sections, up to now.
    """

    def __init__(self, limits: Limits, *, truth: Poses | None) -> None:
        self._limits, self._truth = limits, truth
        self.gaussians_sent = 0
        self._positions: dict[int, npt.NDArray[np.float64]] = {}  # by frame: where the camera was, m
        self._first_pose: tuple[int, npt.NDArray[np.float64]] | None = None  # of those whose true pose is known
        self._states: dict[int, SectionState] = {}

    # --- frames -----------------------------------------------------------------------------------------------------

    def frame(self, seen: SeenFrame) -> list[Part]:
        """The camera, its images beside what the map shows instead, and the frame's figures."""
        frame, rendered = seen.frame, np.clip(seen.rendering.rgb, 0.0, 1.0)
        residual = np.clip(ERROR_GAIN * np.abs(rendered - frame.rgb_float()), 0.0, 1.0)
        self._note_pose(frame.frame_id, seen.T_world_camera)
        return [
            Frustum(path=names.CAMERA, T_world_camera=seen.T_world_camera, camera=frame.camera),
            Picture(path=names.INPUT, rgb=_small(frame.rgb)),
            Picture(path=names.RENDERED, rgb=_small(_bytes(rendered))),
            Picture(path=names.RESIDUAL, rgb=_small(_bytes(residual))),
            DepthPicture(path=names.DEPTH, depth=_small_depth(frame.depth), depth_scale_m=frame.depth_scale_m),
            *self.figures(seen.facts),
            *_quality(seen),
            *self._true_path(frame.frame_id),
        ]

    def figures(self, facts: FrameFacts) -> list[Part]:
        """What a frame took and how well it went."""
        values = {
            "latency/track_ms": 1e3 * facts.track_s,
            "latency/map_ms": 1e3 * facts.map_s,
            "latency/total_ms": 1e3 * facts.total_s,
            "loss/color": facts.color_loss,
            "loss/depth_m": facts.depth_loss_m,
            "loss/map": facts.map_loss,
        }
        parts: list[Part] = [Figure(path=f"{names.FIGURES}/{name}", value=value) for name, value in values.items()]
        if facts.state in ("weak", "lost"):
            parts.append(Word(path=names.EVENTS, text=f"frame {facts.frame_id}: tracking {facts.state}"))
        return parts

    def _note_pose(self, frame_id: int, T_world_camera: npt.NDArray[np.float64]) -> None:
        self._positions[frame_id] = T_world_camera[:3, 3].copy()
        if self._first_pose is None and self._true_pose(frame_id) is not None:
            self._first_pose = frame_id, T_world_camera.copy()

    def _true_pose(self, frame_id: int) -> npt.NDArray[np.float64] | None:
        if self._truth is None or frame_id >= len(self._truth) or not np.isfinite(self._truth[frame_id]).all():
            return None
        return np.asarray(self._truth[frame_id])

    def _true_path(self, frame_id: int) -> list[Part]:
        """The true path up to a frame, laid on the estimated one as well as a rigid motion can, and the error there."""
        if self._truth is None or self._first_pose is None:
            return []
        T = self._T_estimate_truth()
        true_m = self._truth[: frame_id + 1, :3, 3]
        path_m = thinned_line(true_m[np.isfinite(true_m).all(axis=1)], _MAX_LINE_POINTS) @ T[:3, :3].T + T[:3, 3]
        parts: list[Part] = [Line(path=names.TRUE_PATH, points_m=path_m.astype(np.float32), color=TRUE)]
        true_pose = self._true_pose(frame_id)
        if true_pose is not None:
            off_m = float(np.linalg.norm((T @ true_pose)[:3, 3] - self._positions[frame_id]))
            parts.append(Figure(path=f"{names.FIGURES}/error/position_mm", value=1e3 * off_m))
        return parts

    def _T_estimate_truth(self) -> npt.NDArray[np.float64]:
        assert self._truth is not None
        assert self._first_pose is not None
        ids = np.array([i for i in self._positions if i < len(self._truth)])
        if len(ids) >= _ALIGNED_FROM:
            return aligning_motion(self._truth[ids, :3, 3], np.stack([self._positions[int(i)] for i in ids]))
        first, T_world_camera = self._first_pose
        return np.asarray(T_world_camera @ np.linalg.inv(self._truth[first]))

    # --- sections ---------------------------------------------------------------------------------------------------

    def growing(self, section: Section) -> list[Part]:
        """The section that is being mapped, with positions, to half of what a finished one may have."""
        limit = self._limits.section_gaussians // 2
        few = self._thinned("", section, limit // _STATE_SHARE, lasting=False, as_points=True)
        return [
            self._thinned(names.ACTIVE_MAP, section, limit, lasting=False),
            Line(path=names.ACTIVE_PATH, points_m=self._path_of(section), color=SectionState.ACTIVE.color),
            Points(path=names.ACTIVE_STATE, points_m=_centers_m(few)),
            Tint(path=names.ACTIVE_STATE, color=SectionState.ACTIVE.color),
        ]

    def finished(self, section: Section) -> list[Part]:
        """A finished section, with positions; to be called once for each."""
        name = names.of_section(section.section_id)
        limit = min(self._limits.section_gaussians, (self._limits.gaussians - self.gaussians_sent) // _BUDGET_SHARE)
        as_points = _SPLATS_SHARE * (self.gaussians_sent + limit) > self._limits.gaussians
        shown = self._thinned(f"{names.MAP}/{name}", section, limit, lasting=True, as_points=as_points)
        few = self._thinned("", section, limit // _STATE_SHARE, lasting=True, as_points=True)
        self.gaussians_sent += min(limit, section.gaussians.count)
        path_m = self._path_of(section)
        return [
            shown,
            Line(path=f"{names.PATHS}/{name}", points_m=path_m, color=ESTIMATED, lasting=True),
            Points(path=f"{names.STATES}/{name}", points_m=_centers_m(few), lasting=True),
        ]

    def nothing_grows(self) -> list[Part]:
        """No section is being mapped."""
        return [Gone(path=path) for path in (names.ACTIVE_MAP, names.ACTIVE_PATH, names.ACTIVE_STATE)]

    def states(self, *, active: int | None, resident: Set[int], known: Iterable[int]) -> list[Part]:
        """The sections whose state has changed, in its colour; ``known`` are those that were sent as finished."""
        now = {each: SectionState.RESIDENT if each in resident else SectionState.ON_DISK for each in known}
        changed = {each: state for each, state in now.items() if self._states.get(each) is not state}
        self._states = now
        counts = {state: sum(each is state for each in now.values()) for state in SectionState}
        counts[SectionState.ACTIVE] = int(active is not None)
        return [
            *(
                Tint(path=f"{names.STATES}/{names.of_section(each)}", color=state.color, lasting=True)
                for each, state in sorted(changed.items())
            ),
            *(
                Figure(path=f"{names.FIGURES}/sections/{state.name.lower()}", value=count)
                for state, count in counts.items()
            ),
        ]

    def _path_of(self, section: Section) -> npt.NDArray[np.float32]:
        poses = [section.T_world_frame(row) for row in range(len(section.frames))]
        for frame, pose in zip(section.frames, poses, strict=True):
            self._note_pose(frame.frame_id, pose)
        return np.stack([pose[:3, 3] for pose in poses]).astype(np.float32)

    def _thinned(
        self, path: str, section: Section, limit: int, *, lasting: bool, as_points: bool = False
    ) -> Gaussians | Points:
        """At most ``limit`` Gaussians of a section; those left are larger, so that surfaces stay closed."""
        gaussians = section.gaussians
        rows = kept_rows(gaussians.count, limit, key=section.section_id)
        T = section.T_world_section
        centers_m = (section.means_m[rows] @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
        rgb = _bytes(np.clip(gaussians.colors[rows], 0.0, 1.0))
        if as_points:
            return Points(path=path, points_m=centers_m, colors=rgb, lasting=lasting)
        larger = np.sqrt(max(gaussians.count, 1) / max(len(rows), 1))
        opacity = 1.0 / (1.0 + np.exp(-gaussians.opacity_logits[rows]))
        return Gaussians(
            path=path,
            centers_m=centers_m,
            sigmas_m=(np.exp(gaussians.log_radii[rows]) * larger).astype(np.float32),
            colors=np.concatenate([rgb, _bytes(opacity)[:, None]], axis=1),
            lasting=lasting,
        )

    # --- services ---------------------------------------------------------------------------------------------------

    def services(self, counters: Mapping[str, Mapping[str, int]], memory_mb: Mapping[str, float]) -> list[Part]:
        """What services have dropped or lost, by service and name, and what takes how much memory."""
        lost = {
            f"drops/{service}/{_word(name)}": float(count)
            for service, counted in sorted(counters.items())
            for name, count in sorted(counted.items())
            if any(word in name for word in ("dropped", "missed", "refused", "deaths", "hangs"))
        }
        taken = {f"memory/{name}_mb": value for name, value in sorted(memory_mb.items())}
        return [Figure(path=f"{names.FIGURES}/{name}", value=value) for name, value in {**lost, **taken}.items()]


def _centers_m(shown: Gaussians | Points) -> npt.NDArray[np.float32]:
    return shown.points_m if isinstance(shown, Points) else shown.centers_m


def _quality(seen: SeenFrame) -> list[Part]:
    rendered = np.clip(seen.rendering.rgb, 0.0, 1.0)
    found = psnr_db(rendered, seen.frame.rgb_float())
    return [] if found is None else [Figure(path=f"{names.FIGURES}/quality/psnr_full_db", value=found)]


def _word(name: str) -> str:
    return name.replace(".", "_")


def _bytes(values: npt.NDArray[np.floating]) -> npt.NDArray[np.uint8]:
    return np.asarray(values * 255.0 + 0.5, np.uint8)


def _small(rgb: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    height, width = rgb.shape[:2]
    if width <= _MAX_WIDTH_PX:
        return rgb
    size = (_MAX_WIDTH_PX, max(round(height * _MAX_WIDTH_PX / width), 1))
    return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)


def _small_depth(depth: npt.NDArray[np.uint16]) -> npt.NDArray[np.uint16]:
    step = -(-depth.shape[1] // _MAX_WIDTH_PX)
    return depth[::step, ::step]
