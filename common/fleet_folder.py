"""The folder of what a fleet's processes share, and what is swept of fleets that died (docs/protocol-shm.md, 2)."""

import errno
import json
import os
import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from vtslam.common.private_folder import PrivateFolderError, check_private_folder
from vtslam.common.shm.blocks import make_file, reserve
from vtslam.common.shm.errors import DamagedBlock, FleetExists, SharedMemoryError
from vtslam.common.shm.process_identity import boot_id, is_alive, own_identity
from vtslam.common.topics import checked_name

_SHARED_MEMORY, _ELSEWHERE = Path("/dev/shm"), "VTSLAM_SHARED_MEMORY"
_HEX = re.compile("[0-9a-f]{1,16}")
_PREFIX = "vtslam-"
_NEW_PREFIX = ".vtslam-new-"  # then the maker's identity
_OWNER, _RING, _MAP, _JOURNAL, _FAILED, _ENDED = "owner", "ring", "map", "journal", "failed", "ended"
_MAX_OWNER_BYTES = 65536
_FAILURE_BYTES = 4096
_COUNTS_BYTES = 8192  # holds as many counters as a status has, with names of any length


def shared_memory_folder() -> Path:
    """Where fleets have their folders: VTSLAM_SHARED_MEMORY, a folder on a tmpfs with a short path; else /dev/shm."""
    return Path(os.environ.get(_ELSEWHERE) or _SHARED_MEMORY)


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetOwner:
    """Who made a fleet's folder.

    Attributes:
        fleet: The fleet's name.
        boot: Boot of the machine; shared memory does not outlive it.
        identity: The owner, as `process_identity` has it.
        run_folder: The run that the fleet writes; empty if none.
    """

    fleet: str
    boot: str
    identity: int
    run_folder: str

    @property
    def is_alive(self) -> bool:
        """Whether the owner is still there."""
        return self.boot == boot_id() and is_alive(self.identity)


class FleetFolder:
    """What one fleet shares: ring, map store, socket of its bus. Made with :meth:`create`, used through :meth:`open`.

    Attributes:
        path: The folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def create(cls, fleet: str, *, run_folder: str = "", base: Path | None = None) -> "FleetFolder":
        """Make the folder of a new fleet, owned by this process, or take over that of a fleet that died.

        Blocks of a fleet that died stay, for the new one to go on with; :meth:`remove` first to begin anew.

        Raises:
            FleetExists: A living fleet has that name, or another user's.
            ValueError: The name has other characters or lengths than allowed.
        """
        base = base or shared_memory_folder()
        path = _path_of(fleet, base)
        owner = FleetOwner(fleet=fleet, boot=boot_id(), identity=own_identity(), run_folder=run_folder)
        new = base / f"{_NEW_PREFIX}{own_identity():x}-{fleet}"
        try:
            new.mkdir(mode=0o700)
            _write_owner(new, owner)
            new.rename(path)  # a folder that is there keeps its place, unless it is empty
        except OSError as error:
            shutil.rmtree(new, ignore_errors=True)
            if error.errno not in (errno.EEXIST, errno.ENOTEMPTY, errno.ENOTDIR):
                raise SharedMemoryError(f"{path}: cannot be made: {error.strerror}") from error
            _require_own(path)
            former = read_owner(path)
            if former is not None and former.is_alive and former.identity != own_identity():
                raise FleetExists(f"{path}: a fleet of this name is running") from error
            _write_owner(path, owner)
        return cls(path)

    @classmethod
    def open(cls, fleet: str, *, base: Path | None = None) -> "FleetFolder":
        """The folder of a fleet; raises SharedMemoryError if there is none of this user."""
        path = _path_of(fleet, base or shared_memory_folder())
        _require_own(path)
        return cls(path)

    @property
    def ring_path(self) -> Path:
        """Where the frame ring is."""
        return self.path / _RING

    @property
    def map_path(self) -> Path:
        """Where the map store is."""
        return self.path / _MAP

    @property
    def journal_path(self) -> Path:
        """Where the committed frames are written for the run folder."""
        return self.path / _JOURNAL

    def reserve_last_words(self, name: str) -> None:
        """Make room for what the process ``name`` leaves at its end, which memory must not lack then.

        Raises:
            SharedMemoryFull: There is not enough.
        """
        for kind, num_bytes in ((_FAILED, _FAILURE_BYTES), (_ENDED, _COUNTS_BYTES)):
            path = self._last_words(kind, name)
            path.unlink(missing_ok=True)
            fd = make_file(path, num_bytes)
            try:
                reserve(path, fd, 0, num_bytes)
            finally:
                os.close(fd)

    def write_counts(self, name: str, epoch: int, counters: Mapping[str, int]) -> None:
        """Leave what a process has counted in all, when its ``epoch``-th start has come to its end."""
        words = json.dumps({"epoch": epoch, "counters": dict(counters)})
        self._write_last_words(_ENDED, name, words, _COUNTS_BYTES)

    def counts(self, name: str, epoch: int) -> dict[str, int] | None:
        """What a process had counted whose ``epoch``-th start has come to its end; None if it left nothing."""
        try:
            left = json.loads(self._read_last_words(_ENDED, name))
            return dict(left["counters"]) if left["epoch"] == epoch else None
        except ValueError:
            return None

    def write_failure(self, name: str, text: str) -> None:
        """Leave word of why the process ``name`` cannot go on."""
        self._write_last_words(_FAILED, name, text, _FAILURE_BYTES)

    def failure(self, name: str) -> str:
        """What :meth:`write_failure` left; empty if nothing."""
        return self._read_last_words(_FAILED, name)

    def _write_last_words(self, kind: str, name: str, text: str, num_bytes: int) -> None:
        with open(self._last_words(kind, name), "r+b") as file:
            file.write(text.encode()[:num_bytes].ljust(num_bytes, b"\0"))

    def _read_last_words(self, kind: str, name: str) -> str:
        try:
            return self._last_words(kind, name).read_bytes().rstrip(b"\0").decode(errors="replace")
        except FileNotFoundError:
            return ""

    def _last_words(self, kind: str, name: str) -> Path:
        return self.path / f"{kind}-{checked_name(name)}"

    def remove(self) -> None:
        """Delete the folder and all blocks; memory is freed when the last process has unmapped it."""
        shutil.rmtree(self.path, ignore_errors=True)


def _write_owner(folder: Path, owner: FleetOwner) -> None:
    new = folder / f".new-{_OWNER}"
    new.unlink(missing_ok=True)
    fd = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    with os.fdopen(fd, "w") as file:
        json.dump(asdict(owner), file)
    new.rename(folder / _OWNER)


def read_owner(path: Path) -> FleetOwner | None:
    """The owner of a fleet's folder; None if it was never fully made. Raises DamagedBlock."""
    try:
        with open(path / _OWNER, "rb") as file:
            data = file.read(_MAX_OWNER_BYTES)
    except FileNotFoundError:
        return None
    try:
        owner = FleetOwner(**json.loads(data))
        kinds = (type(owner.fleet), type(owner.boot), type(owner.identity), type(owner.run_folder))
        if kinds != (str, str, int, str) or owner.identity < 0:
            raise ValueError(f"unexpected types {kinds}")
    except (ValueError, TypeError) as error:
        raise DamagedBlock(f"{path / _OWNER}: not the owner of a fleet: {error}") from error
    return owner


