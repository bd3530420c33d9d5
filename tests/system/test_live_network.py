"""A fleet that another host publishes to, by the samples in ``deploy``; the other host is 127.0.0.1."""

import shutil
import socket
from pathlib import Path

import pytest
from helpers.certificates import Authority
from helpers.fleet_runs import Disturbance, SmallRecording, live_run, result_bytes, small_plan

from vtslam.common.bus import Member
from vtslam.common.bus_zenoh import join
from vtslam.common.config import ConfigError
from vtslam.common.fleet_folder import FleetFolder
from vtslam.common.topics import Role
from vtslam.services.cli.__main__ import main
from vtslam.services.network import read_door

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
PRIORS = "?prior=0.02,0.5"


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def host(folder: Path, authority: Authority, *samples: str, certificates: tuple[str, ...] = ()) -> Path:
    """The folder of one host with samples of ``deploy`` in it, and what they ask to have beside them."""
    folder.mkdir()
    for name in samples:
        shutil.copy(DEPLOY / name, folder / name)
        (folder / name).chmod(0o600)
    shutil.copy(authority.certificate, folder / "authority.pem")
    for name in certificates:
        for file in authority.issue(name):
            shutil.copy(file, folder / file.name)
    return folder


@pytest.mark.parametrize(
    ("access", "credentials", "shown"),
    [
        ("access-passwords.toml", "credentials-password.toml", ()),
        ("access-certificates.toml", "credentials-certificate.toml", ("camera",)),
    ],
)
def test_frames_of_another_host_are_mapped_as_those_of_this_one(
    access: str, credentials: str, shown: tuple[str, ...], small: SmallRecording, tmp_path: Path
) -> None:
    authority, fleet = Authority(tmp_path / "ca"), "test-network"
    box = host(tmp_path / "box", authority, access, certificates=("hub",))
    camera = host(tmp_path / "camera", authority, credentials, certificates=shown)
    (box / "passwords").touch(mode=0o600)
    (box / "passwords").write_text("camera:change me, please\nrobot:another password\n")
    address = f"127.0.0.1:{free_port()}"
    words = ["--connect", address, "--credentials", str(camera / credentials), "--fleet", fleet, "--frames", "0:8"]

    def publish() -> None:
        assert main(["publish", small.files.uri + PRIORS, *words]) == 0
        with join(Member(fleet=fleet, role=Role.OBSERVER), FleetFolder.open(fleet).path):
            pass  # this host's own members need no credentials

    door = read_door(address, box / access)
    summary = live_run(tmp_path / "run", fleet, Disturbance(), publish, door=door)

    small_plan(small.files, "source.frames=0:8", source=PRIORS).execute(tmp_path / "one")
    assert summary.frames == 8
    assert result_bytes(tmp_path / "run") == result_bytes(tmp_path / "one")


def test_doors_are_not_opened_half(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    box = host(tmp_path / "box", Authority(tmp_path / "ca"), "access-passwords.toml", "credentials-password.toml")
    up = ["up", "--out", str(tmp_path / "run"), "--listen", "127.0.0.1:7447"]
    publish = ["publish", "sim:room", "--connect", "127.0.0.1:7447"]
    for words, message in (
        (up, "--listen HOST:PORT needs --access FILE"),
        (publish, "--connect HOST:PORT needs --credentials FILE"),
        ([*up, "--access", str(box / "access-passwords.toml")], "hub.pem, found nothing"),
    ):
        assert main(words) == 2
        assert message in capsys.readouterr().err
    (box / "credentials-password.toml").chmod(0o644)
    assert main([*publish, "--credentials", str(box / "credentials-password.toml")]) == 2
    assert "only its owner may read (mode 0600), found mode 0644" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("text", "passwords", "message"),
    [
        ('remote_sensors = ["a"]', "", "without a password file and without TLS anyone could come in"),
        ('passwords = "p"', "a:12345678", "expected each member once"),
        ('passwords = "p"\nobservers = ["a"]\nremote_sensors = ["a"]', "a:12345678", "expected each member once"),
        ('passwords = "p"\nobservers = ["a"]', "b:12345678", "expected a line user:password for each of a, found b"),
        ('passwords = "p"\nobservers = ["a"]', "a:short", "password of a must be 8 to 128"),
        ('passwords = "p"\nobservers = ["a"]', "a", "p:1: expected user:password"),
        ('passwords = "p"\nobservers = ["local"]', "local:12345678", "local: a member elsewhere is one of"),
        ('observer = ["a"]', "", "observer"),
    ],
)
def test_odd_access_files_are_refused(text: str, passwords: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "access.toml").write_text(text)
    (tmp_path / "p").touch(mode=0o600)
    (tmp_path / "p").write_text(passwords)
    with pytest.raises(ConfigError, match=message):
        read_door("127.0.0.1:7447", tmp_path / "access.toml")


@pytest.mark.parametrize("address", ["7447", "host:", "host:0", "host:65536", ":7447", "a/b:1", "host:1#x=1"])
def test_odd_addresses_are_refused(address: str, tmp_path: Path) -> None:
    (tmp_path / "access.toml").write_text('passwords = "p"\nobservers = ["a"]')
    (tmp_path / "p").touch(mode=0o600)
    (tmp_path / "p").write_text("a:12345678")
    with pytest.raises(ConfigError, match="expected an address HOST:PORT"):
        read_door(address, tmp_path / "access.toml")
