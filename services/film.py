"""A film of how a run's map grew: the map from outside, and beside it what the camera saw and what the map shows."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from vtslam.common.geometry.camera import Camera
from vtslam.common.section import Section
from vtslam.common.splat.engine import Splats
from vtslam.services.engines import make_engine
from vtslam.services.film_camera import Onlooker, onlooker, project_px
from vtslam.services.recorded_run import RecordedRun
from vtslam.services.report_pictures import Picture, beside, labelled, stacked
from vtslam.services.viewer.sampling import kept_rows
from vtslam.storage.atomic import replace_file
from vtslam.storage.errors import RunFolderError, WriteFailed

MOST_PICTURES = 75
_MOST_GAUSSIANS = 400_000
_MAP_SIZE, _TILE_WIDTH = (448, 336), 208
_PICTURE_MS, _LAST_PICTURE_MS = 90, 2500
_QUALITY = 55
_PATH, _CAMERA = (255, 120, 40), (0, 110, 255)  # blue first
_FRUSTUM_SHARE = 0.06  # of the map's radius


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Map:
    """All Gaussians of a run, relative to ``center_m``, thinned.

    Attributes:
        center_m: float64 [3], in the world.
        splats: The Gaussians.
        seen_along: float32 [N,3], from the camera that they were seen by to themselves, m.
        frame_id: int64 [N], when they were seen.
    """

    center_m: npt.NDArray[np.float64]
    splats: Splats
    seen_along: npt.NDArray[np.float32]
    frame_id: npt.NDArray[np.int64]


def write_film(path: Path, run: RecordedRun, *, on_picture: Callable[[], None] = lambda: None) -> None:
    """Draw the film of a run.

    Args:
        path: A name that ends in .webp or .gif.
        run: The run.
        on_picture: Called after each picture.

    Raises:
        WriteFailed: The file cannot be written, or has another name.
        SourceError, StorageError: A frame or section cannot be read.
    """
    if path.suffix not in (".webp", ".gif"):
        raise WriteFailed(f"{path}: expected a name that ends in .webp or .gif")
    frames = run.frames_in_sections()
    if not frames:
        raise RunFolderError(f"{run.folder.path}: expected a finished section to film, found none")
    shown = sorted({frames[int(each)] for each in np.linspace(0, len(frames) - 1, min(MOST_PICTURES, len(frames)))})
    last = frames[-1]
    splat_map, pictures = _map_of(run), []
    view = onlooker(splat_map.splats.means_m, run.poses, splat_map.center_m, _MAP_SIZE)
    for frame_id in shown:
        pictures.append(_picture(run, splat_map, view, frame_id, turn=frame_id / max(last, 1)))
        on_picture()
    replace_file(path, [_encoded(path.suffix, pictures)])


def _map_of(run: RecordedRun) -> _Map:
    ids = run.section_ids()
    center_m = run.poses[:, :3, 3].mean(axis=0)
    limit = _MOST_GAUSSIANS // max(len(ids), 1)
    parts = [_part_of(run.section(section_id), center_m, limit) for section_id in ids]
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    means, colors, radii, opacities, seen_along, frame_id = columns
    splats = Splats(means_m=means, colors=colors, log_radii=radii, opacity_logits=opacities)
    return _Map(center_m=center_m, splats=splats, seen_along=seen_along, frame_id=frame_id)


def _part_of(section: Section, center_m: npt.NDArray[np.float64], limit: int) -> tuple[npt.NDArray[np.generic], ...]:
    gaussians = section.gaussians
    rows = kept_rows(gaussians.count, limit, key=section.section_id)
    larger = 0.5 * np.log(max(gaussians.count, 1) / max(len(rows), 1))
    T = section.T_world_section
    means_m = section.means_m[rows] @ T[:3, :3].T + T[:3, 3]
    cameras_m = np.stack([section.T_world_frame(row)[:3, 3] for row in range(len(section.frames))])
    frame_ids = np.array([frame.frame_id for frame in section.frames])
    of_row = gaussians.frame_index[rows]
    return (
        (means_m - center_m).astype(np.float32),
        gaussians.colors[rows],
        (gaussians.log_radii[rows] + larger).astype(np.float32),
        gaussians.opacity_logits[rows],
        (means_m - cameras_m[of_row]).astype(np.float32),
        frame_ids[of_row],
    )


def _picture(run: RecordedRun, splat_map: _Map, view: Onlooker, frame_id: int, *, turn: float) -> Picture:
    section_id = run.rows[frame_id]["section_id"]
    rendering = run.render(run.section(section_id), frame_id)
    size = _TILE_WIDTH, round(_TILE_WIDTH * rendering.rgb.shape[0] / rendering.rgb.shape[1])
    tiles = [
        labelled(_resized(run.frame(frame_id).rgb[..., ::-1], size), f"frame {frame_id}: input"),
        labelled(_resized(_bytes(rendering.rgb)[..., ::-1], size), "rendered from the map"),
    ]
    from_outside, count = _from_outside(run, splat_map, view, frame_id, turn)
    text = f"map: section {section_id}, {count:,} Gaussians of {splat_map.frame_id.size:,} drawn"
    column, large = stacked(tiles), labelled(from_outside, text)
    height = max(column.shape[0], large.shape[0])
    return beside([_padded(large, height), _padded(column, height)])


def _from_outside(run: RecordedRun, splat_map: _Map, view: Onlooker, frame_id: int, turn: float) -> tuple[Picture, int]:
    """The map up to a frame, without surfaces that face away: those were seen from their other side."""
    T_camera_map, camera = view.T_camera_map(turn), view.camera
    viewer_m = -T_camera_map[:3, :3].T @ T_camera_map[:3, 3]
    splats = splat_map.splats
    towards = ((splats.means_m - viewer_m.astype(np.float32)) * splat_map.seen_along).sum(axis=1) > 0.0
    there = splat_map.frame_id <= frame_id
    rows = np.flatnonzero(there & towards)
    shown = Splats(
        means_m=splats.means_m[rows],
        colors=splats.colors[rows],
        log_radii=splats.log_radii[rows],
        opacity_logits=splats.opacity_logits[rows],
    )
    rendering = make_engine(run.settings.splat).render(shown, camera, T_camera_map)
    picture = _bytes(rendering.rgb + (1.0 - rendering.alpha[..., None]))[..., ::-1].copy()
    poses = run.poses[: frame_id + 1].copy()
    poses[:, :3, 3] -= splat_map.center_m
    _draw_path(picture, poses, camera, T_camera_map, view.radius_m)
    return picture, int(there.sum())


def _draw_path(
    picture: Picture,
    poses: npt.NDArray[np.float64],
    camera: Camera,
    T_camera_map: npt.NDArray[np.float64],
    radius: float,
) -> None:
    """The camera's path, and its frustum at the end."""
    path_px = project_px(poses[:, :3, 3], camera, T_camera_map)
    cv2.polylines(picture, [path_px.round().astype(np.int32)], False, _PATH, 2, cv2.LINE_AA)
    x, y, z = 0.6, 0.45, 0.8
    corners = _FRUSTUM_SHARE * radius * np.array([[0, 0, 0], [-x, -y, z], [x, -y, z], [x, y, z], [-x, y, z]])
    at_m = corners @ poses[-1, :3, :3].T + poses[-1, :3, 3]
    tip, *rim = project_px(at_m, camera, T_camera_map).round().astype(np.int32).tolist()
    for index, corner in enumerate(rim):
        cv2.line(picture, tip, corner, _CAMERA, 1, cv2.LINE_AA)
        cv2.line(picture, corner, rim[(index + 1) % len(rim)], _CAMERA, 1, cv2.LINE_AA)


def _encoded(suffix: str, pictures: Sequence[Picture]) -> bytes:
    animation = cv2.Animation()
    animation.frames = list(pictures)
    durations = np.full(len(pictures), _PICTURE_MS, np.int32)
    durations[-1] = _LAST_PICTURE_MS
    animation.durations = durations.tolist()
    _, data = cv2.imencodeanimation(
        suffix, animation, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY] if suffix == ".webp" else []
    )
    return data.tobytes()


def _resized(picture: npt.NDArray[np.uint8], size: tuple[int, int]) -> Picture:
    return np.asarray(cv2.resize(np.ascontiguousarray(picture), size, interpolation=cv2.INTER_AREA), np.uint8)


def _padded(picture: Picture, height: int) -> Picture:
    more = height - picture.shape[0]
    return np.asarray(cv2.copyMakeBorder(picture, 0, more, 0, 0, cv2.BORDER_CONSTANT, value=(255, 255, 255)), np.uint8)


def _bytes(values: npt.NDArray[np.floating]) -> npt.NDArray[np.uint8]:
    return np.asarray(np.clip(values, 0.0, 1.0) * 255.0 + 0.5, np.uint8)
