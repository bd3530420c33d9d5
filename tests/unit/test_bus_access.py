"""Opening a fleet to other hosts is explicit, complete, and follows the topic table."""

import importlib.util
import stat
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import zenoh

from vtslam.common.bus_access import LOCAL_USER, Login, NetworkAccess, TlsFiles, write_password_file
from vtslam.common.bus_config import hub_config, member_config, remote_member_config
from vtslam.common.topics import SENSOR_PIXELS, TOPICS, Role

_DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
_TLS = TlsFiles(authority=Path("a.pem"), certificate=Path("c.pem"), key=Path("k.pem"))
_CAMERA = {"camera": Role.REMOTE_SENSOR}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"endpoint": "tcp/0.0.0.0:1", "members": _CAMERA}, "anyone could come in"),
        ({"endpoint": "tls/0.0.0.0:1", "members": _CAMERA}, "TLS files are needed for tls/"),
        ({"endpoint": "tcp/0.0.0.0:1", "members": _CAMERA, "tls": _TLS}, "for that only"),
        ({"endpoint": "udp/0.0.0.0:1", "members": _CAMERA}, "listens on tcp"),
        (
            {"endpoint": "tls/0.0.0.0:1", "members": _CAMERA, "tls": TlsFiles(authority=Path("a.pem"))},
            "needs a certificate and its key",
        ),
        (
            {"endpoint": "tls/0.0.0.0:1", "members": {"camera": Role.TRACKER}, "tls": _TLS},
            "a member elsewhere is one of",
        ),
        (
            {"endpoint": "tls/0.0.0.0:1", "members": {LOCAL_USER: Role.OBSERVER}, "tls": _TLS},
            "a member elsewhere is one of",
        ),
        ({"endpoint": "tls/0.0.0.0:1", "members": {"a b": Role.OBSERVER}, "tls": _TLS}, "1 to 32"),
    ],
)
def test_half_open_doors_are_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        NetworkAccess(**values)


def test_a_hub_is_closed_unless_it_is_opened() -> None:
    config = hub_config(Path("/run/vtslam/x"), "x")
    assert config["listen"]["endpoints"] == ["unixsock-stream//run/vtslam/x/hub.sock"]
    assert "access_control" not in config
    assert member_config(Path("/run/vtslam/x"))["listen"]["endpoints"] == []
    with pytest.raises(ValueError, match="needs a login or a certificate"):
        remote_member_config("tcp/box:7447")


def test_a_remote_sensors_rights_are_those_of_the_topic_table() -> None:
    control = NetworkAccess(endpoint="tls/0.0.0.0:1", members=_CAMERA, tls=_TLS).control("x")
    assert control["default_permission"] == "deny"
    own = [rule for rule in control["rules"] if rule["id"].startswith("remote_sensor")]
    put = [key for rule in own if "put" in rule["messages"] and "ingress" in rule["flows"] for key in rule["key_exprs"]]
    assert put == [SENSOR_PIXELS.key("x")]
    read = [key for rule in own if "put" in rule["messages"] and "egress" in rule["flows"] for key in rule["key_exprs"]]
    assert len(read) == sum(Role.REMOTE_SENSOR in topic.readers_elsewhere for topic in TOPICS)
    assert all(key.startswith("vtslam/x/") for key in (*put, *read))


def test_the_password_file_is_private_and_complete(tmp_path: Path) -> None:
    path = tmp_path / "passwords"
    own, camera = Login(user=LOCAL_USER, password="12345678"), Login(user="camera", password="abcdefgh")
    path.write_text("old")
    path.chmod(0o644)
    write_password_file(path, [own, camera])
    assert path.read_text() == "local:12345678\ncamera:abcdefgh\n"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    for logins in ([camera], [own, own]):
        with pytest.raises(ValueError, match="users must be different and include local"):
            write_password_file(path, logins)
    for password in ("short", "new\nline!", "x" * 129):
        with pytest.raises(ValueError, match="8 to 128 printable"):
            Login(user="camera", password=password)


def _samples() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_hub_samples", _DEPLOY / "make_hub_samples.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_samples_in_deploy_are_what_the_code_makes() -> None:
    module = _samples()
    assert sorted(path.name for path in _DEPLOY.glob("hub-*.json5")) == sorted(module.SAMPLES)
    for name in module.SAMPLES:
        text = (_DEPLOY / name).read_text()
        assert text == module.sample(name), "run: python deploy/make_hub_samples.py deploy"
        zenoh.Config.from_json5(text)
