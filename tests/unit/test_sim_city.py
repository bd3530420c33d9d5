"""The simulated town: exact, deterministic, free where the car drives, the same where it comes back."""

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from helpers.kitti_recording import pose_line

from vtslam.common.frame import Frame
from vtslam.services.sensor.sources import sim_stereo
from vtslam.services.sensor.sources.base import SourceError
from vtslam.services.sensor.sources.registry import open_source
from vtslam.services.sensor.sources.sim_city import SimCity
from vtslam.services.sensor.sources.sim_city_bodies import body_arrays
from vtslam.services.sensor.sources.sim_city_layout import town_bodies
from vtslam.services.sensor.sources.sim_city_path import CRUISE_M, lap_path, recorded_path
from vtslam.services.sensor.sources.sim_city_path import Path as Drive
from vtslam.services.sensor.sources.sim_city_streets import path_streets

Floats = npt.NDArray[np.float64]


@pytest.fixture(scope="module")
def city() -> SimCity:
    """Two clean laps."""
    return SimCity(laps=2, noise="none", size=(310, 94))


def there_and_back() -> tuple[Floats, Floats]:
    """Places [F,2] and headings [F]: 80 m ahead, a turn to the right around a loop, and 60 m back on the other side."""
    ahead = np.stack([np.zeros(80), np.arange(80.0)], axis=1)
    angle = np.linspace(0.0, np.pi, 24)
    turn = np.stack([1.75 - 1.75 * np.cos(angle), 80.0 + 12.0 * np.sin(angle)], axis=1)
    back = np.stack([np.full(60, 3.5), 79.0 - np.arange(60.0)], axis=1)
    places = np.concatenate([ahead, turn, back])
    steps = np.gradient(places, axis=0)
    return places, np.unwrap(np.arctan2(steps[:, 0], steps[:, 1]))


def world_points(source: SimCity, frame: Frame) -> Floats:
    pose = source.ground_truth()[frame.frame_id]
    seen = frame.camera.back_projected(frame.depth_m())[frame.depth > 0].astype(np.float64)
    return np.asarray(seen @ pose[:3, :3].T + pose[:3, 3])


@pytest.mark.parametrize(("first", "second"), [(0, 1), (30, 32), (60, 61), (5, 420)])
def test_depth_and_colour_agree_between_frames_placed_by_ground_truth(city: SimCity, first: int, second: int) -> None:
    one, other = city.frame(first), city.frame(second)
    poses = city.ground_truth()
    T = np.linalg.inv(poses[second]) @ poses[first]
    points = one.camera.back_projected(one.depth_m()) @ T[:3, :3].T + T[:3, 3]
    ahead = points[..., 2] > 1.0
    pixels = (one.camera.projected(np.where(ahead[..., None], points, 1.0)) - 0.5).astype(np.float32)
    z = points[..., 2]
    inverse = (1.0 / np.maximum(other.depth_m(), 0.1)).astype(np.float32)
    found = 1.0 / cv2.remap(inverse, pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR, borderValue=10.0)
    rough = (np.abs(cv2.Laplacian(inverse, cv2.CV_32F, ksize=1)) > 2e-3 * inverse).astype(np.float32)
    near_edge = cv2.remap(rough, pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR, borderValue=1.0) > 0
    both = ahead & (one.depth > 0) & ~near_edge & (np.abs(found - z) < 0.05 * z)
    assert both.mean() > 0.15
    assert np.median((np.abs(found - z) / z)[both]) < 2e-3
    colour = cv2.remap(other.rgb_float(), pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR)
    assert np.median(np.abs(colour - one.rgb_float())[both]) < 0.06


def test_depth_is_that_of_the_ray_through_the_pixel_centre() -> None:
    coarse = SimCity(noise="none", size=(62, 18)).frame(7)
    fine = SimCity(noise="none", size=(62 * 5, 18 * 5)).frame(7)  # every fifth pixel centre is one of the coarse image
    np.testing.assert_array_equal(coarse.depth, fine.depth[2::5, 2::5])


