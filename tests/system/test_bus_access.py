"""A fleet that is opened to other hosts: who has no right to come in stays out, who comes in does only what it may."""

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
import zenoh
from helpers.bus_backends import keep_trying, short_folder
from helpers.bus_messages import RANDOM
from helpers.certificates import Authority

from vtslam.common.bus import Bus, BusError, Member
from vtslam.common.bus_access import LOCAL_USER, Login, NetworkAccess, TlsFiles, write_password_file
from vtslam.common.bus_config import remote_member_config
from vtslam.common.bus_zenoh import Hub, ZenohBus, join, join_by
from vtslam.common.messages import Control, FramePixels, Message, Odometry, TrackedPose, encode
from vtslam.common.topics import CONTROL, SENSOR_PIXELS, TRACKER_ODOMETRY, TRACKER_POSE, Role

M = TypeVar("M", bound=Message)

PATIENCE_S = 30.0
FORGER = 666
OWN = Login(user=LOCAL_USER, password="only for this host")
CAMERA = Login(user="camera", password="a camera's password")
ROBOT = Login(user="robot", password="a robot's password")


@pytest.fixture
def folder() -> Iterator[Path]:
    with short_folder() as base:
        yield base


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def _member(role: Role) -> Member:
    return Member(fleet="test", role=role)


def _remote(role: Role, config: dict[str, Any], timeout_s: float = 0.0) -> ZenohBus:
    return join_by(_member(role), config, timeout_s=timeout_s)


def _raw(bus: Bus) -> zenoh.Session:
    session = bus._session  # type: ignore[attr-defined]
    assert isinstance(session, zenoh.Session)
    return session


def _random(kind: type[M]) -> M:
    message = RANDOM[kind](np.random.default_rng(0))
    assert isinstance(message, kind)
    return message


def _check_rights(own: tuple[Bus, Bus], camera: Bus, robot: Bus) -> None:
    """Pixels of the camera come in, its poses do not; the robot reads poses, and gives no orders."""
    tracker, supervisor = own
    pixels, poses = tracker.subscriber(SENSOR_PIXELS), tracker.subscriber(TRACKER_POSE)
    orders = tracker.subscriber(CONTROL, service="tracker")
    odometry, newest_pose = robot.subscriber(TRACKER_ODOMETRY), robot.subscriber(TRACKER_POSE, newest_only=True)
    hidden = camera.subscriber(CONTROL, service="tracker", newest_only=True)
    publish_pixels, publish_pose = camera.publisher(SENSOR_PIXELS), tracker.publisher(TRACKER_POSE)
    publish_odometry, order = tracker.publisher(TRACKER_ODOMETRY), supervisor.publisher(CONTROL, service="tracker")
    forged_pose, forged_order = _forged(TrackedPose), _forged(Control)

    def arrived() -> bool:
        _raw(camera).put(TRACKER_POSE.key("test"), forged_pose)
        _raw(robot).put(CONTROL.key("test", "tracker"), forged_order)
        publish_pixels.publish(_random(FramePixels))
        publish_odometry.publish(_random(Odometry))
        publish_pose.publish(_random(TrackedPose))
        order.publish(_random(Control))
        counts = (each.traffic().accepted for each in (pixels, poses, orders, odometry, newest_pose))
        return min(counts) >= 5

    assert keep_trying(tracker, arrived)
    # Messages of one session keep their order, so what the camera forged before its pixels would be here by now.
    for subscriber in (poses, orders, odometry, newest_pose):
        assert subscriber.traffic().rejected == 0
        while (received := subscriber.receive()) is not None:
            assert received.origin != FORGER
    assert hidden.traffic().arrived == 0


def _forged(kind: type[Message]) -> bytes:
    return encode(_random(kind), origin=FORGER, sequence=0, publish_time_ns=1, max_bytes=8192)


