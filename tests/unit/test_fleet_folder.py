import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.shm_sections import frame_of, spec_of

from vtslam.common.fleet_folder import (
    FleetFolder,
    FleetOwner,
    read_owner,
    running_fleets,
    shared_memory_folder,
    sweep_dead_fleets,
)
from vtslam.common.shm.errors import FleetExists, SharedMemoryError
from vtslam.common.shm.frame_ring import FrameRingWriter
from vtslam.common.shm.map_store import MapStore
from vtslam.common.shm.process_identity import PID_BITS, boot_id, identity_of, is_alive, own_identity, pid_of
from vtslam.common.shm.ring_layout import RingSpec


def _dead_identity() -> int:
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    return identity_of(child.pid, 1)


def _with_owner(folder: FleetFolder, **changes: object) -> None:
    path = folder.path / "owner"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def test_files_are_the_users_alone(tmp_path: Path) -> None:
    fleet = FleetFolder.create("a", base=tmp_path)
    FrameRingWriter.create(fleet.ring_path, RingSpec(width=8, height=8, slots=3, pins=2))
    MapStore(fleet.map_path, budget_bytes=1 << 20).create_active(spec_of(1))
    paths = [fleet.path, *fleet.path.rglob("*")]
    assert len(paths) == 7
    assert {oct(path.stat().st_mode & 0o777) for path in paths if path.is_dir()} == {"0o700"}
    assert {oct(path.stat().st_mode & 0o777) for path in paths if path.is_file()} == {"0o600"}
    fleet.remove()
    assert list(tmp_path.iterdir()) == []


def test_a_name_in_use_is_refused_and_one_of_a_dead_fleet_taken_over(tmp_path: Path) -> None:
    fleet = FleetFolder.create("a", base=tmp_path, run_folder="/runs/1")
    (fleet.path / "ring").write_bytes(b"kept")
    parent = os.getppid()
    start = int(Path(f"/proc/{parent}/stat").read_text().rpartition(")")[2].split()[19])
    _with_owner(fleet, identity=identity_of(parent, start))
    with pytest.raises(FleetExists, match="a fleet of this name is running"):
        FleetFolder.create("a", base=tmp_path)
    _with_owner(fleet, identity=_dead_identity())
    again = FleetFolder.create("a", base=tmp_path)
    assert (again.path / "ring").read_bytes() == b"kept"
    owner = read_owner(again.path)
    assert owner is not None
    assert owner.identity == own_identity()
    assert [path.name for path in tmp_path.iterdir()] == ["vtslam-a"]


@pytest.mark.parametrize("name", ["", "a/b", "..", "a b", "x" * 33, "A"])
def test_names_that_could_leave_the_folder_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="1 to 32 of"):
        FleetFolder.create(name, base=tmp_path)