def running_fleets(*, base: Path | None = None) -> list[str]:
    """Names of this user's fleets whose owner lives."""
    names = []
    for path in sorted((base or shared_memory_folder()).glob(f"{_PREFIX}*")):
        try:
            owner = read_owner(path) if _is_own(path) else None
        except DamagedBlock:
            continue
        if owner is not None and owner.is_alive:
            names.append(owner.fleet)
    return names


def sweep_dead_fleets(
    *, base: Path | None = None, keep: Callable[[FleetOwner], bool] = lambda owner: False
) -> list[str]:
    """Delete the folders of this user's fleets whose owner is dead; their names.

    Args:
        base: Where fleets have their folders, if not where they usually have.
        keep: Asked for each dead fleet; true where a run folder wants to go on with its blocks. Fleets of another boot
            and folders without a readable owner are not asked about: nothing can go on with them.
    """
    base = base or shared_memory_folder()
    for path in base.glob(f"{_NEW_PREFIX}*"):
        maker = path.name.removeprefix(_NEW_PREFIX).partition("-")[0]
        if _is_own(path) and _HEX.fullmatch(maker) and not is_alive(int(maker, 16)):
            shutil.rmtree(path, ignore_errors=True)
    swept = []
    for path in sorted(base.glob(f"{_PREFIX}*")):
        if not _is_own(path):
            continue
        try:
            owner = read_owner(path)
        except DamagedBlock:
            owner = None
        if owner is not None and (owner.is_alive or (owner.boot == boot_id() and keep(owner))):
            continue
        shutil.rmtree(path, ignore_errors=True)
        swept.append(path.name.removeprefix(_PREFIX))
    return swept


def _path_of(fleet: str, base: Path) -> Path:
    return base / f"{_PREFIX}{checked_name(fleet)}"


def _is_own(path: Path) -> bool:
    """Whether a folder, not a link to one, belongs to this user alone."""
    try:
        check_private_folder(path)
    except PrivateFolderError:
        return False
    return True


def _require_own(path: Path) -> None:
    if not path.is_symlink() and not path.exists():
        raise SharedMemoryError(f"{path}: expected the folder of a fleet, found nothing")
    if not _is_own(path):
        raise FleetExists(f"{path}: expected a folder of this user with mode 0700, found something else")
