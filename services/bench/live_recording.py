"""A recording that can be read as fast as a camera gives frames: some frames of the room, back and forth."""

import json
from pathlib import Path

import cv2
import numpy as np

from vtslam.services.sensor.sources.registry import open_source

_IMAGES, _PATH = 24, 480  # frames of a path round the room: slow motion
_RENDERED_WIDTH = 320  # larger ones are scaled up from it: rendering them would take minutes


def write_live_recording(folder: Path, *, frames: int, size: tuple[int, int]) -> str:
    """Write a recording; the URI of it.

    Args:
        folder: An empty folder.
        frames: Its length.
        size: Width and height of its frames, pixels.
    """
    width, height = size
    scale = min(1.0, _RENDERED_WIDTH / width)
    source = open_source(f"sim:room?frames={_PATH}", size=(round(scale * width), round(scale * height)))
    camera = source.camera.resized(width, height)
    # The intrinsics of the layout count from the middle of the first pixel.
    intrinsics = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx - 0.5, "cy": camera.cy - 0.5}
    words = {"camera": {"w": width, "h": height, **intrinsics, "scale": 1.0 / source.depth_scale_m}}
    (folder / "cam_params.json").write_text(json.dumps(words))
    results = folder / "results"
    results.mkdir()
    order = [*range(_IMAGES), *range(_IMAGES - 2, 0, -1)]
    for number in range(frames):
        color, depth = results / f"frame{number:06d}.jpg", results / f"depth{number:06d}.png"
        index = order[number % len(order)]
        if number < _IMAGES:
            frame = source.frame(index)
            rgb = cv2.resize(frame.rgb, size, interpolation=cv2.INTER_LINEAR)
            depth_image = cv2.resize(frame.depth, size, interpolation=cv2.INTER_NEAREST_EXACT)
            cv2.imwrite(str(color), np.ascontiguousarray(rgb[..., ::-1]))
            cv2.imwrite(str(depth), depth_image, [cv2.IMWRITE_PNG_COMPRESSION, 0])  # quick to read
        else:
            color.symlink_to(f"frame{index:06d}.jpg")
            depth.symlink_to(f"depth{index:06d}.png")
    return f"replica:{folder}"
