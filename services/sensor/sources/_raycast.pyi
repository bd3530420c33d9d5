"""
Ray-cast images of procedural scenes; the same bytes on every machine and for any number of threads.
"""

from collections.abc import Sequence
from typing import Annotated

import numpy
from numpy.typing import NDArray


class Scene:
    """Primitives with textured faces, lights, and the light they leave."""

    def __init__(self, kind: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu', writable=False)], centre: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], rotation: Annotated[NDArray[numpy.float64], dict(shape=(None, 3, 3), order='C', device='cpu', writable=False)], size: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], face_texture: Annotated[NDArray[numpy.int32], dict(shape=(None, 6), order='C', device='cpu', writable=False)], face: Annotated[NDArray[numpy.float32], dict(shape=(None, 6, 8), order='C', device='cpu', writable=False)], textures: Sequence[Annotated[NDArray[numpy.uint8], dict(shape=(None, None, 3), order='C', device='cpu', writable=False)]], lights: Annotated[NDArray[numpy.float64], dict(shape=(None, 7), order='C', device='cpu', writable=False)], ambient: Annotated[NDArray[numpy.float32], dict(shape=(3), order='C', device='cpu', writable=False)], num_threads: int) -> None:
        """
        kind int32 [N] (0 box, 1 room, 2 cone, 3 ellipsoid); centre float64 [N,3] (m); rotation float64 [N,3,3] (object to world); size float64 [N,3] (m); face_texture int32 [N,6]; face float32 [N,6,8] (u0, v0, texture units per metre su, sv, tint r, g, b, glow); textures uint8 [h,w,3], powers of two; lights float64 [L,7] (position m, strength r, g, b, half-light distance m); ambient float32 [3].
        """

    def render(self, T_world_camera: Annotated[NDArray[numpy.float64], dict(shape=(4, 4), order='C', device='cpu', writable=False)], width: int, height: int, intrinsics: tuple[float, float, float, float], num_threads: int) -> tuple[Annotated[NDArray[numpy.uint8], dict(order='C', device='cpu')], Annotated[NDArray[numpy.float64], dict(order='C', device='cpu')], Annotated[NDArray[numpy.float32], dict(order='C', device='cpu')]]:
        """
        Colour uint8 [H,W,3], depth float64 [H,W] (m along the optical axis, 0 = nothing hit) and the cosine between ray and normal float32 [H,W], for a pose float64 [4,4] and (fx, fy, cx, cy) in pixels.
        """

    def clearance_m(self, point: tuple[float, float, float]) -> float:
        """
        Distance (m, to about 3 cm) from a world point to the nearest surface, negative inside matter.
        """

def fractal_noise(height: int, width: int, cells_y: int, cells_x: int, octaves: int, gain: float, seed: int, num_threads: int) -> Annotated[NDArray[numpy.float32], dict(order='C', device='cpu')]:
    """
    Seamless gradient noise float32 [height,width]: octave k has (cells_y, cells_x) * 2^k cells and a standard deviation of about 0.83 gain^k; octaves finer than 2 texels per cell are left out.
    """