def test_the_camera_is_165_cm_above_flat_ground(city: SimCity) -> None:
    heights = -city.ground_truth()[:, 1, 3]
    assert np.abs(heights - 1.65).max() < 0.05
    points = world_points(city, city.frame(12))
    assert points[:, 1].max() < 0.05  # y is down: nothing lies below the ground
    assert (np.abs(points[:, 1]) < 0.02).mean() > 0.2


def test_frames_do_not_depend_on_order_or_on_threads(city: SimCity) -> None:
    ahead, back = (SimCity(size=(64, 20), traffic=40) for _ in range(2))
    forwards = [ahead.frame(i) for i in range(4)]
    backwards = [back.frame(i) for i in reversed(range(4))][::-1]
    for a, b in zip(forwards, backwards, strict=True):
        np.testing.assert_array_equal(a.rgb, b.rgb)
        np.testing.assert_array_equal(a.depth, b.depth)
    town, k = city._built(), city.camera
    for threads in (1, 3):
        rgb, _ = town.render(
            city.ground_truth()[10], k.width, k.height, (k.fx, k.fy, k.cx, k.cy), *body_arrays([], []), threads
        )
        np.testing.assert_array_equal(rgb, city.frame(10).rgb)


def test_seeds_differ_and_times_are_those_of_10_hz() -> None:
    one, two = SimCity(seed=0, size=(32, 24)), SimCity(seed=1, size=(32, 24))
    assert not np.array_equal(one.frame(0).rgb, two.frame(0).rgb)
    assert [one.frame(i).capture_time_ns for i in range(3)] == [0, 100_000_000, 200_000_000]


def test_intrinsics_are_those_of_kitti_scaled(city: SimCity) -> None:
    full = SimCity().camera
    assert (full.width, full.height, full.fx, full.cx, full.cy) == (1241, 376, 718.856, 607.6928, 185.7157)
    assert city.camera == full.resized(310, 94)
    assert open_source("sim:city", size=(620, 188)).camera == full.resized(620, 188)


def test_laps_close_and_are_as_long_as_asked() -> None:
    one, three = lap_path(lap_m=300, laps=1), lap_path(lap_m=300, laps=3)
    assert abs(len(three) - 3 * len(one)) <= 3
    assert one.driven_m()[-1] == pytest.approx(300.0, abs=CRUISE_M + 0.5)  # frames cut corners by centimetres
    assert np.linalg.norm(one.places_m[-1] - one.places_m[0]) < CRUISE_M
    assert three.headings[-1] - three.headings[0] == pytest.approx(6.0 * np.pi, abs=0.2)
    assert np.abs(np.diff(three.headings)).max() < np.radians(3.5)


def test_nothing_stands_where_the_car_drives() -> None:
    places, headings = there_and_back()
    bodies = town_bodies(path_streets(Drive(places_m=places, headings=headings)), places, seed=4)
    assert len(bodies) > 100
    for body in bodies:
        x, z, cosine, sine, half_x, half_z, low, _ = body.place
        if low > 3.0:
            continue  # lamps reach over the street
        d = places - np.array([x, z])
        along, across = d @ np.array([cosine, sine]), d @ np.array([-sine, cosine])
        away = np.hypot(np.maximum(np.abs(along) - half_x, 0.0), np.maximum(np.abs(across) - half_z, 0.0))
        assert away.min() > 1.0


def test_a_street_driven_back_is_one_street() -> None:
    places, headings = there_and_back()
    streets = path_streets(Drive(places_m=places, headings=headings))
    length = sum(np.linalg.norm(np.diff(street, axis=0), axis=1).sum() for street in streets)
    assert 60.0 + 80.0 < length < 60.0 + 80.0 + 40.0  # the run-out, the street, the turn; not the way back


