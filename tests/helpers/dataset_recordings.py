"""Small synthetic recordings on disk, in the layouts of TUM RGB-D, ScanNet and ScanNet++."""

from dataclasses import dataclass
from pathlib import Path

from helpers.recordings import Depth, Poses, Rgb, camera_path, images, write_png

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
