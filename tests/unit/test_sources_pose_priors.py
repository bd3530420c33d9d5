from pathlib import Path

import numpy as np
import pytest
from helpers.recordings import ReplicaRecording, write_replica

from vtslam.common.geometry import se3
from vtslam.common.trajectory_io import write_trajectory
from vtslam.services.sensor.sources.base import Source, SourceError
from vtslam.services.sensor.sources.registry import open_source

FRAMES = 40


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> ReplicaRecording:
    return write_replica(tmp_path_factory.mktemp("priors") / "room", num_frames=FRAMES)


def errors(source: Source, truth: np.ndarray) -> np.ndarray:
    """Twists on ``T_camera_world`` from the truth to the priors, [F,6]."""
    priors = [source.frame(index).pose_prior for index in range(len(source))]
    return np.stack(
        [
            se3.log(se3.inverse(prior.T_world_camera) @ true)
            for prior, true in zip(priors, truth, strict=True)
            if prior is not None
        ]
    )


def test_a_frame_has_no_prior_unless_asked_for(recording: ReplicaRecording) -> None:
    assert open_source(recording.uri).frame(0).pose_prior is None


def test_true_poses_with_noise_are_as_bad_as_asked_for_and_the_same_at_each_reading(
    recording: ReplicaRecording,
) -> None:
    source = open_source(recording.uri, overrides={"prior": "0.3,2"})
    truth = source.ground_truth()
    assert truth is not None
    found = errors(source, truth)
    np.testing.assert_allclose(found[:, :3].std(), 0.3, rtol=0.25)
    np.testing.assert_allclose(np.rad2deg(found[:, 3:].std()), 2.0, rtol=0.25)
    prior = source.frame(3).pose_prior
    assert prior is not None
    np.testing.assert_allclose(np.diag(prior.covariance), [0.09] * 3 + [np.deg2rad(2.0) ** 2] * 3)

    part = open_source(source.uri, frames=(30, 35))
    np.testing.assert_array_equal(errors(part, truth[30:35]), found[30:35])
    np.testing.assert_array_equal(errors(open_source(part.uri), truth[30:35]), found[30:35])


def test_priors_of_a_file_belong_to_the_frames_of_their_time(recording: ReplicaRecording, tmp_path: Path) -> None:
    plain = open_source(recording.uri)
    times_ns = [plain.frame(index).capture_time_ns for index in range(3)]
    poses = np.stack([se3.exp(np.array([index, 0.0, 0.0, 0.0, 0.1, 0.0])) for index in range(3)])
    path = tmp_path / "poses.txt"
    write_trajectory(path, [times_ns[0], times_ns[1] + 9_000_000, times_ns[2] + 11_000_000], poses)

    source = open_source(recording.uri, overrides={"poses": str(path), "poses_sigma": "0.1,3"}, frames=(0, 4))
    for index, expected in enumerate([poses[0], poses[1], None, None]):
        prior = open_source(source.uri).frame(index).pose_prior
        assert (prior is None) == (expected is None)
        if prior is not None:
            np.testing.assert_allclose(prior.T_world_camera, expected, atol=1e-12)
            np.testing.assert_allclose(np.diag(prior.covariance)[2:4], [0.01, np.deg2rad(3.0) ** 2])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"prior": "0.3"}, "option prior: expected M,DEG, as in 0.3,0.5; found '0.3'"),
        ({"prior": "-1,0"}, "option prior: expected M,DEG"),
        ({"prior": "nan,0"}, "option prior: expected M,DEG"),
        ({"prior": "1,1", "poses": "x"}, "expected prior, or poses and poses_sigma; found both"),
        ({"poses_sigma": "1,1"}, "option poses_sigma: expected beside poses=FILE, found alone"),
        ({"poses": "nowhere.txt"}, "nowhere.txt: expected a readable trajectory, found No such file"),
    ],
)
def test_odd_options_are_refused(recording: ReplicaRecording, options: dict[str, str], message: str) -> None:
    with pytest.raises(SourceError, match=message):
        open_source(recording.uri, overrides=options)


def test_a_recording_without_true_poses_has_none_to_make_worse(tmp_path: Path) -> None:
    recording = write_replica(tmp_path / "room", num_frames=2)
    (recording.folder / "traj.txt").unlink()
    with pytest.raises(SourceError, match="option prior needs true poses, and the recording has none"):
        open_source(recording.uri, overrides={"prior": "1,1"})
