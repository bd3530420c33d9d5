import numpy as np
import pytest

from vtslam.common.frame import Frame
from vtslam.common.geometry.camera import Camera

CAMERA = Camera(width=64, height=48, fx=58.5, fy=57.0, cx=32.5, cy=23.0)


def frame(camera: Camera = CAMERA, *, rgb: np.ndarray | None = None, depth: np.ndarray | None = None) -> Frame:
    size = (camera.height, camera.width)
    return Frame(
        frame_id=7,
        capture_time_ns=11,
        rgb=np.zeros((*size, 3), np.uint8) if rgb is None else rgb,
        depth=np.ones(size, np.uint16) if depth is None else depth,
        depth_scale_m=0.001,
        camera=camera,
    )


@pytest.mark.parametrize(("width", "height"), [(32, 24), (128, 96), (20, 48), (33, 17)])
def test_projecting_then_resizing_is_resizing_then_projecting(width: int, height: int) -> None:
    points = np.random.default_rng(0).uniform((-1, -1, 1), (1, 1, 5), (50, 3))
    scale = np.array([width / 64, height / 48])
    np.testing.assert_allclose(CAMERA.resized(width, height).projected(points), CAMERA.projected(points) * scale)


def test_resizing_back_gives_the_same_camera() -> None:
    again = CAMERA.resized(32, 24).resized(64, 48)
    assert again.as_dict() == pytest.approx(CAMERA.as_dict())


def test_integer_centred_principal_point() -> None:
    """The half-pixel term that plain scaling forgets."""
    camera = Camera.from_integer_centred(width=640, height=480, fx=585.0, fy=585.0, cx=320.0, cy=240.0)
    half = camera.resized(320, 240)
    assert (camera.cx, camera.cy) == (320.5, 240.5)
    assert (half.cx - 0.5, half.cy - 0.5) == ((320.0 + 0.5) / 2 - 0.5, (240.0 + 0.5) / 2 - 0.5)


def test_back_projection_hits_pixel_centres() -> None:
    depth_m = np.random.default_rng(0).uniform(0.5, 4.0, (48, 64)).astype(np.float32)
    points_m = CAMERA.back_projected(depth_m)
    v, u = np.mgrid[0:48, 0:64]
    np.testing.assert_allclose(CAMERA.projected(points_m), np.stack([u + 0.5, v + 0.5], axis=-1), atol=1e-4)
    np.testing.assert_array_equal(points_m[..., 2], depth_m)


def test_mean_focal_length() -> None:
    assert CAMERA.mean_focal_px == 57.75


@pytest.mark.parametrize("change", [{"fx": 0.0}, {"fy": -1.0}, {"width": 0}, {"height": 0}, {"cx": np.nan}])
def test_not_a_camera(change: dict[str, float]) -> None:
    values = {**CAMERA.as_dict(), **change}
    with pytest.raises(ValueError, match="not a camera: size"):
        Camera(
            width=int(values["width"]), height=int(values["height"]),
            fx=values["fx"], fy=values["fy"], cx=values["cx"], cy=values["cy"],
        )  # fmt: skip


def test_color_is_resized_by_area() -> None:
    rgb = np.zeros((48, 64, 3), np.uint8)
    rgb[:, 1::2] = 200
    small = frame(rgb=rgb).resized(32, 24)
    assert np.all(small.rgb == 100)
    assert small.camera == CAMERA.resized(32, 24)
    assert (small.frame_id, small.capture_time_ns, small.depth_scale_m) == (7, 11, 0.001)


def test_depth_is_resized_by_nearest() -> None:
    """No value that was not measured, and each from inside its new pixel."""
    depth = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64)
    small = frame(depth=depth).resized(16, 12).depth
    v, u = small // 64, small % 64
    assert np.all(v // 4 == np.arange(12)[:, None])
    assert np.all(u // 4 == np.arange(16)[None, :])


def test_same_size_is_the_same_frame() -> None:
    whole = frame()
    assert whole.resized(64, 48) is whole


def test_images_as_numbers() -> None:
    depth = np.full((48, 64), 1500, np.uint16)
    depth[0, 0] = 0
    whole = frame(rgb=np.full((48, 64, 3), 255, np.uint8), depth=depth)
    assert {whole.depth_m().dtype, whole.rgb_float().dtype} == {np.dtype(np.float32)}
    assert whole.depth_m()[0, 0] == 0.0
    assert whole.depth_m()[1, 1] == pytest.approx(1.5)
    assert whole.rgb_float().max() == 1.0


@pytest.mark.parametrize(
    ("rgb", "depth", "message"),
    [
        (np.zeros((48, 63, 3), np.uint8), None, r"rgb must be uint8 \(48, 64, 3\), got uint8 \(48, 63, 3\)"),
        (np.zeros((48, 64, 3), np.float32), None, "got float32"),
        (None, np.zeros((48, 64), np.uint8), r"depth must be uint16 \(48, 64\), got uint8"),
        (None, np.zeros((24, 64), np.uint16), r"got uint16 \(24, 64\)"),
    ],
)
def test_refuses_other_arrays(rgb: np.ndarray | None, depth: np.ndarray | None, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        frame(rgb=rgb, depth=depth)


@pytest.mark.parametrize("scale", [0.0, -0.001, np.nan])
def test_refuses_a_scale_that_is_not_positive(scale: float) -> None:
    with pytest.raises(ValueError, match="depth_scale_m must be positive"):
        Frame(**{**_fields(frame()), "depth_scale_m": scale})  # type: ignore[arg-type]


def _fields(of: Frame) -> dict[str, object]:
    return {name: getattr(of, name) for name in Frame.__slots__}
