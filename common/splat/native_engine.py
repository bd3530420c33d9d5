"""The CPU engine: bindings of the C++ rasteriser (folder ``native``).

Vector code for AVX-512, AVX2 and any other processor is in one library; the best one that runs here is taken, or the
one named by the environment variable ``VTSLAM_SIMD`` (``avx512``, ``avx2``, ``portable``). ``VTSLAM_THREADS`` sets the
number of threads. Results are the same bytes for any number of threads on one instruction set.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from vtslam.common.geometry.camera import Camera
from vtslam.common.splat import _native
from vtslam.common.splat.engine import FloatArray, Gradients, RasterSettings, Rendering, Splats


def checked(name: str, array: npt.NDArray[Any], dtype: npt.DTypeLike, shape: tuple[int, ...]) -> None:
    """Refuse an array that is not C-contiguous of this type and shape.

    Raises:
        ValueError: Naming the array, what was expected and what was found.
    """
    if not isinstance(array, np.ndarray):
        raise ValueError(f"{name} must be a numpy array, got {type(array).__name__}")
    if array.dtype != dtype or array.shape != shape:
        expected = f"{np.dtype(dtype)} {list(shape)}"
        raise ValueError(f"{name} must be {expected}, got {array.dtype} {list(array.shape)}")
    if not array.flags.c_contiguous:
        raise ValueError(f"{name} must be C-contiguous")


def _checked_settings(settings: RasterSettings) -> None:
    """The ranges outside of which the kernels' arithmetic does not hold."""
    s = settings
    if not 1e-6 <= s.low_pass_px2 <= 1e3:
        raise ValueError(f"low_pass_px2 must be 1e-6..1e3, got {s.low_pass_px2}")
    if not 1e-4 <= s.near_m < np.inf:
        raise ValueError(f"near_m must be at least 1e-4, got {s.near_m}")
    if not 0.0 < s.alpha_min <= s.alpha_cap <= 0.9999:
        raise ValueError(f"alpha_min, alpha_cap must be 0 < min <= cap <= 0.9999, got {s.alpha_min}, {s.alpha_cap}")
    if not 1e-7 <= s.transmittance_min < 1.0:
        raise ValueError(f"transmittance_min must be 1e-7 to below 1, got {s.transmittance_min}")


class NativeEngine:
    """The CPU rasteriser (protocol ``vtslam.common.splat.engine.Engine``).

    Arithmetic: camera point, image mean and conic in float64, pixels in float32. Depth order is that of the camera Z
    rounded to float32, ties by index. Where alpha is capped it is a constant: no derivative by opacity, radius or mean.

    Args:
        settings: Constants of the image model.
        threads: Threads to use; None for the process's default (``VTSLAM_THREADS``, or the processors at hand, <= 16).

    Raises:
        ValueError: A setting is out of range.
    """

    name = "native"

    def __init__(self, settings: RasterSettings | None = None, *, threads: int | None = None) -> None:
        self.settings = settings if settings is not None else RasterSettings()
        _checked_settings(self.settings)
        if threads is not None and threads < 1:
            raise ValueError(f"threads must be at least 1, got {threads}")
        self._threads = threads or 0

    def render(self, splats: Splats, camera: Camera, T_camera_map: npt.NDArray[np.float64]) -> Rendering:
        """Render ``splats`` from a pose (float64 [4,4], map to camera).

        Raises:
            ValueError: An array is misshapen, of another type, not contiguous, or holds NaN, infinity or a log radius
                beyond +-50; the text names the array and the first such index.
        """
        count = int(splats.log_radii.shape[0]) if splats.log_radii.ndim == 1 else -1
        checked("log_radii", splats.log_radii, np.float32, (max(count, 0),))
        checked("means_m", splats.means_m, np.float32, (count, 3))
        checked("colors", splats.colors, np.float32, (count, 3))
        checked("opacity_logits", splats.opacity_logits, np.float32, (count,))
        pose = np.ascontiguousarray(T_camera_map)
        checked("T_camera_map", pose, np.float64, (4, 4))
        if not np.isfinite(pose).all():
            raise ValueError("T_camera_map must be finite")
        s = self.settings
        rgb, depth_m, alpha, saved = _native.render(
            splats.means_m,
            splats.colors,
            splats.log_radii,
            splats.opacity_logits,
            camera.width,
            camera.height,
            (camera.fx, camera.fy, camera.cx, camera.cy),
            pose,
            (s.low_pass_px2, s.near_m, s.alpha_cap, s.alpha_min, s.transmittance_min),
            self._threads,
        )
        return Rendering(rgb=rgb, depth_m=depth_m, alpha=alpha, saved=saved)

    def backward(
        self,
        rendering: Rendering,
        *,
        d_rgb: FloatArray,
        d_depth: FloatArray,
        d_alpha: FloatArray | None = None,
        want_means: bool = False,
        want_attributes: bool = True,
        want_pose: bool = True,
        want_weights: bool = False,
    ) -> Gradients:
        """Pull image derivatives back to the Gaussians and the pose.

        What is not wanted costs less time, and is zero in the result (``means_m``: None).

        Args:
            rendering: From this engine's ``render``; it may be used several times.
            d_rgb: Derivative by ``rgb``, float32 [H,W,3].
            d_depth: Derivative by ``depth_m``, float32 [H,W].
            d_alpha: Derivative by ``alpha``, float32 [H,W]; None for zero.
            want_means: Also the derivative by the means.
            want_attributes: Derivatives by colours, log radii and opacity logits.
            want_pose: Derivative by the pose.
            want_weights: Also how much each Gaussian shows; with ``want_attributes`` only.

        Raises:
            ValueError: An array is misshapen, of another type, not contiguous, or holds NaN or infinity.
        """
        size = rendering.depth_m.shape
        checked("d_rgb", d_rgb, np.float32, (*size, 3))
        checked("d_depth", d_depth, np.float32, size)
        if d_alpha is not None:
            checked("d_alpha", d_alpha, np.float32, size)
        saved = rendering.saved
        colors, log_radii, opacity_logits, means_m, weights, pose = _native.backward(
            saved, d_rgb, d_depth, d_alpha, want_attributes, want_pose, want_means, want_weights, self._threads
        )
        count = saved.count
        return Gradients(
            colors=np.zeros((count, 3), np.float32) if colors is None else colors,
            log_radii=np.zeros(count, np.float32) if log_radii is None else log_radii,
            opacity_logits=np.zeros(count, np.float32) if opacity_logits is None else opacity_logits,
            means_m=means_m,
            pose=np.array(pose) if want_pose else np.zeros(6),
            weights=weights,
        )
