"""Small synthetic recordings on disk, in the layouts of the readers."""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Thread
from typing import Protocol, TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from vtslam.common.geometry import se3

Rgb = npt.NDArray[np.uint8]
Depth = npt.NDArray[np.uint16]
Poses = npt.NDArray[np.float64]
R = TypeVar("R", bound="Recording")


class Recording(Protocol):
    """A recording that tests can look at and damage."""

    folder: Path
    rgb: list[Rgb]
    depth: list[Depth]
    poses: Poses

    @property
    def uri(self) -> str: ...

    def color_path(self, index: int) -> Path: ...

    def depth_path(self, index: int) -> Path: ...

    def pose_path(self, index: int) -> Path:
        """The file that holds pose ``index``."""
        ...

    def pose_place(self, index: int) -> str:
        """How messages name the place of pose ``index``."""
        ...

    def write_poses(self, rows: list[str]) -> None:
        """Write one text of 16 numbers per frame, fewer or more than there are frames included."""
        ...


def images(num_frames: int, *, width: int, height: int) -> tuple[list[Rgb], list[Depth]]:
    """Smooth images, different for each frame; depth has 1 % holes."""
    rng = np.random.default_rng(7)
    v, u = np.mgrid[0:height, 0:width]
    rgb, depth = [], []
    for t in range(num_frames):
        channels = [127.5 + 100.0 * np.sin(u / 9.0 + v / (11.0 + c) + t + c) for c in range(3)]
        rgb.append(np.stack(channels, axis=-1).astype(np.uint8))
        metres = 2.0 + 0.3 * np.cos(u / 17.0 + 0.5 * t) + 0.2 * np.sin(v / 13.0)
        metres[rng.random(metres.shape) < 0.01] = 0.0
        depth.append((metres * 1000.0).astype(np.uint16))
    return rgb, depth


def camera_path(num_frames: int) -> Poses:
    """Poses ``T_world_camera`` [F,4,4] along a gentle curve."""
    step = np.array([0.02, 0.005, 0.01, 0.01, 0.02, -0.01])
    return np.stack([se3.exp(t * step) for t in range(num_frames)])


def pose_row(T: Poses) -> str:
    """The 16 numbers of a matrix [4,4], row-major, on one line."""
    return " ".join(repr(float(value)) for value in T.ravel())


def write_png(path: Path, image: Rgb | Depth) -> None:
    """Write an image; colour is red first."""
    if not cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image, [cv2.IMWRITE_PNG_COMPRESSION, 1]):
        raise OSError(f"cannot write {path}")


def cut_in_half(path: Path) -> None:
    """Keep the first half of a file's bytes."""
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


@contextmanager
def read_once_told(path: Path) -> Iterator[Event]:
    """Within, whoever reads the file waits until the event is set, for the first time; it is whole again after."""
    data, told = path.read_bytes(), Event()
    path.unlink()
    os.mkfifo(path)

    def feed() -> None:
        told.wait()
        path.write_bytes(data)  # a pipe: returns once somebody reads

    feeder = Thread(target=feed, daemon=True)  # nobody may come
    feeder.start()
    try:
        yield told
    finally:
        told.set()
        end = os.open(path, os.O_RDONLY | os.O_NONBLOCK)  # lets the feeder go if nobody came
        feeder.join()
        os.close(end)
        path.unlink()
        path.write_bytes(data)


@dataclass(slots=True, kw_only=True)
class ReplicaRecording:
    """``results/frame%06d.png``, ``results/depth%06d.png``, ``traj.txt``, ``cam_params.json``."""

    folder: Path
    rgb: list[Rgb]
    depth: list[Depth]
    poses: Poses

    @property
    def uri(self) -> str:
        return f"replica:{self.folder}"

    def color_path(self, index: int) -> Path:
        return self.folder / "results" / f"frame{index:06d}.png"

    def depth_path(self, index: int) -> Path:
        return self.folder / "results" / f"depth{index:06d}.png"

    def pose_path(self, index: int) -> Path:
        return self.folder / "traj.txt"

    def pose_place(self, index: int) -> str:
        return f"{self.pose_path(index)}:{index + 1}"

    def write_poses(self, rows: list[str]) -> None:
        (self.folder / "traj.txt").write_text("".join(row + "\n" for row in rows))


@dataclass(slots=True, kw_only=True)
class SevenScenesRecording:
    """``frame-%06d.color.png``, ``.depth.png``, ``.pose.txt``."""

    folder: Path
    rgb: list[Rgb]
    depth: list[Depth]
    poses: Poses

    @property
    def uri(self) -> str:
        return f"7scenes:{self.folder}"

    def color_path(self, index: int) -> Path:
        return self.folder / f"frame-{index:06d}.color.png"

    def depth_path(self, index: int) -> Path:
        return self.folder / f"frame-{index:06d}.depth.png"

    def pose_path(self, index: int) -> Path:
        return self.folder / f"frame-{index:06d}.pose.txt"

    def pose_place(self, index: int) -> str:
        return str(self.pose_path(index))

    def write_poses(self, rows: list[str]) -> None:
        for path in self.folder.glob("*.pose.txt"):
            path.unlink()
        for index, row in enumerate(rows):
            words = row.split()
            lines = [" ".join(words[at : at + 4]) for at in range(0, len(words), 4)]
            self.pose_path(index).write_text("\n".join(lines) + "\n")


def write_replica(folder: Path, *, num_frames: int = 3, width: int = 48, height: int = 36) -> ReplicaRecording:
    """Write a recording in Replica's layout, depth in mm."""
    rgb, depth = images(num_frames, width=width, height=height)
    recording = ReplicaRecording(folder=folder, rgb=rgb, depth=depth, poses=camera_path(num_frames))
    (folder / "results").mkdir(parents=True)
    camera = {"w": width, "h": height, "fx": 40.0, "fy": 42.0, "cx": 23.5, "cy": 17.5, "scale": 1000.0}
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))
    return filled(recording)


def write_seven_scenes(folder: Path, *, num_frames: int = 3) -> SevenScenesRecording:
    """Write a recording in the layout of 7-Scenes, 640x480."""
    rgb, depth = images(num_frames, width=640, height=480)
    folder.mkdir(parents=True)
    return filled(SevenScenesRecording(folder=folder, rgb=rgb, depth=depth, poses=camera_path(num_frames)))


def filled(recording: R) -> R:
    for index, (rgb, depth) in enumerate(zip(recording.rgb, recording.depth, strict=True)):
        write_png(recording.color_path(index), rgb)
        write_png(recording.depth_path(index), depth)
    recording.write_poses([pose_row(T) for T in recording.poses])
    return recording
