"""Dense RGB-D alignment and the tracking loss."""

from typing import Annotated

import numpy
from numpy.typing import NDArray


class AlignmentOptions:
    def __init__(self, *, color_sigma: float, color_weight: float, depth_sigma_base: float, depth_sigma_quadratic: float, depth_weight: float, depth_gate_sigmas: float, border_px: float) -> None: ...

def normal_equations(rgb: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu', writable=False)], depth: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)], mask: Annotated[NDArray[numpy.uint8], dict(shape=(None, None), order='C', device='cpu', writable=False)], packed: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu', writable=False)], camera: tuple[float, float, float, float], points: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)], frame_depth: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)], frame_camera: tuple[float, float, float, float], T_observed_reference: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], options: AlignmentOptions, threads: int) -> tuple[Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')], Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')], float, float, int, int]:
    """H [6,6], g [6], colour cost, depth cost, colour count, depth count."""

def visible_points(points: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)], T_camera_map: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], depth: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)], camera: tuple[float, float, float, float], tolerance: float) -> Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu')]:
    """
    Points [M,6] (position, normal; camera frame) that a rendered depth image shows.
    """

def normals_from_depth(depth: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)], camera: tuple[float, float, float, float], max_relative_step: float, stride: int) -> Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu')]:
    """
    Unit normals of every stride-th pixel and row of a depth image (m); zero where unknown.
    """

def tracking_loss(rgb: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu', writable=False)], depth: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)], alpha: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)], target_rgb: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu', writable=False)], target_depth: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)], mask: Annotated[NDArray[numpy.uint8], dict(shape=(None, None), order='C', device='cpu', writable=False)], silhouette_threshold: float, color_weight: float, depth_weight: float) -> tuple[float, float, int, Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu')], Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu')]]:
    """
    Eq. 1: colour sum, depth sum, pixel count, d_rgb [H,W,3], d_depth [H,W].
    """