def test_links_and_open_folders_are_refused(tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir(mode=0o700)
    (tmp_path / "vtslam-link").symlink_to(elsewhere)
    (tmp_path / "vtslam-open").mkdir(mode=0o755)
    (tmp_path / "vtslam-open" / "file").touch()
    for name in ("link", "open"):
        with pytest.raises(FleetExists, match="mode 0700"):
            FleetFolder.open(name, base=tmp_path)
        with pytest.raises(FleetExists):
            FleetFolder.create(name, base=tmp_path)
    with pytest.raises(SharedMemoryError, match="found nothing"):
        FleetFolder.open("none", base=tmp_path)
    assert sweep_dead_fleets(base=tmp_path) == []
    assert elsewhere.exists()


def test_sweep_takes_dead_fleets_but_those_that_are_kept(tmp_path: Path) -> None:
    for name in ("alive", "dead", "kept", "reused", "rebooted", "damaged"):
        FleetFolder.create(name, base=tmp_path, run_folder=f"/runs/{name}")
    _with_owner(FleetFolder.open("dead", base=tmp_path), identity=_dead_identity())
    _with_owner(FleetFolder.open("kept", base=tmp_path), identity=_dead_identity())
    # The pid is there, with another start time.
    _with_owner(FleetFolder.open("reused", base=tmp_path), identity=own_identity() + (1 << PID_BITS))
    _with_owner(FleetFolder.open("rebooted", base=tmp_path), boot="another")
    _with_owner(FleetFolder.open("damaged", base=tmp_path), identity="x")
    (tmp_path / f".vtslam-new-{_dead_identity():x}-half").mkdir(mode=0o700)
    (tmp_path / "other").mkdir()
    asked: list[str] = []

    def keep(owner: FleetOwner) -> bool:
        asked.append(owner.run_folder)
        return owner.fleet == "kept"

    assert sweep_dead_fleets(base=tmp_path, keep=keep) == ["damaged", "dead", "rebooted", "reused"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["other", "vtslam-alive", "vtslam-kept"]
    assert asked == ["/runs/dead", "/runs/kept", "/runs/reused"]


def test_fleets_lie_where_the_environment_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VTSLAM_SHARED_MEMORY", str(tmp_path))
    folder = FleetFolder.create("here")
    assert folder.path == FleetFolder.open("here").path == tmp_path / "vtslam-here"
    assert running_fleets() == ["here"]
    _with_owner(folder, identity=_dead_identity())
    assert sweep_dead_fleets() == ["here"]
    monkeypatch.delenv("VTSLAM_SHARED_MEMORY")
    assert shared_memory_folder() == Path("/dev/shm")


def test_identities() -> None:
    own = own_identity()
    assert pid_of(own) == os.getpid()
    assert is_alive(own)
    assert not is_alive(own + (1 << PID_BITS))
    assert not is_alive(_dead_identity())
    assert boot_id() == boot_id()


def test_a_zombie_is_dead() -> None:
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as child:
        start = int(Path(f"/proc/{child.pid}/stat").read_text().rpartition(")")[2].split()[19])
        identity = identity_of(child.pid, start)
        assert is_alive(identity)
        child.kill()
        os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)  # ended, not collected: still in /proc
        assert Path(f"/proc/{child.pid}").exists()
        assert not is_alive(identity)


def test_ring_frames_survive_as_published(tmp_path: Path) -> None:
    ring = FrameRingWriter.create(tmp_path / "ring", RingSpec(width=16, height=12, slots=3, pins=2))
    with pytest.raises(SharedMemoryError, match="expected nothing, found a file"):
        FrameRingWriter.create(tmp_path / "ring", RingSpec(width=16, height=12))
    assert ring.publish_newest(frame_of(5)).sequence == 1


def test_word_of_a_failure_fits_into_the_room_reserved_for_it(tmp_path: Path) -> None:
    folder = FleetFolder.create("one", base=tmp_path)
    folder.reserve_last_words("mapper")
    assert folder.failure("mapper") == folder.failure("tracker") == ""
    size = (folder.path / "failed-mapper").stat().st_blocks
    folder.write_failure("mapper", "a" * 10_000)
    assert folder.failure("mapper") == "a" * 4096
    folder.write_failure("mapper", "no room: ä")
    assert folder.failure("mapper") == "no room: ä"
    assert (folder.path / "failed-mapper").stat().st_blocks == size > 0
    folder.remove()


def test_counts_fit_into_the_room_reserved_for_them_and_are_those_of_one_start(tmp_path: Path) -> None:
    folder = FleetFolder.create("one", base=tmp_path)
    folder.reserve_last_words("mapper")
    assert folder.counts("mapper", 1) is None
    path, most = folder.path / "ended-mapper", {f"{number:064d}": 2**63 - 1 for number in range(64)}
    blocks = path.stat().st_blocks
    folder.write_counts("mapper", 1, most)
    assert folder.counts("mapper", 1) == most
    folder.write_counts("mapper", 2, {"frames": 3})
    assert folder.counts("mapper", 2) == {"frames": 3}
    assert folder.counts("mapper", 1) is None
    assert path.stat().st_blocks == blocks > 0
    folder.remove()
