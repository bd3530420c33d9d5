"""Ties hold for any camera, depth and pose."""

from dataclasses import fields

import numpy as np
import numpy.typing as npt
from hypothesis import given
from hypothesis import strategies as st

from vtslam.common.gaussians import SUBPIXEL_OFFSETS_PX, ViewTiedGaussians
from vtslam.common.geometry import se3
from vtslam.common.geometry.camera import Camera

cameras = st.builds(
    Camera,
    width=st.integers(1, 2000),
    height=st.integers(1, 2000),
    fx=st.floats(5.0, 3000.0),
    fy=st.floats(5.0, 3000.0),
    cx=st.floats(-100.0, 2100.0),
    cy=st.floats(-100.0, 2100.0),
)
twists = st.lists(st.floats(-2.0, 2.0), min_size=6, max_size=6).map(np.array)


@given(cameras, twists, st.floats(1e-4, 5e-3), st.integers(0, 2**32 - 1))
def test_every_gaussian_projects_to_its_tie_from_any_pose(
    camera: Camera, twist: npt.NDArray[np.float64], unit_m: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    count = 50
    gaussians = ViewTiedGaussians(
        frame_index=rng.integers(0, 3, count).astype(np.uint16),
        pixel=rng.integers(0, camera.width * camera.height, count).astype(np.int32),
        subpixel=rng.integers(0, 5, count).astype(np.uint8),
        depth=rng.integers(1, 2**16, count).astype(np.uint16),
        colors=np.zeros((count, 3), np.float32),
        log_radii=np.zeros(count, np.float32),
        opacity_logits=np.zeros(count, np.float32),
    )
    points = gaussians.points_frame_m(camera, depth_unit_m=unit_m)
    rows, columns = np.divmod(gaussians.pixel, camera.width)
    expected = np.stack([columns, rows], axis=1) + 0.5 + SUBPIXEL_OFFSETS_PX[gaussians.subpixel]
    np.testing.assert_allclose(camera.projected(points), expected, atol=1e-6)
    np.testing.assert_allclose(points[:, 2], gaussians.depth * unit_m, rtol=1e-12)
    poses = np.stack([se3.exp((k + 1) * twist / 3) for k in range(3)])
    means = gaussians.means_m(camera, poses, depth_unit_m=unit_m)
    some = ViewTiedGaussians(**{each.name: getattr(gaussians, each.name)[7:23] for each in fields(gaussians)})
    assert some.means_m(camera, poses, depth_unit_m=unit_m).tobytes() == means[7:23].tobytes()
    for row in range(count):
        T = poses[gaussians.frame_index[row]]
        # float32 rounds relative to the largest coordinate.
        scale = 1.0 + float(np.abs(points[row]).max())
        np.testing.assert_allclose(means[row], T[:3, :3] @ points[row] + T[:3, 3], atol=4e-7 * scale)
