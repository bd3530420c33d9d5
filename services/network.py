"""How a fleet is opened to other hosts, and how those come in: small files of who may do what, and of credentials."""

import secrets
import stat
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from vtslam.common.bus import Bus, Member
from vtslam.common.bus_access import (
    LOCAL_USER,
    Login,
    NetworkAccess,
    TlsFiles,
    write_own_login,
    write_password_file,
)
from vtslam.common.bus_config import remote_member_config
from vtslam.common.bus_zenoh import join_by
from vtslam.common.config import ConfigError, load, load_toml
from vtslam.common.topics import Role

T = TypeVar("T")

_PASSWORDS = "passwords"  # in the fleet's folder: what the hub reads


@dataclass(frozen=True, slots=True, kw_only=True)
class TlsPaths:
    """PEM files, relative to the file that names them.

    Attributes:
        authority: Where the other side's certificate must come from.
        certificate, key: The own ones; a hub must have them, a member only where it logs in by certificate.
    """

    authority: str
    certificate: str = ""
    key: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class AccessFile:
    """Who may come in from other hosts.

    Attributes:
        passwords: File of lines ``user:password``, readable by its owner only; empty to go by certificates alone.
        remote_sensors: Members that publish frames: users, or common names of certificates.
        observers: Members that read poses and status.
        tls: For an encrypted line; without it, messages cross the network in the clear, but not passwords.
    """

    passwords: str = ""
    remote_sensors: tuple[str, ...] = ()
    observers: tuple[str, ...] = ()
    tls: TlsPaths | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class CredentialsFile:
    """What a member on another host shows; readable by its owner only.

    Attributes:
        user, password: Its login; empty where the fleet goes by certificates.
        tls: For a fleet that listens with TLS.
    """

    user: str = ""
    password: str = ""
    tls: TlsPaths | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Door:
    """An opening to other hosts, before there is a fleet; made by :func:`read_door`.

    Attributes:
        access: With the password file that the user wrote.
        logins: What is in that, or None.
    """

    access: NetworkAccess
    logins: tuple[Login, ...] | None

    def access_of(self, folder: Path) -> NetworkAccess:
        """The access of the fleet in ``folder``, whose own processes get a password of their own there."""
        if self.logins is None:
            return self.access
        own = Login(user=LOCAL_USER, password=secrets.token_urlsafe(24))
        write_password_file(folder / _PASSWORDS, [own, *self.logins])
        write_own_login(folder, own)
        return NetworkAccess(
            endpoint=self.access.endpoint,
            members=self.access.members,
            password_file=folder / _PASSWORDS,
            tls=self.access.tls,
        )


def read_door(address: str, path: Path) -> Door:
    """An opening at ``address`` (HOST:PORT) for the members in an `AccessFile`.

    Raises:
        ConfigError: The file or one that it names is missing, not private, or not complete.
    """
    file = load(AccessFile, [(str(path), load_toml(path))])
    tls = _tls_files(path, file.tls)
    members = dict.fromkeys(file.remote_sensors, Role.REMOTE_SENSOR) | dict.fromkeys(file.observers, Role.OBSERVER)
    if len(members) < len(file.remote_sensors) + len(file.observers) or not members:
        raise ConfigError(f"{path}: expected each member once in remote_sensors or observers, and at least one")
    passwords = _beside(path, file.passwords) if file.passwords else None
    logins = None if passwords is None else _read_logins(passwords)
    if logins is not None and {login.user for login in logins} != members.keys():
        raise ConfigError(
            f"{passwords}: expected a line user:password for each of {', '.join(sorted(members))}, "
            f"found {', '.join(sorted(login.user for login in logins))}"
        )
    return _checked(
        path,
        lambda: Door(
            access=NetworkAccess(endpoint=_endpoint(address, tls), members=members, password_file=passwords, tls=tls),
            logins=logins,
        ),
    )


def join_from_elsewhere(fleet: str, address: str, path: Path, *, timeout_s: float = 10.0) -> Bus:
    """A session of a remote sensor, by the credentials in a `CredentialsFile`.

    Args:
        fleet: Name of the fleet.
        address: HOST:PORT where it listens.
        path: The file.
        timeout_s: How long to wait for the fleet.

    Raises:
        ConfigError: The file or one that it names is missing, not private, or not complete.
        BusError: The fleet does not answer, or refuses the credentials.
    """
    _require_private(path)
    file = load(CredentialsFile, [(str(path), load_toml(path))])
    tls = _tls_files(path, file.tls)
    name = file.user or "publisher"
    member = _checked(path, lambda: Member(fleet=fleet, role=Role.REMOTE_SENSOR, name=name))
    login = _checked(path, lambda: Login(user=file.user, password=file.password)) if file.user else None
    config = _checked(path, lambda: remote_member_config(_endpoint(address, tls), login=login, tls=tls))
    return join_by(member, config, timeout_s=timeout_s)


def _endpoint(address: str, tls: TlsFiles | None) -> str:
    host, colon, port = address.rpartition(":")
    if not (host and colon and port.isdecimal() and 0 < int(port) < 65536) or set("/#?;=") & set(address):
        raise ConfigError(f"expected an address HOST:PORT, as in 192.168.7.1:7447; got {address!r}")
    return f"{'tcp' if tls is None else 'tls'}/{address}"


def _read_logins(path: Path) -> tuple[Login, ...]:
    _require_private(path)
    logins = []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), start=1):
        user, colon, password = line.partition(":")
        if not colon:
            raise ConfigError(f"{path}:{number}: expected user:password")
        logins.append(_checked(path, lambda user=user, password=password: Login(user=user, password=password)))  # type: ignore[misc]
    return tuple(logins)


def _require_private(path: Path) -> None:
    try:
        mode = stat.S_IMODE(path.stat().st_mode)
    except OSError as error:
        raise ConfigError(f"{path}: cannot read: {error.strerror}") from error
    if mode & 0o077:
        raise ConfigError(f"{path}: expected a file that only its owner may read (mode 0600), found mode {mode:04o}")


def _tls_files(path: Path, paths: TlsPaths | None) -> TlsFiles | None:
    if paths is None:
        return None
    if bool(paths.certificate) != bool(paths.key):
        raise ConfigError(f"{path}: expected certificate and key, or neither")
    found = {name: _beside(path, text) for name, text in _named(paths).items() if text}
    for file in found.values():
        if not file.is_file():
            raise ConfigError(f"{path}: expected the file {file}, found nothing")
    return TlsFiles(authority=found["authority"], certificate=found.get("certificate"), key=found.get("key"))


def _named(paths: TlsPaths) -> dict[str, str]:
    return {"authority": paths.authority, "certificate": paths.certificate, "key": paths.key}


def _beside(path: Path, name: str) -> Path:
    return path.absolute().parent / name


def _checked(path: Path, make: Callable[[], T]) -> T:
    try:
        return make()
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from error
