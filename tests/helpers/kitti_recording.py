"""A small sequence in the layout of KITTI odometry: a wall seen by stereo pairs, and laser scans of it."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT, FOCAL_PX, BASELINE_M = 160, 60, 100.0, 0.5
DISPARITY_PX = 10
WALL_M = FOCAL_PX * BASELINE_M / DISPARITY_PX


def pose_line(x: float, y: float, z: float, heading: float) -> str:
    """A row of a pose file: a turn about the downward axis, and a place."""
    c, s = np.cos(heading), np.sin(heading)
    return " ".join(f"{v:.12g}" for v in (c, 0, s, x, 0, 1, 0, y, -s, 0, c, z)) + "\n"


def matrix_line(name: str, values: list[float]) -> str:
    """A line of a calibration file."""
    return f"{name}: " + " ".join(f"{v:.6e}" for v in values) + "\n"


@dataclass(frozen=True, slots=True, kw_only=True)
class KittiRecording:
    """Where it lies."""

    folder: Path

    @property
    def uri(self) -> str:
        return f"kitti:{self.folder}"

    def image(self, number: int, frame: int) -> Path:
        return self.folder / f"image_{number}" / f"{frame:06d}.png"

    def scan(self, frame: int) -> Path:
        return self.folder / "velodyne" / f"{frame:06d}.bin"


def write_kitti(folder: Path, *, num_frames: int = 2, color: bool = False) -> KittiRecording:
    """Write a sequence: left and right images, calibration, times, poses and scans."""
    rng = np.random.default_rng(3)
    left_number, right_number = (2, 3) if color else (0, 1)
    for name in (f"image_{left_number}", f"image_{right_number}", "velodyne"):
        (folder / name).mkdir(parents=True)
    recording = KittiRecording(folder=folder)
    for frame in range(num_frames):
        wall = cv2.GaussianBlur(rng.integers(0, 255, (HEIGHT, WIDTH + DISPARITY_PX)).astype(np.uint8), (3, 3), 0)
        pair = {left_number: wall[:, :WIDTH], right_number: wall[:, DISPARITY_PX:]}
        for number, gray in pair.items():
            image = np.stack([gray // 2, gray, gray // 3], axis=2) if color else gray
            assert cv2.imwrite(str(recording.image(number, frame)), image)
        y, z = (v.ravel() for v in np.meshgrid(np.linspace(-2, 2, 41), np.linspace(-1, 1, 21)))
        # Scanner axes: x ahead, y left, z up.
        scan = np.stack([np.full(y.shape, WALL_M), y, z, np.zeros(y.shape)], axis=1)
        recording.scan(frame).write_bytes(scan.astype("<f4").tobytes())
    middle = [0.5 * WIDTH - 0.5, 0.5 * HEIGHT - 0.5]
    shifts = {0: 0.0, 1: -BASELINE_M, 2: 0.06, 3: 0.06 - BASELINE_M}
    lines = [
        matrix_line(f"P{k}", [FOCAL_PX, 0, middle[0], FOCAL_PX * m, 0, FOCAL_PX, middle[1], 0, 0, 0, 1, 0])
        for k, m in shifts.items()
    ]
    lines.append(matrix_line("Tr", [0, -1, 0, 0, 0, 0, -1, 0, 1, 0, 0, 0]))
    (folder / "calib.txt").write_text("".join(lines))
    (folder / "times.txt").write_text("".join(f"{0.1037 * k:.6e}\n" for k in range(num_frames)))
    (folder / "poses.txt").write_text("".join(pose_line(0.1 * k, 0.0, 1.0 * k, 0.02 * k) for k in range(num_frames)))
    return recording
