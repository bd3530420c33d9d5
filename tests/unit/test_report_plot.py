"""The plotter: what is drawn is where the axes say."""

import numpy as np

from vtslam.services.report_plot import ESTIMATED_COLOR, HEAD_COLOR, TRUE_COLOR, trajectory_plot


def pixels_of(picture: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    """Rows and columns [K,2] of the pixels of exactly this colour."""
    return np.argwhere((picture == color).all(axis=2))


def test_a_path_to_the_right_is_drawn_to_the_right_with_its_head_at_the_left() -> None:
    estimated = np.stack([np.linspace(0.0, 1.0, 9), np.zeros(9), np.linspace(0.0, 0.5, 9)], axis=1)

    picture = trajectory_plot(estimated, None, None, [0])

    top_view = picture[:, : picture.shape[1] // 2]
    line, head = pixels_of(top_view, ESTIMATED_COLOR), pixels_of(top_view, HEAD_COLOR)
    assert line[:, 1].max() > head[:, 1].max() + 200  # far to the right of the head, which begins the path
    assert line[line[:, 1].argmax(), 0] < head[:, 0].min()  # z grows upwards
    assert len(pixels_of(picture, TRUE_COLOR)) < 10  # at most the rim of a letter


def test_with_the_truth_there_is_an_error_curve() -> None:
    estimated = np.cumsum(np.full((5, 3), 0.01), axis=0)
    errors_m = np.array([0.001, 0.002, 0.004, 0.002, 0.001])

    picture = trajectory_plot(estimated, estimated + 0.05, errors_m, [0, 3])

    third = picture[:, 2 * picture.shape[1] // 3 :]
    assert len(pixels_of(third, ESTIMATED_COLOR)) > 50
    assert len(pixels_of(picture, TRUE_COLOR)) > 50


def test_a_camera_that_does_not_move_can_be_drawn() -> None:
    picture = trajectory_plot(np.zeros((1, 3)), np.zeros((1, 3)), np.zeros(1), [0])

    assert len(pixels_of(picture, HEAD_COLOR))
