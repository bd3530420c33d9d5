"""Image quality of a rendering against the observed frame (docs/metrics.md).

Images are float [H,W,3] with data range 1; renderings are taken as they are, not clamped to 0..1. All sums are
float64. PSNR is the mean of the three channels' PSNR, at most 100 dB. Masks are bool [H,W]; figures that have no pixel
to look at are None.
"""

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.floating]
Mask = npt.NDArray[np.bool_]

MIN_MS_SSIM_PX = 161  # smaller side: the fifth scale still holds one 11 x 11 window
_MIN_MSE = 1e-10  # 100 dB: identical images stay a number that JSON can hold
_C1, _C2 = 0.01**2, 0.03**2
_WINDOW, _SIGMA_PX = 11, 1.5
_SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)  # of Wang et al. 2003, finest first


def valid_depth(depth_m: Image) -> Mask:
    """Pixels [H,W] with an observed depth: finite and positive."""
    return np.isfinite(depth_m) & (depth_m > 0)


def psnr_db(rendered: Image, observed: Image, pixels: Mask | None = None) -> float | None:
    """PSNR over the pixels of a mask (None: over all)."""
    _check(rendered, observed)
    error = rendered.astype(np.float64) - observed
    chosen = error.reshape(-1, 3) if pixels is None else error[pixels]
    if not chosen.size:
        return None
    mse = np.maximum(np.mean(chosen * chosen, axis=0), _MIN_MSE)
    return float(np.mean(-10.0 * np.log10(mse)))


def psnr_paper_db(rendered: Image, observed: Image, valid: Mask) -> float | None:
    """PSNR over all pixels of both images times the valid-depth mask: the zeros count as pixels without error."""
    if not valid.any():
        return None
    return psnr_db(rendered * valid[..., None], observed * valid[..., None])


def covered_psnr_db(rendered: Image, observed: Image, alpha: Image, depth_m: Image) -> float | None:
    """PSNR over covered valid pixels: alpha [H,W] above 0.5 and a valid observed depth [H,W] (m)."""
    return psnr_db(rendered, observed, (alpha > 0.5) & valid_depth(depth_m))


def depth_l1_m(rendered_depth_m: Image, depth_m: Image) -> float | None:
    """Mean absolute depth error (m) over valid pixels; the rendered depth is not divided by alpha."""
    valid = valid_depth(depth_m)
    if not valid.any():
        return None
    return float(np.mean(np.abs(rendered_depth_m[valid].astype(np.float64) - depth_m[valid])))


def ssim(rendered: Image, observed: Image) -> float:
    """SSIM with an 11x11 Gaussian window of sigma 1.5, C1 = 0.01^2, C2 = 0.03^2, mean over pixels and channels.

    The images are padded by zeros, so the map has the images' size, as in the mapping loss.
    """
    _check(rendered, observed)
    similarity, _ = _ssim_maps(rendered.astype(np.float64), observed.astype(np.float64))
    return float(similarity.mean())


def ssim_paper(rendered: Image, observed: Image, valid: Mask) -> float | None:
    """`ssim` of both images times the valid-depth mask."""
    if not valid.any():
        return None
    return ssim(rendered * valid[..., None], observed * valid[..., None])


def ms_ssim(rendered: Image, observed: Image) -> float | None:
    """Five-scale SSIM (Wang et al. 2003) per channel, then their mean; None if a side is below 161 pixels.

    At each scale only whole windows count. Scales are means of 2x2 pixels; an odd side gets zeros in front first, and
    negative contrast terms count as 0, as in the implementations that published figures come from.
    """
    _check(rendered, observed)
    if min(rendered.shape[:2]) < MIN_MS_SSIM_PX:
        return None
    x, y = rendered.astype(np.float64), observed.astype(np.float64)
    product = np.ones(3)
    inner = slice(_WINDOW // 2, -(_WINDOW // 2))
    for scale, weight in enumerate(_SCALE_WEIGHTS):
        similarity, contrast = _ssim_maps(x, y)
        last = scale == len(_SCALE_WEIGHTS) - 1
        terms = (similarity if last else contrast)[inner, inner].mean(axis=(0, 1))
        product *= np.maximum(terms, 0.0) ** weight
        x, y = _halved(x), _halved(y)
    return float(product.mean())


def ms_ssim_paper(rendered: Image, observed: Image, valid: Mask) -> float | None:
    """`ms_ssim` of both images times the valid-depth mask."""
    if not valid.any():
        return None
    return ms_ssim(rendered * valid[..., None], observed * valid[..., None])


def _ssim_maps(
    x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """SSIM and its contrast-structure factor per pixel and channel, [H,W,3]."""
    mean_x, mean_y = _blurred(x), _blurred(y)
    variances = _blurred(x * x) - mean_x * mean_x + _blurred(y * y) - mean_y * mean_y
    covariance = _blurred(x * y) - mean_x * mean_y
    contrast = (2.0 * covariance + _C2) / (variances + _C2)
    return contrast * (2.0 * mean_x * mean_y + _C1) / (mean_x * mean_x + mean_y * mean_y + _C1), contrast


def _blurred(image: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    offsets = np.arange(_WINDOW) - _WINDOW // 2
    kernel = np.exp(-(offsets * offsets) / (2.0 * _SIGMA_PX * _SIGMA_PX))
    kernel /= kernel.sum()
    return np.asarray(cv2.sepFilter2D(image, cv2.CV_64F, kernel, kernel, borderType=cv2.BORDER_CONSTANT), np.float64)


def _halved(image: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    height, width, channels = image.shape
    even = np.pad(image, ((height % 2, 0), (width % 2, 0), (0, 0)))
    blocks = even.reshape((height + 1) // 2, 2, (width + 1) // 2, 2, channels)
    return np.asarray(blocks.mean(axis=(1, 3)), np.float64)


def _check(rendered: Image, observed: Image) -> None:
    if rendered.shape != observed.shape or rendered.ndim != 3 or rendered.shape[2] != 3:
        raise ValueError(f"expected two images [H,W,3] of one size, got {rendered.shape} and {observed.shape}")
    if not np.isfinite(rendered).all():
        raise ValueError("expected a rendering of finite values")
