"""The simulated room: exact, deterministic, rich in texture, refusing what it does not know."""

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from vtslam.common.frame import Frame
from vtslam.services.sensor.sources import sim_kinect
from vtslam.services.sensor.sources._raycast import Scene, fractal_noise
from vtslam.services.sensor.sources.base import Source, SourceError, SourceUri
from vtslam.services.sensor.sources.sim_layout import furnished_room
from vtslam.services.sensor.sources.sim_room import SimRoom

FloatImage = npt.NDArray[np.float32]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return furnished_room(0, num_threads=1)


def reprojected(source: Source, first: Frame, second: Frame) -> tuple[FloatImage, FloatImage, FloatImage]:
    """Where ``first``'s pixels lie in ``second``: depth there (m), and image coordinates for cv2.remap, [H,W]."""
    poses = source.ground_truth()
    assert poses is not None
    T_second_first = np.linalg.inv(poses[second.frame_id]) @ poses[first.frame_id]
    points = first.camera.back_projected(first.depth_m()) @ T_second_first[:3, :3].T + T_second_first[:3, 3]
    pixels = first.camera.projected(points) - 0.5
    z, u, v = points[..., 2], pixels[..., 0], pixels[..., 1]
    return z.astype(np.float32), u.astype(np.float32), v.astype(np.float32)


def covered_and_smooth(
    second: Frame, z: FloatImage, u: FloatImage, v: FloatImage
) -> tuple[npt.NDArray[np.bool_], FloatImage]:
    """Pixels seen in both frames, away from edges and creases; and the depth found in the second frame (m)."""
    inverse = 1.0 / second.depth_m()  # linear over the image on planes, so bilinear reading is exact there
    found = 1.0 / cv2.remap(inverse, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0.1)
    rough = (np.abs(cv2.Laplacian(inverse, cv2.CV_32F, ksize=1)) > 1.5e-3 * inverse).astype(np.float32)
    near_edge = cv2.remap(rough, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=1.0) > 0.0
    return ~near_edge & (np.abs(found - z) < 0.05), np.asarray(found, np.float32)


