import pytest

from vtslam.services.tracker.pose_ages import PoseAges

_MS = 1_000_000


def test_an_age_grows_until_the_next_pose() -> None:
    ages = PoseAges()
    assert ages.quantile_ms(0.99) == 0.0
    ages.published(0, 20 * _MS)
    assert ages.quantile_ms(0.99) == 0.0
    ages.published(100 * _MS, 120 * _MS)  # until then the age went from 20 to 120 ms
    assert ages.quantile_ms(0.0) == pytest.approx(20.0)
    assert ages.quantile_ms(0.5) == pytest.approx(67.5)
    assert 110.0 < ages.quantile_ms(0.99) < 120.0
    for pose in range(2, 200):
        ages.published(pose * 100 * _MS, (pose * 100 + 20) * _MS)
    assert ages.quantile_ms(1.0) < 120.0
