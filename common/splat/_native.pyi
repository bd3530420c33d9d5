"""
CPU rasteriser with gradients, fused mapping loss and optimiser step; see native_engine.py.
"""

from typing import Annotated

import numpy
from numpy.typing import NDArray


class SavedRendering:
    """What one rendering keeps for its derivative."""

    @property
    def count(self) -> int:
        """Number of Gaussians."""

def render(means_m: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)], colors: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)], log_radii: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)], opacity_logits: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)], width: int, height: int, intrinsics: tuple[float, float, float, float], T_camera_map: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], constants: tuple[float, float, float, float, float], threads: int = 0) -> tuple[Annotated[NDArray[numpy.float32], dict(order='C')], Annotated[NDArray[numpy.float32], dict(order='C')], Annotated[NDArray[numpy.float32], dict(order='C')], SavedRendering]:
    """
    rgb, depth_m, alpha and the record for backward. intrinsics: fx, fy, cx, cy; constants: low_pass_px2, near_m, alpha_cap, alpha_min, transmittance_min; threads 0: the default.
    """

def backward(saved: SavedRendering, d_rgb: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu', writable=False)], d_depth: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)], d_alpha: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)] | None, want_attributes: bool, want_pose: bool, want_means: bool, want_weights: bool, threads: int = 0) -> tuple[Annotated[NDArray[numpy.float32], dict(order='C')] | None, Annotated[NDArray[numpy.float32], dict(order='C')] | None, Annotated[NDArray[numpy.float32], dict(order='C')] | None, Annotated[NDArray[numpy.float32], dict(order='C')] | None, Annotated[NDArray[numpy.float32], dict(order='C')] | None, list[float]]:
    """
    Derivatives by colours, log_radii, opacity_logits, means_m (None where not wanted) and pose (empty if not).
    """

def mapping_loss(rgb: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu', writable=False)], depth_m: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)], target_rgb: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu', writable=False)], target_depth_m: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)], mask: Annotated[NDArray[numpy.uint8], dict(shape=(None, None), order='C', device='cpu', writable=False)] | None, weight_color: float, weight_depth: float, ssim_share: float, threads: int = 0) -> tuple[float, float, float, Annotated[NDArray[numpy.float32], dict(order='C')], Annotated[NDArray[numpy.float32], dict(order='C')]]:
    """
    Mean |colour error|, SSIM, mean |depth error|, and the loss's derivatives by rgb and depth_m.
    """

def adam_step(parameters: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu')], gradients: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)], m: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu')], v: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu')], lr: float, beta1: float, beta2: float, eps: float, step: int, threads: int = 0) -> None:
    """One Adam step in place; step counts from 1."""

def simd() -> str:
    """Name of the instruction set in use."""

def available_simd() -> list[str]:
    """Instruction sets that can run here, best first."""

def select_simd(name: str) -> None:
    """Switch to an instruction set; ValueError if it cannot run here."""

def threads() -> int:
    """Threads used where a call does not say."""

def set_threads(threads: int) -> None:
    """Set that number; 0 returns to the default."""
