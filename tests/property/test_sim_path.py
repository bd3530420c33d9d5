"""The path of the simulated camera keeps its limits for every length and seed."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from vtslam.common.geometry import se3
from vtslam.services.sensor.sources import sim_path

CENTRE_M = (2.5, 2.0, 1.35)


@settings(max_examples=60, deadline=None)
@given(frames=st.integers(2, 2000), seed=st.integers(0, 2**31 - 1))
def test_steps_keep_their_limits_all_around_the_closed_path(frames: int, seed: int) -> None:
    poses = sim_path.poses(frames, centre_m=CENTRE_M, seed=seed)
    onward = np.roll(poses, -1, axis=0)
    steps_m = np.linalg.norm(onward[:, :3, 3] - poses[:, :3, 3], axis=1)
    trace = np.einsum("fij,fij->f", poses[:, :3, :3], onward[:, :3, :3])
    turns_deg = np.degrees(np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0)))
    assert steps_m.max() < 0.03
    assert turns_deg.max() < 3.0
    assert 0.015 < steps_m.mean() < 0.02
    assert 0.9 < turns_deg.mean() < 2.0


@settings(max_examples=25, deadline=None)
@given(frames=st.integers(2, 2000), seed=st.integers(0, 2**31 - 1))
def test_poses_are_rigid_upright_and_near_the_middle_of_the_room(frames: int, seed: int) -> None:
    poses = sim_path.poses(frames, centre_m=CENTRE_M, seed=seed)
    assert all(se3.is_rigid(T, tolerance=1e-12) for T in poses[:: max(1, frames // 50)])
    assert (poses[:, 2, 1] < -0.8).all()  # the camera's downward axis
    offset = np.abs(poses[:, :3, 3] - np.array(CENTRE_M))
    assert (offset.max(axis=0) < (1.2, 0.8, 0.2)).all()
