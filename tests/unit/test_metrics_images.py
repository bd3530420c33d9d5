import numpy as np
import numpy.typing as npt
import pytest

from vtslam.common import metrics_images as images

Array = npt.NDArray[np.float64]


def noisy_pair(height: int, width: int, *, seed: int = 0) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    rng = np.random.default_rng(seed)
    observed = rng.random((height, width, 3))
    return (observed + rng.normal(0, 0.2, observed.shape)).astype(np.float32), observed.astype(np.float32)


def slow_maps(x: Array, y: Array) -> tuple[Array, Array]:
    """SSIM and contrast of one channel, window by window from the definition, zeros outside."""
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets[:, None] ** 2 + offsets[None, :] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    a, b = (np.lib.stride_tricks.sliding_window_view(np.pad(image, 5), (11, 11)) for image in (x, y))
    mean_a, mean_b = ((window * patch).sum(axis=(2, 3), keepdims=True) for patch in (a, b))
    var_a, var_b = (window * (a - mean_a) ** 2).sum(axis=(2, 3)), (window * (b - mean_b) ** 2).sum(axis=(2, 3))
    covariance = (window * (a - mean_a) * (b - mean_b)).sum(axis=(2, 3))
    mean_a, mean_b = mean_a[..., 0, 0], mean_b[..., 0, 0]
    contrast = (2 * covariance + 0.0009) / (var_a + var_b + 0.0009)
    return contrast * (2 * mean_a * mean_b + 0.0001) / (mean_a**2 + mean_b**2 + 0.0001), contrast


def test_psnr_by_hand() -> None:
    observed = np.zeros((4, 5, 3))
    rendered = np.zeros((4, 5, 3))
    rendered[..., 0], rendered[..., 1], rendered[..., 2] = 0.1, 0.01, 0.001
    assert images.psnr_db(rendered, observed) == pytest.approx((20.0 + 40.0 + 60.0) / 3.0)


def test_psnr_variants_differ_by_the_pixels_counted() -> None:
    observed = np.full((4, 10, 3), 0.5)
    rendered = observed + 0.1
    rendered[:, 5:] = 1.0
    valid = np.zeros((4, 10), bool)
    valid[:, :5] = True
    assert images.psnr_db(rendered, observed, valid) == pytest.approx(20.0)
    assert images.psnr_paper_db(rendered, observed, valid) == pytest.approx(-10.0 * np.log10(0.005))
    assert images.psnr_db(rendered, observed) == pytest.approx(-10.0 * np.log10(0.13))


def test_psnr_does_not_clamp() -> None:
    observed = np.ones((3, 3, 3))
    assert images.psnr_db(observed + 0.1, observed) == pytest.approx(20.0)


def test_psnr_of_equal_images_is_a_number() -> None:
    _, observed = noisy_pair(6, 7)
    assert images.psnr_db(observed, observed) == pytest.approx(100.0)


def test_figures_without_pixels_are_none() -> None:
    rendered, observed = noisy_pair(6, 7)
    none, depth = np.zeros((6, 7), bool), np.zeros((6, 7))
    assert images.psnr_db(rendered, observed, none) is None
    assert images.psnr_paper_db(rendered, observed, none) is None
    assert images.ssim_paper(rendered, observed, none) is None
    assert images.ms_ssim_paper(rendered, observed, none) is None
    assert images.depth_l1_m(depth + 1.0, depth) is None
    assert images.covered_psnr_db(rendered, observed, depth + 1.0, depth) is None


def test_covered_pixels_have_alpha_and_depth() -> None:
    observed = np.zeros((1, 4, 3))
    rendered = np.zeros((1, 4, 3))
    rendered[0, :, :] = np.array([0.1, 0.9, 0.9, 0.9])[:, None]
    alpha = np.array([[0.51, 0.5, 1.0, 1.0]])
    depth = np.array([[1.0, 1.0, 0.0, np.nan]])
    assert images.covered_psnr_db(rendered, observed, alpha, depth) == pytest.approx(20.0)


