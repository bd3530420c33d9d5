from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
import pytest
from helpers.native_scene import as_floats

from vtslam.common.optim.adam import Adam
from vtslam.common.optim.mapping_loss import MappingLoss, mapping_loss
from vtslam.common.splat import _native
from vtslam.common.splat.engine import FloatArray

Float64 = npt.NDArray[np.float64]


@pytest.fixture(params=_native.available_simd(), autouse=True)
def simd(request: pytest.FixtureRequest) -> Iterator[str]:
    before = _native.simd()
    _native.select_simd(request.param)
    yield request.param
    _native.select_simd(before)


def _images(width: int, height: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    rng = np.random.default_rng(5)
    size = (height, width)
    target_depth = rng.uniform(0.5, 3.0, size) * (rng.uniform(size=size) > 0.3)
    return (
        as_floats(rng.uniform(size=(*size, 3))),
        as_floats(rng.uniform(0.5, 3.0, size)),
        as_floats(rng.uniform(size=(*size, 3))),
        as_floats(target_depth),
    )


def _filtered(image: Float64) -> Float64:
    """11x11 Gaussian window of sigma 1.5, zeros beyond the border."""
    window = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    window /= window.sum()
    for axis in (0, 1):
        padded = np.pad(image, [(5, 5) if a == axis else (0, 0) for a in range(3)])
        image = sum(w * np.take(padded, range(k, k + image.shape[axis]), axis) for k, w in enumerate(window))
    return image


def _ssim(x: Float64, y: Float64) -> float:
    mx, my = _filtered(x), _filtered(y)
    a = (2 * mx * my + 1e-4) * (2 * (_filtered(x * y) - mx * my) + 9e-4)
    b = (mx**2 + my**2 + 1e-4) * (_filtered(x * x) - mx**2 + _filtered(y * y) - my**2 + 9e-4)
    return float((a / b).mean())


@pytest.mark.parametrize(("width", "height"), [(37, 23), (3, 4), (1, 1)])
def test_loss_terms_are_those_of_the_definition(width: int, height: int) -> None:
    images = _images(width, height)
    rgb, depth, target, target_depth = (image.astype(np.float64) for image in images)
    result = mapping_loss(*images, weight_color=0.7, weight_depth=1.3, ssim_share=0.2)
    valid = target_depth > 0
    depth_l1 = np.abs(depth - target_depth)[valid].mean() if valid.any() else 0.0
    assert result.color_l1 == pytest.approx(np.abs(rgb - target).mean(), rel=1e-6)
    assert result.ssim == pytest.approx(_ssim(rgb, target), abs=1e-6)
    assert result.depth_l1_m == pytest.approx(depth_l1, rel=1e-6)
    expected = 0.7 * (0.8 * result.color_l1 + 0.2 * (1 - result.ssim)) + 1.3 * depth_l1
    assert result.loss == pytest.approx(expected, rel=1e-6)


def test_colour_gradient_is_that_of_finite_differences() -> None:
    rgb, depth, target, target_depth = _images(17, 13)
    d_rgb = mapping_loss(rgb, depth, target, target_depth, weight_color=0.7, weight_depth=1.3).d_rgb
    x, y = rgb.astype(np.float64), target.astype(np.float64)

    def loss(image: Float64) -> float:
        return float(0.7 * (0.8 * np.abs(image - y).mean() + 0.2 * (1 - _ssim(image, y))))

    rng = np.random.default_rng(0)
    for row, column, channel in rng.integers(0, (13, 17, 3), (25, 3)):
        step = np.zeros_like(x)
        step[row, column, channel] = 1e-5
        expected = (loss(x + step) - loss(x - step)) / 2e-5
        assert d_rgb[row, column, channel] == pytest.approx(expected, rel=1e-4, abs=1e-8)


def test_depth_gradient_is_a_sign_over_the_valid_pixels() -> None:
    rgb, depth, target, target_depth = _images(17, 13)
    depth[0, 0] = target_depth[0, 0] = 1.0
    result = mapping_loss(rgb, depth, target, target_depth, weight_depth=2.0)
    valid = target_depth > 0
    expected = 2.0 * np.sign(depth - target_depth) * valid / valid.sum()
    np.testing.assert_allclose(result.d_depth, expected, rtol=1e-6)
    assert result.d_depth[0, 0] == 0.0


def test_a_mask_leaves_pixels_out_of_the_absolute_errors() -> None:
    rgb, depth, target, target_depth = _images(17, 13)
    mask = (np.random.default_rng(1).uniform(size=(13, 17)) > 0.5).astype(np.uint8)
    result = mapping_loss(rgb, depth, target, target_depth, ssim_share=0.0, mask=mask)
    kept, valid = mask > 0, (mask > 0) & (target_depth > 0)
    assert result.color_l1 == pytest.approx(np.abs(rgb - target)[kept].mean(), rel=1e-5)
    assert result.depth_l1_m == pytest.approx(np.abs(depth - target_depth)[valid].mean(), rel=1e-5)
    assert result.ssim == 1.0
    assert not result.d_rgb[~kept].any()
    np.testing.assert_allclose(np.abs(result.d_rgb[kept]), 1.0 / (3 * kept.sum()), rtol=1e-5)


def test_without_any_counted_pixel_the_absolute_terms_are_zero() -> None:
    rgb, depth, target, _ = _images(17, 13)
    none = np.zeros_like(depth)
    result = mapping_loss(rgb, depth, target, none, ssim_share=0.0, mask=none.astype(np.uint8))
    assert result.loss == 0.0
    assert not result.d_rgb.any()
    assert not result.d_depth.any()


def test_loss_bytes_do_not_depend_on_threads() -> None:
    def run(threads: int) -> MappingLoss:
        return mapping_loss(*_images(70, 45), threads=threads)

    one = run(1)
    for other in (run(2), run(4)):
        assert one.loss == other.loss
        assert one.d_rgb.tobytes() == other.d_rgb.tobytes()
        assert one.d_depth.tobytes() == other.d_depth.tobytes()


@pytest.mark.parametrize("name", ["rgb", "depth_m", "target_rgb"])
def test_loss_refuses_values_that_are_not_finite(name: str) -> None:
    rgb, depth, target, target_depth = _images(17, 13)
    array = {"rgb": rgb, "depth_m": depth, "target_rgb": target}[name]
    target_depth[2, 3] = 1.0
    array[2, 3] = np.nan
    with pytest.raises(ValueError, match=rf"{name} must be finite, got nan at \[2, 3"):
        mapping_loss(rgb, depth, target, target_depth)


def test_loss_refuses_images_of_other_sizes() -> None:
    rgb, depth, target, target_depth = _images(17, 13)
    with pytest.raises(ValueError, match=r"target_rgb must be float32 \[13, 17, 3\], got float32 \[13, 16, 3\]"):
        mapping_loss(rgb, depth, as_floats(target[:, :16]), target_depth)


def _adam_float64(start: Float64, gradients: list[Float64], lr: float, eps: float) -> Float64:
    x, m, v = start.copy(), np.zeros_like(start), np.zeros_like(start)
    for step, g in enumerate(gradients, 1):
        m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g * g
        x -= lr * (m / (1 - 0.9**step)) / (np.sqrt(v / (1 - 0.999**step)) + eps)
    return x


@pytest.mark.parametrize("shape", [(5, 3), (37,), (0, 3)])
def test_adam_follows_its_definition(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(2)
    start = as_floats(rng.normal(size=shape))
    gradients = [as_floats(rng.normal(size=shape) * 10.0 ** rng.integers(-6, 2)) for _ in range(20)]
    x, adam = start.copy(), Adam(shape, lr=0.01, eps=1e-8)
    for gradient in gradients:
        adam.step(x, gradient)
    expected = _adam_float64(start.astype(np.float64), [g.astype(np.float64) for g in gradients], 0.01, 1e-8)
    np.testing.assert_allclose(x, expected, rtol=1e-5, atol=1e-6)


def test_adam_moves_nothing_without_a_gradient() -> None:
    x = as_floats(np.arange(40))
    Adam((40,), lr=1.0).step(x, np.zeros(40, np.float32))
    np.testing.assert_array_equal(x, np.arange(40))


def test_adam_grows_by_rows_without_moments() -> None:
    adam = Adam((4, 3), lr=0.1)
    adam.step(np.zeros((4, 3), np.float32), np.ones((4, 3), np.float32))
    adam.grow(2)
    x = np.zeros((6, 3), np.float32)
    adam.step(x, as_floats(np.repeat([[0.0], [1.0]], 3, 0) * np.ones(3)))
    assert adam.step_count == 2
    assert (x[:3] < 0.0).all()  # the moments of the first step
    assert (x[5] < 0.0).all()
    assert (np.abs(x[5]) > np.abs(x[0])).all()


def test_adam_steps_by_a_share_of_its_rate_and_keeps_chosen_rows() -> None:
    gradients = np.array([[1.0], [-2.0], [3.0]], np.float32)
    half, whole = Adam((3, 1), lr=0.1, eps=1e-9), Adam((3, 1), lr=0.05, eps=1e-9)
    a, b = np.zeros((3, 1), np.float32), np.zeros((3, 1), np.float32)
    half.step(a, gradients, rate=0.5)
    whole.step(b, gradients)
    assert a.tobytes() == b.tobytes()
    assert (a != 0).all()
    half.thin(np.array([False, True]))  # of the last two
    np.testing.assert_array_equal(half.m, whole.m[[0, 2]])
    np.testing.assert_array_equal(half.v, whole.v[[0, 2]])


def test_adam_refuses_misfit_arrays() -> None:
    adam = Adam((4,), lr=0.1)
    with pytest.raises(ValueError, match=r"gradients must be float32 \[4\], got float32 \[5\]"):
        adam.step(np.zeros(4, np.float32), np.zeros(5, np.float32))
    fixed = np.zeros(4, np.float32)
    fixed.flags.writeable = False
    with pytest.raises(ValueError, match="parameters must be writable"):
        adam.step(fixed, np.zeros(4, np.float32))
    with pytest.raises(ValueError, match="Adam takes"):
        Adam((4,), lr=-1.0)
