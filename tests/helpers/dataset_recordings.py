"""Small synthetic recordings on disk, in the layouts of TUM RGB-D, ScanNet and ScanNet++."""

import json
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from helpers.recordings import Depth, Poses, Rgb, camera_path, images, pose_row, write_png

from vtslam.common.geometry import se3


@dataclass(slots=True, kw_only=True)
class TumRecording:
    """``rgb.txt``, ``depth.txt``, ``groundtruth.txt`` and the images they name; depth 10 ms after colour."""

    folder: Path
    rgb: list[Rgb]
    depth: list[Depth]
    poses: Poses
    color_times_s: list[float]

    @property
    def uri(self) -> str:
        return f"tum:{self.folder}"

    def color_path(self, index: int) -> Path:
        return self.folder / "rgb" / f"{self.color_times_s[index]:.6f}.png"

    def depth_path(self, index: int) -> Path:
        return self.folder / "depth" / f"{self.color_times_s[index] + 0.01:.6f}.png"

    def write_list(self, name: str, lines: list[str]) -> Path:
        path = self.folder / name
        path.write_text("# a comment\n" + "".join(f"{line}\n" for line in lines))
        return path

    def lines(self, kind: str) -> list[str]:
        """The lines of ``rgb.txt`` or ``depth.txt`` as they were written."""
        paths = [getattr(self, "color_path" if kind == "rgb" else "depth_path")(i) for i in range(len(self.rgb))]
        return [f"{path.stem} {kind}/{path.name}" for path in paths]

    def truth_lines(self) -> list[str]:
        out = []
        for time_s, T in zip(self.color_times_s, self.poses, strict=True):
            values = [*T[:3, 3], *se3.quaternion_xyzw(T)]
            out.append(" ".join([f"{time_s - 0.002:.4f}", *(repr(float(value)) for value in values)]))
        return out


def write_tum(folder: Path, *, num_frames: int = 3, interval_s: float = 0.04) -> TumRecording:
    """Write a sequence, 640x480, depth of 5000 units per metre."""
    rgb, depth = images(num_frames, width=640, height=480)
    times_s = [1305031452.79 + interval_s * index for index in range(num_frames)]
    recording = TumRecording(folder=folder, rgb=rgb, depth=depth, poses=camera_path(num_frames), color_times_s=times_s)
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
        recording.write_list(f"{name}.txt", recording.lines(name))
    for index in range(num_frames):
        write_png(recording.color_path(index), rgb[index])
        write_png(recording.depth_path(index), depth[index])
    recording.write_list("groundtruth.txt", recording.truth_lines())
    return recording