@pytest.mark.parametrize(("first", "second"), [(0, 1), (3, 8), (29, 30), (58, 1)])
def test_depth_and_colour_agree_between_frames_placed_by_ground_truth(first: int, second: int) -> None:
    source = SimRoom(frames=60, size=(320, 240))
    one, other = source.frame(first), source.frame(second)
    z, u, v = reprojected(source, one, other)
    both, found = covered_and_smooth(other, z, u, v)
    assert both.mean() > 0.4
    assert np.median(np.abs(found - z)[both]) < 0.0001  # half a step of 0.2 mm
    assert np.quantile(np.abs(found - z)[both], 0.95) < 0.0005
    colour = cv2.remap(other.rgb_float(), u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    difference = (colour - one.rgb_float())[both]
    assert abs(float(difference.mean())) < 0.002
    assert 10.0 * np.log10(1.0 / np.mean(difference**2)) > 37.0


def test_depth_is_that_of_the_ray_through_the_pixel_centre() -> None:
    source = SimRoom(frames=60, size=(33, 17))
    fine = SimRoom(frames=60, size=(33 * 5, 17 * 5))  # every fifth pixel centre is one of the coarse image
    np.testing.assert_array_equal(source.frame(7).depth, fine.frame(7).depth[2::5, 2::5])


def test_every_pixel_sees_a_surface_at_indoor_distance() -> None:
    source = SimRoom(frames=300, size=(48, 36))
    depths = np.stack([source.frame(i).depth_m() for i in range(0, 300, 5)])
    assert depths.min() > 0.5
    assert depths.max() < 6.0


@pytest.mark.parametrize("size", [(1, 1), (33, 17), (5, 64)])
def test_odd_sizes(size: tuple[int, int]) -> None:
    source = SimRoom(frames=2, size=size, noise="kinect")
    frame = source.frame(1)
    assert frame.rgb.shape == (size[1], size[0], 3)
    assert frame.camera == source.camera
    assert source.camera.fx == source.camera.fy == pytest.approx(525.0 / 640.0 * size[0])


@pytest.mark.parametrize("size", [(320, 240), (640, 480)])
@pytest.mark.parametrize("index", [0, 30])
def test_images_lose_detail_when_shrunk_to_half(size: tuple[int, int], index: int) -> None:
    rgb = SimRoom(frames=60, size=size).frame(index).rgb
    small = cv2.resize(rgb, (size[0] // 2, size[1] // 2), interpolation=cv2.INTER_AREA)
    for interpolation in (cv2.INTER_LINEAR, cv2.INTER_CUBIC):
        back = cv2.resize(small, size, interpolation=interpolation).astype(np.float64)
        assert 10.0 * np.log10(255.0**2 / np.mean((back - rgb) ** 2)) <= 31.0


def test_frames_do_not_depend_on_the_order_of_reading() -> None:
    ahead, back = (SimRoom(frames=5, size=(64, 48), noise="kinect") for _ in range(2))
    forwards = [ahead.frame(i) for i in range(5)]
    backwards = [back.frame(i) for i in reversed(range(5))][::-1]
    for a, b in zip(forwards, backwards, strict=True):
        np.testing.assert_array_equal(a.rgb, b.rgb)
        np.testing.assert_array_equal(a.depth, b.depth)


def test_bytes_do_not_depend_on_the_number_of_threads(scene: Scene) -> None:
    source = SimRoom(frames=60, size=(100, 70))
    k = source.camera
    pose = source.ground_truth()[10]
    images = [scene.render(pose, k.width, k.height, (k.fx, k.fy, k.cx, k.cy), n) for n in (1, 2, 4)]
    for other in images[1:]:
        for a, b in zip(images[0], other, strict=True):
            np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(images[0][0], source.frame(10).rgb)  # of a scene built with other threads


def test_seeds_differ_and_times_are_those_of_30_hz() -> None:
    one, two = SimRoom(frames=4, seed=0, size=(32, 24)), SimRoom(frames=4, seed=1, size=(32, 24))
    assert not np.array_equal(one.frame(0).rgb, two.frame(0).rgb)
    assert not np.allclose(one.ground_truth(), two.ground_truth())
    assert [one.frame(i).capture_time_ns for i in range(3)] == [0, 33_333_333, 66_666_666]
    assert [one.frame(i).frame_id for i in range(3)] == [0, 1, 2]


def test_half_way_through_60_frames_the_view_is_another() -> None:
    source = SimRoom(frames=60, size=(80, 60))
    poses = source.ground_truth()
    turn = np.linalg.inv(poses[0]) @ poses[30]
    assert np.degrees(np.arccos(turn[2, 2])) > 30.0  # of a horizontal field of view of 63
    assert np.linalg.norm(turn[:3, 3]) > 0.2


def test_kinect_noise_has_the_stated_statistics() -> None:
    clean, noisy = (SimRoom(frames=60, size=(320, 240), noise=n).frame(20) for n in ("none", "kinect"))
    z, measured = clean.depth_m(), noisy.depth_m()
    box = np.ones((5, 5), np.uint8)
    flat = cv2.dilate(z, box) < 1.02 * cv2.erode(z, box)
    seen = flat & (measured > 0.0)
    score = (measured - z)[seen] / sim_kinect.axial_sigma_m(z[seen])
    assert abs(float(score.mean())) < 0.1
    assert 0.95 < score.std() < 1.4  # the rounding of disparity adds to the axial noise
    holes = measured == 0.0
    assert 0.005 < holes.mean() < 0.2
    assert holes[~flat].mean() > 5.0 * holes[flat].mean()
    colour = (noisy.rgb.astype(np.float64) - clean.rgb)[(clean.rgb > 10) & (clean.rgb < 245)]
    assert colour.std() == pytest.approx(np.hypot(sim_kinect.COLOUR_SIGMA, np.sqrt(1.0 / 12.0)), rel=0.03)
    assert abs(float(colour.mean())) < 0.02


def test_kinect_sees_nothing_too_near_or_at_a_grazing_angle() -> None:
    rng = np.random.default_rng(0)
    facing, grazing = np.ones((4, 6), np.float32), np.full((4, 6), 0.05, np.float32)
    assert (sim_kinect.noisy_depth(np.full((4, 6), 0.39), facing, rng) == 0.0).all()
    assert (sim_kinect.noisy_depth(np.full((4, 6), 2.0), grazing, rng) == 0.0).all()
    np.testing.assert_allclose(sim_kinect.noisy_depth(np.full((4, 6), 2.0), facing, rng), 2.0, atol=0.05)


def test_uri_opens_the_same_source_again() -> None:
    first = SimRoom.open(SourceUri.parse("sim:room?frames=7&seed=1&noise=kinect"), size=(40, 30))
    assert first.uri == "sim:room?frames=7&seed=1&noise=kinect&size=40x30"
    second = SimRoom.open(SourceUri.parse(first.uri))
    assert (len(second), second.camera, second.family) == (7, first.camera, "tum")
    np.testing.assert_array_equal(first.ground_truth(), second.ground_truth())
    np.testing.assert_array_equal(first.frame(5).depth, second.frame(5).depth)


def test_defaults() -> None:
    assert SimRoom.open(SourceUri.parse("sim:room")).uri == "sim:room?frames=120&seed=0&noise=none&size=640x480"


@pytest.mark.parametrize(
    ("uri", "text"),
    [
        ("sim:hall", "sim:room"),
        ("sim:room?colour=red", "unknown option 'colour'; allowed are frames, seed, noise and size"),
        ("sim:room?frames=1", "frames must be 2 to 100000; got 1"),
        ("sim:room?frames=many", "frames must be a whole number; got 'many'"),
        ("sim:room?seed=-1", "seed must be 0 to 2147483647; got -1"),
        ("sim:room?noise=loud", "noise must be one of none, kinect; got 'loud'"),
        ("sim:room?size=320", "size must read WxH, as in 320x240; got '320'"),
        ("sim:room?size=0x10", "size, width must be 1 to 8192; got 0"),
        ("sim:room?size=10x9000", "size, height must be 1 to 8192; got 9000"),
    ],
)
def test_options_are_refused_by_name(uri: str, text: str) -> None:
    with pytest.raises(SourceError) as caught:
        SimRoom.open(SourceUri.parse(uri))
    assert text in str(caught.value)


@pytest.mark.parametrize("index", [-1, 4])
def test_frames_outside_are_refused(index: int) -> None:
    with pytest.raises(SourceError, match=f"frame must be 0 to 3; got {index}"):
        SimRoom(frames=4).frame(index)


def test_noise_octaves_are_seamless_and_of_the_stated_deviation() -> None:
    noise = fractal_noise(128, 256, 16, 32, 1, 1.0, 5, 2)
    assert noise.std() == pytest.approx(0.83, rel=0.03)
    assert abs(float(noise.mean())) < 0.05
    steps = np.abs(np.diff(noise, axis=1))
    assert np.abs(noise[:, 0] - noise[:, -1]).max() <= 1.1 * steps.max()


def small_scene(
    *, kind: int = 0, num_centres: int = 1, texture: int = 0, texels: tuple[int, int] = (4, 4), num_lights: int = 0
) -> Scene:
    return Scene(
        kind=np.array([kind], np.int32),
        centre=np.ones((num_centres, 3)),
        rotation=np.eye(3)[None],
        size=np.ones((1, 3)),
        face_texture=np.full((1, 6), texture, np.int32),
        face=np.ones((1, 6, 8), np.float32),
        textures=[np.zeros((*texels, 3), np.uint8)],
        lights=np.ones((num_lights, 7)),
        ambient=np.ones(3, np.float32),
        num_threads=1,
    )


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"num_centres": 2}, "same length"),
        ({"kind": 4}, "kind must be"),
        ({"texture": 1}, "texture that does not exist"),
        ({"num_lights": 5}, "at most 4 lights"),
        ({"texels": (3, 4)}, "powers of two"),
    ],
)
def test_ray_caster_refuses_scenes_that_do_not_fit_together(change: dict[str, Any], text: str) -> None:
    small_scene()
    with pytest.raises(ValueError, match=text):
        small_scene(**change)


def test_nothing_hit_is_depth_zero() -> None:
    rgb, depth_m, cosine = small_scene().render(np.eye(4), 4, 3, (100.0, 100.0, 2.0, 1.5), 1)
    assert not rgb.any()
    assert not depth_m.any()
    assert not cosine.any()
