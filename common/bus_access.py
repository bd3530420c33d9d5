"""Who may do what from other hosts: logins or certificates, TLS, and rules that follow from the topic table.

A fleet is closed: without a `NetworkAccess` its hub listens on a unix socket only. With one, everything is denied that
is not allowed here, per member and role. Processes of the fleet itself come over the unix socket and may do anything.
"""

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vtslam.common.topics import TOPICS, Role, checked_name

LOCAL_USER = "local"  # login of the fleet's own processes, needed as soon as there are logins
_OWN_LOGIN = "own-login"
REMOTE_ROLES = frozenset({Role.REMOTE_SENSOR, Role.OBSERVER})


@dataclass(frozen=True, slots=True, kw_only=True)
class Login:
    """A user and password."""

    user: str
    password: str

    def __post_init__(self) -> None:
        checked_name(self.user)
        if not 8 <= len(self.password) <= 128 or not self.password.isascii() or not self.password.isprintable():
            raise ValueError(f"the password of {self.user} must be 8 to 128 printable ASCII characters")


@dataclass(frozen=True, slots=True, kw_only=True)
class TlsFiles:
    """PEM files: the authority that the other side's certificate comes from, and the own certificate with its key."""

    authority: Path
    certificate: Path | None = None
    key: Path | None = None

    def connecting(self) -> dict[str, Any]:
        """The part of a client's configuration."""
        shown = {"connect_certificate": self.certificate, "connect_private_key": self.key}
        return {
            "root_ca_certificate": str(self.authority),
            "enable_mtls": self.certificate is not None,
            "verify_name_on_connect": True,
        } | {name: str(path) for name, path in shown.items() if path is not None}


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkAccess:
    """How a hub is opened to other hosts.

    Attributes:
        endpoint: Where it listens, as ``tls/0.0.0.0:7447`` or ``tcp/192.168.7.1:7447``.
        members: Role of each member by user name or, without a password file, by the common name of its certificate.
        password_file: Logins, one ``user:password`` per line, among them that of `LOCAL_USER`; None to go by
            certificates alone. Passwords never cross the network, but over ``tcp`` all messages do so in the clear.
        tls: Files for a ``tls`` endpoint; without a password file, members must show a certificate of the authority.

    Raises:
        ValueError: Nobody could be told apart, TLS and endpoint do not match, or a role is not for other hosts.
    """

    endpoint: str
    members: Mapping[str, Role]
    password_file: Path | None = None
    tls: TlsFiles | None = None

    def __post_init__(self) -> None:
        protocol = self.endpoint.partition("/")[0]
        if protocol not in ("tcp", "tls"):
            raise ValueError(f"{self.endpoint}: the hub listens on tcp/HOST:PORT or tls/HOST:PORT")
        if (protocol == "tls") != (self.tls is not None):
            raise ValueError(f"{self.endpoint}: TLS files are needed for tls/, and for that only")
        if self.tls is not None and (self.tls.certificate is None or self.tls.key is None):
            raise ValueError(f"{self.endpoint}: the hub needs a certificate and its key")
        if self.tls is None and self.password_file is None:
            raise ValueError(f"{self.endpoint}: without a password file and without TLS anyone could come in")
        for name, role in self.members.items():
            checked_name(name)
            if role not in REMOTE_ROLES or name == LOCAL_USER:
                raise ValueError(f"{name}: a member elsewhere is one of {sorted(REMOTE_ROLES)}, not {role}")

    def transport(self) -> dict[str, Any]:
        """The parts of the hub's transport configuration."""
        parts: dict[str, Any] = {}
        if self.tls is not None:
            parts["link"] = {
                "tls": {
                    "root_ca_certificate": str(self.tls.authority),
                    "listen_certificate": str(self.tls.certificate),
                    "listen_private_key": str(self.tls.key),
                    "enable_mtls": self.password_file is None,
                }
            }
        if self.password_file is not None:
            parts["auth"] = {"usrpwd": {"dictionary_file": str(self.password_file)}}
        return parts

    def control(self, fleet: str) -> dict[str, Any]:
        """The hub's access control: everything for the unix socket, the topic table's rights for each member."""
        by = "usernames" if self.password_file is not None else "cert_common_names"
        roles = sorted(set(self.members.values()))
        rules = [_EVERYTHING, *(rule for role in roles for rule in _rules_of(role, fleet))]
        subjects: list[dict[str, Any]] = [{"id": "own", "link_protocols": ["unixsock-stream"]}]
        policies: list[dict[str, Any]] = [{"rules": [_EVERYTHING["id"]], "subjects": ["own"]}]
        for role in roles:
            names = sorted(name for name, given in self.members.items() if given is role)
            protocol = self.endpoint.partition("/")[0]
            subjects.append({"id": role.value, by: names, "link_protocols": [protocol]})
            policies.append({"rules": [rule["id"] for rule in _rules_of(role, fleet)], "subjects": [role.value]})
        return {
            "enabled": True,
            "default_permission": "deny",
            "rules": rules,
            "subjects": subjects,
            "policies": policies,
        }