@contextmanager
def _own(folder: Path, login: Login | None) -> Iterator[tuple[Bus, Bus]]:
    """Sessions of the fleet itself."""
    with (
        join(_member(Role.TRACKER), folder, login=login) as tracker,
        join(_member(Role.SUPERVISOR), folder, login=login) as supervisor,
    ):
        yield tracker, supervisor


@pytest.mark.parametrize("protocol", ["tcp", "tls"])
def test_a_password_is_needed_and_a_role_has_its_limits(folder: Path, protocol: str) -> None:
    passwords = folder / "passwords"
    write_password_file(passwords, [OWN, CAMERA, ROBOT])
    endpoint = f"{protocol}/127.0.0.1:{_free_port()}"
    hub_tls = member_tls = None
    if protocol == "tls":
        authority = Authority(folder / "ca")
        certificate, key = authority.issue("hub")
        hub_tls = TlsFiles(authority=authority.certificate, certificate=certificate, key=key)
        member_tls = TlsFiles(authority=authority.certificate)
    access = NetworkAccess(
        endpoint=endpoint,
        members={"camera": Role.REMOTE_SENSOR, "robot": Role.OBSERVER},
        password_file=passwords,
        tls=hub_tls,
    )

    def config(login: Login) -> dict[str, Any]:
        return remote_member_config(endpoint, login=login, tls=member_tls)

    with Hub(folder / "run", "test", access):
        for wrong in (Login(user="camera", password="wrong password"), Login(user="nobody", password="a password")):
            with pytest.raises(BusError, match="Unable to connect"):
                _remote(Role.REMOTE_SENSOR, config(wrong))
        without = config(CAMERA)
        del without["transport"]["auth"]
        with pytest.raises(BusError, match="Unable to connect"):
            _remote(Role.REMOTE_SENSOR, without)
        with pytest.raises(BusError, match="Unable to connect"):
            join(_member(Role.TRACKER), folder / "run", timeout_s=0.0)
        with (
            _own(folder / "run", OWN) as own,
            _remote(Role.REMOTE_SENSOR, config(CAMERA), PATIENCE_S) as camera,
            _remote(Role.OBSERVER, config(ROBOT), PATIENCE_S) as robot,
        ):
            _check_rights(own, camera, robot)


def test_certificates_open_the_door_and_tell_who_comes(folder: Path) -> None:
    authority, stranger = Authority(folder / "ca"), Authority(folder / "other")
    certificate, key = authority.issue("hub")
    endpoint = f"tls/127.0.0.1:{_free_port()}"
    access = NetworkAccess(
        endpoint=endpoint,
        members={"camera": Role.REMOTE_SENSOR, "robot": Role.OBSERVER},
        tls=TlsFiles(authority=authority.certificate, certificate=certificate, key=key),
    )

    def files(issuer: Authority, name: str) -> TlsFiles:
        shown, secret = issuer.issue(name)
        return TlsFiles(authority=authority.certificate, certificate=shown, key=secret)

    with Hub(folder / "run", "test", access):
        forged = remote_member_config(endpoint, tls=files(stranger, "camera"))
        with pytest.raises(BusError, match="Unable to connect"):
            _remote(Role.REMOTE_SENSOR, forged)
        without = remote_member_config(endpoint, login=CAMERA, tls=TlsFiles(authority=authority.certificate))
        with pytest.raises(BusError, match="Unable to connect"):
            _remote(Role.REMOTE_SENSOR, without)
        fooled = remote_member_config(endpoint, login=CAMERA, tls=TlsFiles(authority=stranger.certificate))
        with pytest.raises(BusError, match="Unable to connect"):
            _remote(Role.REMOTE_SENSOR, fooled)
        camera_config = remote_member_config(endpoint, tls=files(authority, "camera"))
        robot_config = remote_member_config(endpoint, tls=files(authority, "robot"))
        with (
            _own(folder / "run", None) as own,
            _remote(Role.REMOTE_SENSOR, camera_config, PATIENCE_S) as camera,
            _remote(Role.OBSERVER, robot_config, PATIENCE_S) as robot,
        ):
            _check_rights(own, camera, robot)