def test_a_trajectory_gives_place_and_heading(tmp_path: Path) -> None:
    places, headings = there_and_back()
    file = tmp_path / "05.txt"
    file.write_text("".join(pose_line(x, 7.0, z, h) for (x, z), h in zip(places.tolist(), headings, strict=True)))
    source = open_source(f"sim:city?trajectory={file}&noise=none", size=(124, 38))
    assert isinstance(source, SimCity)
    poses = source.ground_truth()
    np.testing.assert_allclose(poses[:, [0, 2], 3], places, atol=1e-9)
    np.testing.assert_allclose(
        np.arctan2(poses[:, 0, 2], poses[:, 2, 2]), np.arctan2(np.sin(headings), np.cos(headings))
    )
    for index in (0, 50, 90, 130):
        depth = source.frame(index).depth_m()
        assert depth[depth > 0].min() > 1.0
    assert len(open_source(source.uri)) == len(places)


def test_oncoming_cars_move_and_leave_the_car_alone() -> None:
    empty, busy = (SimCity(noise="none", traffic=t, size=(155, 47)) for t in (0, 60))
    changed = [(empty.frame(i).depth != busy.frame(i).depth).mean() for i in range(0, 40, 4)]
    assert max(changed) > 0.01
    assert min(float(busy.frame(i).depth_m()[empty.frame(i).depth > 0].min()) for i in range(0, 40, 4)) > 0.8


def test_stereo_noise_grows_with_the_square_of_depth() -> None:
    clean, noisy = (SimCity(noise=n, size=(620, 188)).frame(20) for n in ("none", "stereo"))
    z, measured = clean.depth_m(), noisy.depth_m()
    assert not measured[z > sim_stereo.FARTHEST_M + 1.0].any()
    for low, high in ((5.0, 8.0), (10.0, 16.0), (20.0, 30.0)):
        ring = (z > low) & (z < high)
        score = (measured - z)[ring] / sim_stereo.sigma_m(z[ring])
        assert 0.8 < score.std() < 1.2
        assert abs(float(score.mean())) < 0.2


@pytest.mark.parametrize(
    ("uri", "text"),
    [
        ("sim:city?laps=0", "sim:city: laps must be 1 to 10000; got 0"),
        ("sim:city?laps=two", "sim:city: laps must be a whole number; got 'two'"),
        ("sim:city?block=20", "sim:city: block must be"),
        ("sim:city?traffic=-1", "sim:city: traffic must be 0 to 100; got -1"),
        ("sim:city?noise=kinect", "sim:city: noise must be one of none, stereo; got 'kinect'"),
        ("sim:city?lap=3", "sim:city: unknown option 'lap'; allowed are laps, block"),
        ("sim:city?trajectory=x.txt&laps=2", "sim:city: trajectory=FILE goes without laps and block"),
        ("sim:city?trajectory=/nowhere/00.txt", "/nowhere/00.txt: expected a readable text file"),
        ("sim:city?seed=-1", "sim:city: seed must be"),
    ],
)
def test_refusals(uri: str, text: str) -> None:
    with pytest.raises(SourceError) as caught:
        open_source(uri)
    assert str(caught.value).startswith(text)


def test_trajectories_that_cannot_be_driven(tmp_path: Path) -> None:
    file = tmp_path / "00.txt"
    for lines, text in (
        ("", "expected a pose in each line, found an empty file"),
        (pose_line(0, 0, 0, 0.0), "expected at least 2 poses, found 1"),
        (2 * pose_line(0, 0, 0, 0.0), "expected a path of at least 1 m, found 0.00 m"),
        ("1 0 0\n", ":1: expected 12 numbers, found 3"),
    ):
        file.write_text(lines)
        with pytest.raises(SourceError) as caught:
            recorded_path(file)
        assert text in str(caught.value)


def test_no_such_frame(city: SimCity) -> None:
    with pytest.raises(SourceError, match="frame must be 0 to"):
        city.frame(len(city))