SCANNET_MATRIX = np.array([[60.0, 0, 32.0, 0], [0, 62.0, 24.0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


@dataclass(slots=True, kw_only=True)
class ScanNetRecording:
    """An exported folder: colour 64x48, depth 32x24; frame k has the number ``k * step``."""

    folder: Path
    rgb: list[Rgb]
    depth: list[Depth]
    poses: Poses
    step: int

    @property
    def uri(self) -> str:
        return f"scannet:{self.folder}"

    def color_path(self, index: int) -> Path:
        return self.folder / "color" / f"{index * self.step}.png"

    def depth_path(self, index: int) -> Path:
        return self.folder / "depth" / f"{index * self.step}.png"

    def pose_path(self, index: int) -> Path:
        return self.folder / "pose" / f"{index * self.step}.txt"

    @property
    def intrinsics_path(self) -> Path:
        return self.folder / "intrinsic" / "intrinsic_color.txt"


def matrix_text(matrix: Poses) -> str:
    return "".join(pose_row(row) + "\n" for row in matrix)


def write_scannet(folder: Path, *, num_frames: int = 3, step: int = 1) -> ScanNetRecording:
    """Write an exported folder, depth in mm."""
    rgb, _ = images(num_frames, width=64, height=48)
    _, depth = images(num_frames, width=32, height=24)
    recording = ScanNetRecording(folder=folder, rgb=rgb, depth=depth, poses=camera_path(num_frames), step=step)
    for name in ("color", "depth", "pose", "intrinsic"):
        (folder / name).mkdir(parents=True)
    recording.intrinsics_path.write_text(matrix_text(SCANNET_MATRIX))
    for index in range(num_frames):
        write_png(recording.color_path(index), rgb[index])
        write_png(recording.depth_path(index), depth[index])
        recording.pose_path(index).write_text(matrix_text(recording.poses[index]))
    return recording


@dataclass(slots=True, kw_only=True)
class SensRecording:
    """The parts of a ``.sens`` file, which tests change before they write it: colour 64x48 PNG, depth 32x24."""

    rgb: list[Rgb]
    depth: list[Depth]
    poses: Poses
    version: int = 4
    name: bytes = b"StructureSensor"
    color_compression: int = 1
    depth_compression: int = 1
    sizes: tuple[int, int, int, int] = (64, 48, 32, 24)
    units_per_m: float = 1000.0
    num_frames: int | None = None

    def header(self) -> bytes:
        eye = np.eye(4, dtype="<f4").tobytes()
        matrices = SCANNET_MATRIX.astype("<f4").tobytes() + eye + SCANNET_MATRIX.astype("<f4").tobytes() + eye
        count = len(self.rgb) if self.num_frames is None else self.num_frames
        images = (self.color_compression, self.depth_compression, *self.sizes, self.units_per_m, count)
        start = struct.pack("<IQ", self.version, len(self.name)) + self.name
        return start + matrices + struct.pack("<iiIIIIfQ", *images)

    def color_bytes(self, index: int) -> bytes:
        return bytes(cv2.imencode(".png", self.rgb[index][..., ::-1])[1].tobytes())

    def depth_bytes(self, index: int) -> bytes:
        raw = self.depth[index].astype("<u2").tobytes()
        return zlib.compress(raw) if self.depth_compression == 1 else raw

    def frame(self, index: int, *, color: bytes | None = None, depth: bytes | None = None) -> bytes:
        color = self.color_bytes(index) if color is None else color
        depth = self.depth_bytes(index) if depth is None else depth
        sizes = struct.pack("<QQQQ", 0, 0, len(color), len(depth))
        return bytes(self.poses[index].astype("<f4").tobytes()) + sizes + color + depth

    def write(self, path: Path) -> str:
        """Write the file; the URI of it."""
        path.write_bytes(self.header() + b"".join(self.frame(index) for index in range(len(self.rgb))))
        return f"scannet:{path}"


def sens_recording(num_frames: int = 3) -> SensRecording:
    rgb, _ = images(num_frames, width=64, height=48)
    _, depth = images(num_frames, width=32, height=24)
    return SensRecording(rgb=rgb, depth=depth, poses=camera_path(num_frames))


@dataclass(slots=True, kw_only=True)
class ScanNetPpRecording:
    """``dslr`` with three training images, of which the order is not that of their names, and two held-out ones."""

    folder: Path
    names: list[str]
    rgb: list[Rgb]
    depth: list[Depth]
    poses: Poses

    @property
    def uri(self) -> str:
        return f"scannetpp:{self.folder}"

    @property
    def transforms_path(self) -> Path:
        return self.folder / "dslr" / "nerfstudio" / "transforms_undistorted.json"

    @property
    def lists_path(self) -> Path:
        return self.folder / "dslr" / "train_test_lists.json"

    def color_path(self, index: int) -> Path:
        return self.folder / "dslr" / "undistorted_images" / self.names[index]

    def depth_path(self, index: int) -> Path:
        return self.folder / "dslr" / "undistorted_depths" / Path(self.names[index]).with_suffix(".png")

    def transforms(self) -> dict[str, Any]:
        flip = np.diag([1.0, -1.0, -1.0, 1.0])
        frames = [
            {"file_path": name, "transform_matrix": (flip @ T @ flip).tolist(), "is_bad": False}
            for name, T in zip(self.names, self.poses, strict=True)
        ]
        size = {"w": 64, "h": 48, "fl_x": 60.0, "fl_y": 61.0, "cx": 32.0, "cy": 24.0}
        return {**size, "camera_model": "PINHOLE", "frames": frames[2::-1], "test_frames": frames[3:]}

    def write_json(self, transforms: object, lists: object) -> None:
        self.transforms_path.write_text(json.dumps(transforms))
        self.lists_path.write_text(json.dumps(lists))


def write_scannetpp(folder: Path) -> ScanNetPpRecording:
    """Write a scene: images 64x48 (PNG data), depth in mm."""
    rgb, depth = images(5, width=64, height=48)
    names = [f"DSC0{number}.JPG" for number in (1752, 1750, 1751, 1790, 1791)]
    recording = ScanNetPpRecording(folder=folder, names=names, rgb=rgb, depth=depth, poses=camera_path(5))
    for name in ("nerfstudio", "undistorted_images", "undistorted_depths"):
        (folder / "dslr" / name).mkdir(parents=True)
    for index in range(5):
        recording.color_path(index).write_bytes(cv2.imencode(".png", rgb[index][..., ::-1])[1].tobytes())
        write_png(recording.depth_path(index), depth[index])
    recording.write_json(recording.transforms(), {"train": names[:3], "test": names[3:]})
    return recording
