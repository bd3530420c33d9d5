"""The topic table is complete, and names cannot leave their fleet."""

import dataclasses

import pytest

from vtslam.common.bus import Member
from vtslam.common.topics import CONTROL, EVERY_SERVICE, QUERIES, ROOT, SENSOR_FRAME, STATUS, TOPICS, Overflow, Role


def test_every_topic_says_who_publishes_it_and_what_fits() -> None:
    suffixes = [topic.suffix for topic in TOPICS] + [query.suffix for query in QUERIES]
    assert len(set(suffixes)) == len(suffixes)
    for topic in TOPICS:
        assert topic.publishers
        assert topic.history >= 1
        assert topic.max_bytes >= 1024
        assert topic.overflow is not Overflow.NEWEST or topic.history == 1
        if topic.rate_hz is not None:
            assert 0 < topic.rate_hz[0] < topic.rate_hz[1]
        assert Role.OBSERVER not in topic.publishers


def test_who_may_come_from_elsewhere_publishes_no_poses_and_gives_no_orders() -> None:
    allowed = {topic.suffix for topic in TOPICS if Role.REMOTE_SENSOR in topic.publishers}
    assert allowed == {"sensor/pixels"}


def test_a_viewer_says_how_it_is_and_nothing_else() -> None:
    assert {topic.suffix for topic in TOPICS if Role.VIEWER in topic.publishers} == {"status/{service}"}
    assert not any(Role.VIEWER in query.answerers for query in QUERIES)


def test_keys_lie_below_their_fleet() -> None:
    assert SENSOR_FRAME.key("kitchen") == f"{ROOT}/kitchen/sensor/frame"
    assert STATUS.key("kitchen", "mapper") == f"{ROOT}/kitchen/status/mapper"
    assert STATUS.key("kitchen", EVERY_SERVICE) == f"{ROOT}/kitchen/status/*"
    with pytest.raises(ValueError, match="with service None"):
        CONTROL.key("kitchen")
    with pytest.raises(ValueError, match="with service 'mapper'"):
        SENSOR_FRAME.key("kitchen", "mapper")


@pytest.mark.parametrize("name", ["", "*", "**", "a/b", "..", "A", "a b", "-a", "a" * 33, "a$*", "a\n"])
def test_malformed_names_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match="1 to 32"):
        SENSOR_FRAME.key(name)
    with pytest.raises(ValueError, match="1 to 32"):
        Member(fleet=name, role=Role.SENSOR)


def test_a_member_is_called_like_its_role_unless_named() -> None:
    member = Member(fleet="kitchen", role=Role.TRACKER)
    assert member.name == "tracker"
    assert dataclasses.replace(member, name="second").name == "second"
