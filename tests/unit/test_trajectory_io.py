from pathlib import Path

import numpy as np
import pytest

from vtslam.common.geometry import se3
from vtslam.common.trajectory_io import TrajectoryError, read_trajectory, trajectory_text, write_trajectory

LINE = "0.5 1 2 3 0 0 0 1\n"


def poses(count: int) -> np.ndarray:
    rng = np.random.default_rng(1)
    return np.stack([se3.exp(rng.normal(0, 1.5, 6)) for _ in range(count)])


def test_round_trip(tmp_path: Path) -> None:
    path, written = tmp_path / "trajectory.txt", poses(50)
    times_ns = [1_305_031_102_175_304_123 + 33_333_333 * t for t in range(50)]
    write_trajectory(path, times_ns, written)
    read = read_trajectory(path)
    assert read.capture_times_ns.tolist() == times_ns
    np.testing.assert_allclose(read.poses, written, atol=1e-14)
    np.testing.assert_array_equal(read.poses[:, :3, 3], written[:, :3, 3])


def test_text() -> None:
    T = np.eye(4)
    T[:3, 3] = (0.1, -0.0, -2.5e-7)
    assert trajectory_text([1_000_000_007], T[None]) == "1.000000007 0.1 0.0 -2.5e-07 0.0 0.0 0.0 1.0\n"


def test_equal_poses_give_equal_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_trajectory(tmp_path / name, range(20), poses(20))
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_replaces_and_leaves_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "trajectory.txt"
    write_trajectory(path, range(9), poses(9))
    write_trajectory(path, range(2), poses(2))
    assert len(read_trajectory(path).poses) == 2
    assert [entry.name for entry in tmp_path.iterdir()] == ["trajectory.txt"]


def test_refused_poses_leave_the_file_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "trajectory.txt"
    path.write_text(LINE)
    with pytest.raises(TrajectoryError, match="pose 1: expected a rigid motion"):
        write_trajectory(path, [1, 2], np.stack([np.eye(4), np.full((4, 4), np.nan)]))
    assert path.read_text() == LINE


def test_failed_write_leaves_the_file_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "trajectory.txt"
    path.write_text(LINE)

    def full_disk(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full_disk)
    with pytest.raises(OSError, match="No space left"):
        write_trajectory(path, [1], np.eye(4)[None])
    assert path.read_text() == LINE
    assert [entry.name for entry in tmp_path.iterdir()] == ["trajectory.txt"]


@pytest.mark.parametrize("times_ns", [[3, 3], [3, 2], [-1, 2]])
def test_refuses_to_write_times_that_do_not_increase(times_ns: list[int]) -> None:
    with pytest.raises(TrajectoryError, match="expected a time after"):
        trajectory_text(times_ns, poses(2))


def test_refuses_to_write_other_lengths() -> None:
    with pytest.raises(TrajectoryError, match=r"expected poses \(3, 4, 4\), one for each time, found \(2, 4, 4\)"):
        trajectory_text([1, 2, 3], poses(2))


def test_empty_trajectory(tmp_path: Path) -> None:
    write_trajectory(tmp_path / "t", [], np.empty((0, 4, 4)))
    read = read_trajectory(tmp_path / "t")
    assert (read.capture_times_ns.shape, read.poses.shape) == ((0,), (0, 4, 4))


def test_reads_comments_and_quaternions_of_any_length(tmp_path: Path) -> None:
    (tmp_path / "t").write_text("# timestamp tx\n\n1e-1 1 2 3 0 0 2 2\n")
    read = read_trajectory(tmp_path / "t")
    assert read.capture_times_ns.tolist() == [100_000_000]
    np.testing.assert_allclose(read.poses[0, :2, :2], [[0, -1], [1, 0]], atol=1e-15)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("0.6 1 2 3 0 0 0", "expected 8 columns timestamp tx ty tz qx qy qz qw, found 7"),
        ("0.6 1 2 x 0 0 0 1", "expected a number, found 'x'"),
        ("0.6 1 2 nan 0 0 0 1", "expected finite numbers, found 1 2 nan 0 0 0 1"),
        ("0.6 1 2 3 0 0 0 0", "a quaternion must be finite and not zero, got [0.0, 0.0, 0.0, 0.0]"),
        ("0.5 1 2 3 0 0 0 1", "expected a time after 0.500000000, found 0.5"),
        ("now 1 2 3 0 0 0 1", "expected a time in seconds, found 'now'"),
        ("nan 1 2 3 0 0 0 1", "expected a time in seconds, found 'nan'"),
        ("-1 1 2 3 0 0 0 1", "expected a time in seconds, found '-1'"),
        ("1e30 1 2 3 0 0 0 1", "expected a time in seconds, found '1e30'"),
    ],
)
def test_refusals_name_file_and_line(tmp_path: Path, line: str, message: str) -> None:
    path = tmp_path / "t"
    path.write_text(f"# comment\n{LINE}{line}\n")
    with pytest.raises(TrajectoryError) as caught:
        read_trajectory(path)
    assert str(caught.value) == f"{path}:3: {message}"


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(TrajectoryError, match=r"none\.txt: expected a readable trajectory, found No such file"):
        read_trajectory(tmp_path / "none.txt")
