"""``kitti:DIR``: a sequence of KITTI odometry, with depth from its stereo pairs or its laser scans.

``DIR/image_2`` and ``image_3`` (colour) or ``image_0`` and ``image_1`` (gray, shown as three equal channels) with
``%06d.png``, ``calib.txt`` (P0 to P3, and Tr for laser scans), ``times.txt`` (seconds; without it, 10 frames a
second), ``velodyne/%06d.bin`` where depth is taken from there, and poses of camera 0 in ``DIR/poses.txt`` or, as
published, ``DIR/../../poses/NAME.txt`` (optional).
"""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.geometry.camera import Camera
from vtslam.services.sensor.sources import kitti_depth, kitti_files
from vtslam.services.sensor.sources import recording_files as files
from vtslam.services.sensor.sources.base import SourceError, SourceUri
from vtslam.services.sensor.sources.image_files import image_size, read_color

DEPTH_SCALE_M = 1.0 / 256.0
DEPTHS = ("stereo", "lidar")
IMAGES = {"color": (2, 3), "gray": (0, 1)}

_FRAME_PERIOD_NS = 100_000_000  # 10 Hz
_MAX_DENSIFY_PX = 50


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Rig:
    """The cameras and the scanner, in the coordinates of rectified camera 0.

    Attributes:
        left: Projection float64 [3,4] of the left image, pixel centres at whole numbers.
        right: The right image's.
        T_camera_scan: float64 [4,4], scanner to camera 0; None where the calibration has none.
    """

    left: npt.NDArray[np.float64]
    right: npt.NDArray[np.float64]
    T_camera_scan: npt.NDArray[np.float64] | None

    @property
    def focal_px(self) -> float:
        return float(self.left[0, 0])

    @property
    def baseline_m(self) -> float:
        return float(self.left[0, 3] - self.right[0, 3]) / self.focal_px

    def T_camera0_left(self) -> npt.NDArray[np.float64]:
        """Left image's camera to camera 0, float64 [4,4]."""
        out = np.eye(4)
        out[:3, 3] = -np.linalg.solve(self.left[:, :3], self.left[:, 3])
        return out


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KittiSource:
    """A sequence of KITTI odometry (the `Source` protocol); made by :func:`open_kitti`.

    Attributes:
        uri, camera: As in `Source`.
        folder: The sequence's folder.
        left: Files of the left images.
        times_ns: int64 [F], capture times.
        depth: ``stereo`` or ``lidar``.
    """

    uri: str
    camera: Camera
    folder: Path
    left: list[Path]
    right_folder: Path
    times_ns: npt.NDArray[np.int64]
    poses: npt.NDArray[np.float64] | None
    depth: str
    densify_px: int
    rig: _Rig

    @property
    def family(self) -> str:
        """Settings family."""
        return "kitti"

    @property
    def depth_scale_m(self) -> float:
        """Metres per unit of depth."""
        return DEPTH_SCALE_M

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.left)

    def frame(self, index: int) -> Frame:
        """Frame ``index``, its depth computed anew.

        Raises:
            SourceError: A file is missing, damaged, of another kind, or of another size than the first image.
            IndexError: There is no such frame.
        """
        if not 0 <= index < len(self.left):
            raise IndexError(f"{self.uri}: frame {index} of {len(self.left)}")
        rgb = self._image(self.left[index])
        depth_m = self._stereo_m(index, rgb) if self.depth == "stereo" else self._lidar_m(index)
        return Frame(
            frame_id=index,
            capture_time_ns=int(self.times_ns[index]),
            rgb=rgb,
            depth=np.rint(depth_m / DEPTH_SCALE_M).astype(np.uint16),
            depth_scale_m=DEPTH_SCALE_M,
            camera=self.camera,
        )

    def ground_truth(self) -> npt.NDArray[np.float64] | None:
        """True poses ``T_world_camera`` float64 [F,4,4] of the left image's camera (a copy), or None."""
        return None if self.poses is None else self.poses.copy()

    def _image(self, path: Path) -> npt.NDArray[np.uint8]:
        rgb = read_color(path)
        height, width = rgb.shape[:2]
        if (width, height) != (self.camera.width, self.camera.height):
            raise SourceError(
                f"{path}: expected the size of the first image {self.camera.width}x{self.camera.height}, "
                f"found {width}x{height}"
            )
        return rgb

    def _stereo_m(self, index: int, left: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
        right = self._image(self.right_folder / self.left[index].name)
        pair = (np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8) for image in (left, right))
        return kitti_depth.stereo_depth_m(*pair, focal_px=self.rig.focal_px, baseline_m=self.rig.baseline_m)

    def _lidar_m(self, index: int) -> npt.NDArray[np.float32]:
        assert self.rig.T_camera_scan is not None
        return kitti_depth.projected_scan_m(
            kitti_depth.read_scan(self.folder / "velodyne" / f"{self.left[index].stem}.bin"),
            self.rig.T_camera_scan,
            self.rig.left,
            width=self.camera.width,
            height=self.camera.height,
            densify_px=self.densify_px,
        )


