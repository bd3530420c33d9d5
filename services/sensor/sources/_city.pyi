"""
Ray-cast images of a town on flat ground; the same bytes on every machine and for any number of threads.
"""

from collections.abc import Sequence
from typing import Annotated

import numpy
from numpy.typing import NDArray


class Town:
    """
    Houses, trees, cars and streets, found by the cell of the ground they stand in.
    """

    def __init__(self, kind: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu', writable=False)], place: Annotated[NDArray[numpy.float64], dict(shape=(None, 8), order='C', device='cpu', writable=False)], skin: Annotated[NDArray[numpy.int32], dict(shape=(None, 3), order='C', device='cpu', writable=False)], look: Annotated[NDArray[numpy.float64], dict(shape=(None, 11), order='C', device='cpu', writable=False)], streets: Annotated[NDArray[numpy.float64], dict(shape=(None, 5), order='C', device='cpu', writable=False)], textures: Sequence[Annotated[NDArray[numpy.uint8], dict(shape=(None, None, 3), order='C', device='cpu', writable=False)]]) -> None:
        """
        kind int32 [N] (0 box, 1 cylinder, 2 ellipsoid); place float64 [N,8] (x, z, cosine and sine of the turn, half length along local x and z or the radius twice, heights of bottom and top; m); skin int32 [N,3] (textures of sides, ends and foot); look float64 [N,11] (width and height covered by each of them, height of the foot, tint r, g, b, shift of stains; m); streets float64 [S,5] (x0, z0, x1, z1, length of the line before; m); textures uint8 [h,w,3], powers of two, the first five stains, asphalt, paving, grass, clouds.
        """

    def render(self, T_world_camera: Annotated[NDArray[numpy.float64], dict(shape=(4, 4), order='C', device='cpu', writable=False)], width: int, height: int, intrinsics: tuple[float, float, float, float], kind: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu', writable=False)], place: Annotated[NDArray[numpy.float64], dict(shape=(None, 8), order='C', device='cpu', writable=False)], skin: Annotated[NDArray[numpy.int32], dict(shape=(None, 3), order='C', device='cpu', writable=False)], look: Annotated[NDArray[numpy.float64], dict(shape=(None, 11), order='C', device='cpu', writable=False)], num_threads: int) -> tuple[Annotated[NDArray[numpy.uint8], dict(order='C', device='cpu')], Annotated[NDArray[numpy.float64], dict(order='C', device='cpu')]]:
        """
        Colour uint8 [H,W,3] and depth float64 [H,W] (m along the optical axis, 0 = nothing within 255 m) for a pose float64 [4,4] (world: x and z along the ground, y down, the ground is y = 0), (fx, fy, cx, cy) in pixels and further bodies, as in the constructor.
        """
