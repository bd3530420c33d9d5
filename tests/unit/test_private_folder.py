"""The run-time folder is for one user only, and the hub in it is one."""

import stat
from pathlib import Path

import pytest
from helpers.bus_backends import short_folder

from vtslam.common.bus import BusError, Member
from vtslam.common.bus_zenoh import Hub, join
from vtslam.common.private_folder import HUB_SOCKET, PrivateFolderError, make_private_folder
from vtslam.common.topics import Role

OBSERVER = Member(fleet="test", role=Role.OBSERVER)


def test_the_folder_and_the_socket_are_private() -> None:
    with short_folder() as base:
        folder = base / "a" / "run"
        with Hub(folder, "test"):
            assert stat.S_IMODE(folder.stat().st_mode) == 0o700
            assert stat.S_IMODE((folder / HUB_SOCKET).stat().st_mode) == 0o600
            join(OBSERVER, folder).close()
        assert list(folder.iterdir()) == []


def test_a_folder_that_others_may_enter_is_refused() -> None:
    with short_folder() as base:
        folder = base / "run"
        folder.mkdir()
        folder.chmod(0o755)
        for use in (lambda: make_private_folder(folder), lambda: join(OBSERVER, folder)):
            with pytest.raises(PrivateFolderError, match=r"expected mode 0700 and user .*, found mode 0755"):
                use()


def test_a_folder_that_others_may_rename_is_refused() -> None:
    with short_folder() as base:
        (base / "open").mkdir()
        (base / "open").chmod(0o777)
        with pytest.raises(PrivateFolderError, match="others may rename"):
            make_private_folder(base / "open" / "run")
        (base / "open").chmod(0o1777)
        make_private_folder(base / "open" / "run")


def test_links_files_and_missing_folders_are_refused() -> None:
    with short_folder() as base:
        (base / "real").mkdir(mode=0o700)
        (base / "link").symlink_to(base / "real")
        with pytest.raises(PrivateFolderError, match="expected a folder"):
            make_private_folder(base / "link")
        with pytest.raises(PrivateFolderError, match="is the fleet running"):
            join(OBSERVER, base / "missing")


def test_a_path_too_long_for_a_socket_is_refused() -> None:
    with pytest.raises(PrivateFolderError, match="at most 100 bytes"):
        make_private_folder(Path("/tmp") / ("x" * 100))
    with pytest.raises(PrivateFolderError, match="none of"):
        make_private_folder(Path("/tmp/a#b"))


def test_a_second_hub_is_refused_and_a_dead_ones_socket_is_no_obstacle() -> None:
    with short_folder() as base:
        folder = make_private_folder(base / "run")
        (folder / HUB_SOCKET).touch()
        with Hub(folder, "test"):
            with pytest.raises(BusError, match="router at unixsock-stream"):
                Hub(folder, "test")
            join(OBSERVER, folder).close()


def test_without_a_hub_joining_ends_with_an_error() -> None:
    with short_folder() as base:
        folder = make_private_folder(base / "run")
        with pytest.raises(BusError, match="client at unixsock-stream"):
            join(OBSERVER, folder, timeout_s=0.2)