def open_kitti(uri: SourceUri) -> KittiSource:
    """Open a sequence.

    Options: ``depth=stereo|lidar``, ``images=color|gray`` (default: colour where it is there) and ``densify`` (pixels
    around a laser point that take its depth where they have none).

    Raises:
        SourceError: Something is missing, damaged or inconsistent; image contents are checked when read.
    """
    files.check_options(uri, ("depth", "densify", "images"))
    folder = files.folder_of(uri)
    depth = _choice(uri, "depth", DEPTHS, "stereo")
    images = _choice(uri, "images", tuple(IMAGES), "color" if (folder / "image_2").is_dir() else "gray")
    left_number, right_number = IMAGES[images]
    left = _images(folder / f"image_{left_number}")
    rig = _rig(folder / "calib.txt", left_number, right_number, with_scanner=depth == "lidar")
    right_folder = folder / f"image_{right_number}"
    if depth == "stereo" and not right_folder.is_dir():
        raise SourceError(f"{right_folder}: expected the right images for depth=stereo, found none")
    if depth == "lidar" and not (folder / "velodyne").is_dir():
        raise SourceError(f"{folder / 'velodyne'}: expected laser scans for depth=lidar, found none")
    width, height = image_size(left[0])
    k = rig.left
    times = folder / "times.txt"
    return KittiSource(
        uri=str(replace(uri, path=str(folder))),
        camera=Camera.from_integer_centred(width=width, height=height, fx=k[0, 0], fy=k[1, 1], cx=k[0, 2], cy=k[1, 2]),
        folder=folder,
        left=left,
        right_folder=right_folder,
        times_ns=kitti_files.read_times_ns(times, len(left))
        if times.exists()
        else np.arange(len(left), dtype=np.int64) * _FRAME_PERIOD_NS,
        poses=_poses(folder, len(left), rig),
        depth=depth,
        densify_px=_densify(uri, depth),
        rig=rig,
    )


def _choice(uri: SourceUri, key: str, choices: tuple[str, ...], default: str) -> str:
    value = uri.options.get(key, default)
    if value not in choices:
        raise SourceError(f"kitti: option {key}: expected one of {', '.join(choices)}; found {value!r}")
    return value


def _densify(uri: SourceUri, depth: str) -> int:
    text = uri.options.get("densify", "0")
    if not text.isdecimal() or int(text) > _MAX_DENSIFY_PX:
        raise SourceError(f"kitti: option densify: expected pixels from 0 to {_MAX_DENSIFY_PX}; found {text!r}")
    if int(text) > 0 and depth != "lidar":
        raise SourceError(f"kitti: option densify: expected beside depth=lidar, found depth={depth}")
    return int(text)


def _images(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise SourceError(f"{folder}: expected a folder with 000000.png, 000001.png, ..., found none")
    found = files.numbered_files(folder, r"(\d+)\.png")
    if not found:
        raise SourceError(f"{folder}: expected images 000000.png, 000001.png, ..., found none")
    missing = next((k for k in range(len(found)) if k not in found), None)
    if missing is not None:
        raise SourceError(f"{folder / f'{missing:06d}.png'}: expected frames numbered from 0 without gaps, found none")
    return [found[k] for k in range(len(found))]


def _rig(path: Path, left: int, right: int, *, with_scanner: bool) -> _Rig:
    matrices = kitti_files.read_calibration(path)
    for name in (f"P{left}", f"P{right}", *(("Tr",) if with_scanner else ())):
        if name not in matrices:
            raise SourceError(f"{path}: expected a line {name}: with 12 numbers, found {', '.join(matrices) or 'none'}")
    scanner = None
    if with_scanner:
        scanner = files.checked_pose([*matrices["Tr"].ravel().tolist(), 0.0, 0.0, 0.0, 1.0], where=f"{path}: Tr")
    rig = _Rig(left=matrices[f"P{left}"], right=matrices[f"P{right}"], T_camera_scan=scanner)
    if not (rig.focal_px > 0.0 and rig.left[1, 1] > 0.0):
        raise SourceError(f"{path}: P{left}: expected positive focal lengths, found {rig.focal_px}, {rig.left[1, 1]}")
    if not rig.baseline_m > 0.0:
        raise SourceError(f"{path}: expected P{right} to the right of P{left}, found {rig.baseline_m} m between them")
    return rig


def _poses(folder: Path, num_frames: int, rig: _Rig) -> npt.NDArray[np.float64] | None:
    """Poses of the left image's camera; files give those of camera 0."""
    for path in (folder / "poses.txt", folder.parent.parent / "poses" / f"{folder.name}.txt"):
        if path.is_file():
            poses = kitti_files.read_poses(path)
            if len(poses) != num_frames:
                raise SourceError(f"{path}: expected {num_frames} poses, one for each frame, found {len(poses)}")
            return np.asarray(poses @ rig.T_camera0_left())
    return None
