"""Which earlier sections see what a head frame sees (paper, section 3.3; docs/method.md, 2.4)."""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.geometry import se3
from vtslam.common.geometry.camera import Camera
from vtslam.common.settings import OverlapSettings


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CandidateView:
    """A frame that answers overlap questions.

    Attributes:
        section_id: The section it belongs to.
        frame_id: Its place in the stream.
        is_head: Whether it is its section's head.
        T_world_camera: float64 [4,4].
        depth: uint16 [H,W], observed.
        depth_scale_m: Metres per unit.
        camera: Intrinsics.
    """

    section_id: int
    frame_id: int
    is_head: bool
    T_world_camera: npt.NDArray[np.float64]
    depth: npt.NDArray[np.uint16]
    depth_scale_m: float
    camera: Camera


def world_points_m(
    frame: Frame, T_world_camera: npt.NDArray[np.float64], mask: npt.NDArray[np.bool_]
) -> npt.NDArray[np.float64]:
    """Back-projected pixels of ``mask`` in row order, float64 [N,3], world."""
    points = frame.camera.back_projected(frame.depth_m())[mask].astype(np.float64)
    return points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]


def seen_by_view(
    points_world_m: npt.NDArray[np.float64],
    *,
    T_world_view: npt.NDArray[np.float64],
    view_depth: npt.NDArray[np.uint16],
    depth_scale_m: float,
    camera: Camera,
    tolerance: float,
    border_px: float,
) -> npt.NDArray[np.bool_]:
    """Which points a view saw: inside its image, and as deep as it measured there.

    Args:
        points_world_m: float64 [N,3], world.
        T_world_view: float64 [4,4], the view's pose.
        view_depth: uint16 [H,W], what the view measured (bilinear between its pixels; outside the image is 0).
        depth_scale_m: Metres per unit of it.
        camera: The view's intrinsics.
        tolerance: A point counts if |measured - depth| < tolerance * min(measured, depth).
        border_px: Image border that does not count.

    Returns:
        bool [N].
    """
    columns = np.ascontiguousarray(points_world_m.T)
    return seen_columns(columns, T_world_view, view_depth, depth_scale_m, camera, tolerance, border_px)


def seen_columns(
    points_world_m: npt.NDArray[np.float64],
    T_world_view: npt.NDArray[np.float64],
    view_depth: npt.NDArray[np.uint16 | np.float32],
    depth_scale_m: float,
    camera: Camera,
    tolerance: float,
    border_px: float,
) -> npt.NDArray[np.bool_]:
    """As `seen_by_view`, of points float64 [3,N]; of each as if it were asked about alone."""
    T = se3.inverse(T_world_view)
    p = points_world_m
    # Written out: a matrix product may round differently with more points, or fewer.
    x, y, depth_m = (row[0] * p[0] + row[1] * p[1] + row[2] * p[2] + row[3] for row in T[:3])
    in_front = depth_m > 0.0
    z = np.where(in_front, depth_m, 1.0)
    u = camera.fx * x / z + camera.cx
    v = camera.fy * y / z + camera.cy
    inside = in_front & (u >= border_px) & (v >= border_px)
    inside &= (u < camera.width - border_px) & (v < camera.height - border_px)
    out = np.zeros(inside.size, np.bool_)
    rows = np.flatnonzero(inside)
    if rows.size:
        z = z[rows]
        measured = _bilinear(view_depth, u[rows] - 0.5, v[rows] - 0.5) * depth_scale_m
        out[rows] = np.abs(measured - z) < tolerance * np.minimum(measured, z)
    return out


def _bilinear(
    image: npt.NDArray[np.uint16 | np.float32], x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Samples [N] of an image at integer-centred coordinates; zeros outside."""
    # cv2.remap takes maps of at most 32767 rows: shape them as a wide image.
    columns = 1024
    rows = -(-x.size // columns)
    flat = np.full((2, rows * columns), -10.0, np.float32)
    flat[0, : x.size], flat[1, : x.size] = x, y
    maps = flat.reshape(2, rows, columns)
    sampled = cv2.remap(
        image.astype(np.float32, copy=False), maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
    )
    return np.asarray(sampled, np.float64).reshape(-1)[: x.size]


def overlap_shares(
    points_world_m: npt.NDArray[np.float64], views: list[CandidateView], settings: OverlapSettings
) -> npt.NDArray[np.float64]:
    """Share of the points that each view saw, float64 [V]."""
    if points_world_m.shape[0] == 0:
        return np.zeros(len(views))
    return np.array(
        [
            seen_by_view(
                points_world_m,
                T_world_view=view.T_world_camera,
                view_depth=view.depth,
                depth_scale_m=view.depth_scale_m,
                camera=view.camera,
                tolerance=settings.depth_consistency,
                border_px=settings.border_share * view.camera.width,
            ).mean()
            for view in views
        ]
    )


def sections_to_pretrack(
    shares: npt.NDArray[np.float64], views: list[CandidateView], *, head_section_id: int, settings: OverlapSettings
) -> list[int]:
    """The earliest sections that see enough of a head frame (gamma decays while too few pass).

    Args:
        shares: float64 [V], share of the head's points each view saw.
        views: The candidate views, in order of time.
        head_section_id: Section that the head opens.
        settings: Thresholds.

    Returns:
        Section ids in order of time: at most ``max_sections``, one while the head opens section 1 or 2; the previous
        section if none overlaps.
    """
    if not views:
        return []
    wanted = settings.max_sections if head_section_id > 2 else 1
    wanted_now = min(wanted, len({view.section_id for view in views}))
    gamma = settings.gamma
    while True:
        passing = sorted({view.section_id for share, view in zip(shares, views, strict=True) if share > gamma})
        if len(passing) >= wanted_now or gamma * settings.gamma_decay < settings.gamma_floor:
            break
        gamma *= settings.gamma_decay
    return passing[:wanted] if passing else [views[-1].section_id]


def largest_overlap(
    shares: npt.NDArray[np.float64], views: list[CandidateView], *, excluded_section_id: int
) -> int | None:
    """The section with the view that sees most, ``excluded_section_id`` apart; None if nothing overlaps (Eq. 2)."""
    best: tuple[float, int] | None = None
    for share, view in zip(shares, views, strict=True):
        if view.section_id != excluded_section_id and share > 0.0 and (best is None or share > best[0]):
            best = (float(share), view.section_id)
    return None if best is None else best[1]