_EVERYTHING: dict[str, Any] = {
    "id": "everything",
    "permission": "allow",
    "flows": ["ingress", "egress"],
    "messages": [
        "put",
        "delete",
        "declare_subscriber",
        "query",
        "reply",
        "declare_queryable",
        "liveliness_token",
        "liveliness_query",
        "declare_liveliness_subscriber",
    ],
    "key_exprs": ["**", "**/@adv/**"],  # a plain ** leaves out the keys that advanced publishers recover by
}


def _rules_of(role: Role, fleet: str) -> list[dict[str, Any]]:
    """A role's rules: putting what it publishes and subscribing to what it reads, and the hub the other way round."""
    written = [_any_key(topic.key, topic.suffix, fleet) for topic in TOPICS if role in topic.publishers]
    read = [_any_key(topic.key, topic.suffix, fleet) for topic in TOPICS if role in topic.readers_elsewhere]
    wanted = (
        ("publishes", "put", "ingress", written),
        ("is_told_readers", "declare_subscriber", "egress", written),
        ("subscribes", "declare_subscriber", "ingress", read),
        ("reads", "put", "egress", read),
    )
    return [
        {"id": f"{role.value}_{what}", "permission": "allow", "flows": [flow], "messages": [message], "key_exprs": keys}
        for what, message, flow, keys in wanted
        if keys
    ]


def _any_key(key: Any, suffix: str, fleet: str) -> str:  # noqa: ANN401
    return str(key(fleet, "*") if "{" in suffix else key(fleet))


def write_password_file(path: Path, logins: Iterable[Login]) -> None:
    """Write a hub's password file, readable by this user only; the login of `LOCAL_USER` must be among them.

    Raises:
        ValueError: A user appears twice, or the fleet's own one is missing.
    """
    entries = list(logins)
    users = [login.user for login in entries]
    if len(set(users)) != len(users) or LOCAL_USER not in users:
        raise ValueError(f"users must be different and include {LOCAL_USER}, got {users}")
    _write_logins(path, entries)


def write_own_login(folder: Path, login: Login) -> None:
    """Leave the login of a fleet's own processes in its private folder."""
    _write_logins(folder / _OWN_LOGIN, [login])


def own_login(folder: Path) -> Login | None:
    """The login that :func:`write_own_login` left; None where there is no need of one."""
    try:
        user, _, password = (folder / _OWN_LOGIN).read_text().strip().partition(":")
    except FileNotFoundError:
        return None
    return Login(user=user, password=password)


def _write_logins(path: Path, logins: Iterable[Login]) -> None:
    path.unlink(missing_ok=True)
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    with os.fdopen(descriptor, "w") as file:
        file.writelines(f"{login.user}:{login.password}\n" for login in logins)