def test_depth_l1_counts_valid_pixels_only() -> None:
    depth = np.array([[1.0, 0.0, np.inf, 2.0]], np.float32)
    rendered = np.array([[1.5, 7.0, 7.0, 1.75]], np.float32)
    assert images.depth_l1_m(rendered, depth) == pytest.approx(0.375)


def test_ssim_against_the_definition() -> None:
    rendered, observed = noisy_pair(17, 23)
    expected = [slow_maps(rendered[..., c].astype(float), observed[..., c].astype(float))[0].mean() for c in range(3)]
    assert images.ssim(rendered, observed) == pytest.approx(np.mean(expected), rel=1e-10)


def test_ssim_of_equal_images_is_one() -> None:
    _, observed = noisy_pair(17, 23)
    assert images.ssim(observed, observed) == pytest.approx(1.0, abs=1e-12)


def test_ssim_of_constant_images_by_hand() -> None:
    """Inside, a constant pair leaves the luminance term alone."""
    a, b = np.full((60, 60, 3), 0.4), np.full((60, 60, 3), 0.6)
    inner = (2 * 0.4 * 0.6 + 1e-4) / (0.4**2 + 0.6**2 + 1e-4)
    slow = slow_maps(a[..., 0], b[..., 0])[0]
    assert slow[30, 30] == pytest.approx(inner)
    assert images.ssim(a, b) == pytest.approx(slow.mean(), rel=1e-10)


def test_masked_ssim_looks_at_valid_pixels() -> None:
    rendered, observed = noisy_pair(40, 50)
    valid = np.zeros((40, 50), bool)
    valid[:, :25] = True
    repaired = np.where(valid[..., None], rendered, observed)
    masked = images.ssim_paper(rendered, observed, valid)
    assert masked == images.ssim_paper(repaired, observed, valid)
    assert masked == pytest.approx(images.ssim(rendered * valid[..., None], observed * valid[..., None]))


def test_ms_ssim_against_the_definition() -> None:
    """Odd sides at the first scale, one channel computed window by window."""
    rng = np.random.default_rng(5)
    coarse = np.kron(rng.random((21, 11)), np.ones((8, 16)))[:163, :161]
    observed = coarse + 0.1 * rng.random((163, 161))
    rendered = observed + rng.normal(0, 0.1, observed.shape)
    actual = images.ms_ssim(np.repeat(rendered[..., None], 3, 2), np.repeat(observed[..., None], 3, 2))
    assert actual == pytest.approx(slow_ms_ssim(rendered, observed), rel=1e-9)


def slow_ms_ssim(x: Array, y: Array) -> float:
    product = 1.0
    for scale, weight in enumerate((0.0448, 0.2856, 0.3001, 0.2363, 0.1333)):
        similarity, contrast = slow_maps(x, y)
        product *= (similarity if scale == 4 else contrast)[5:-5, 5:-5].mean() ** weight
        x, y = slow_half(x), slow_half(y)
    return float(product)


def slow_half(x: Array) -> Array:
    x = np.pad(x, ((x.shape[0] % 2, 0), (x.shape[1] % 2, 0)))
    return (x[::2, ::2] + x[1::2, ::2] + x[::2, 1::2] + x[1::2, 1::2]) / 4.0


def test_ms_ssim_needs_161_pixels() -> None:
    rendered, observed = noisy_pair(161, 170)
    assert images.ms_ssim(rendered[:160], observed[:160]) is None
    assert images.ms_ssim(observed, observed) == pytest.approx(1.0)
    assert 0.0 < (images.ms_ssim(rendered, observed) or 0.0) < 1.0


def test_ms_ssim_of_opposite_images_is_zero() -> None:
    _, observed = noisy_pair(161, 161)
    assert images.ms_ssim(1.0 - observed, observed) == 0.0


def test_refuses_other_shapes_and_nan() -> None:
    rendered, observed = noisy_pair(6, 7)
    for figure in (images.psnr_db, images.ssim, images.ms_ssim):
        with pytest.raises(ValueError, match="two images"):
            figure(rendered[:5], observed)
        with pytest.raises(ValueError, match="finite"):
            figure(np.full_like(observed, np.nan), observed)
