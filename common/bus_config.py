"""Configurations of zenoh sessions, as plain values: the hub of a fleet, its members, and members on other hosts.

Nothing is found and nothing listens unless it is said here: scouting and gossip are off, the hub listens on a unix
socket, and on the network only with an access rule (`vtslam.common.bus_access`).
"""

from pathlib import Path
from typing import Any

from vtslam.common.bus_access import Login, NetworkAccess, TlsFiles
from vtslam.common.private_folder import HUB_SOCKET

Config = dict[str, Any]

_LEASE_MS = 4000  # a session that is silent for so long is taken for dead
_BLOCK_US = 1_000_000  # a full socket holds up all that goes through the hub; then its session is closed, and recovers


def hub_config(folder: Path, fleet: str, access: NetworkAccess | None = None) -> Config:
    """The hub: routes between the members' sessions."""
    config = _common("router")
    config["listen"] = {"endpoints": [_socket(folder)]}
    if access is not None:
        config["listen"]["endpoints"].append(access.endpoint)
        config["access_control"] = access.control(fleet)
        transport = access.transport()
        config["transport"]["link"] |= transport.pop("link", {})
        config["transport"] |= transport
    return config


def member_config(folder: Path, login: Login | None = None) -> Config:
    """A member on the hub's host; the login is needed where the hub is open to others by password."""
    return _client(_socket(folder), login, None)


def remote_member_config(endpoint: str, *, login: Login | None = None, tls: TlsFiles | None = None) -> Config:
    """A member on another host, such as ``tls/mapping-box:7447``.

    Raises:
        ValueError: Neither a login nor a certificate is given.
    """
    if login is None and (tls is None or tls.certificate is None):
        raise ValueError(f"{endpoint}: a member on another host needs a login or a certificate")
    return _client(endpoint, login, tls)


def _client(endpoint: str, login: Login | None, tls: TlsFiles | None) -> Config:
    config = _common("client")
    config["connect"] = {"endpoints": [endpoint]}
    config["listen"] = {"endpoints": []}
    if login is not None:
        config["transport"]["auth"] = {"usrpwd": {"user": login.user, "password": login.password}}
    if tls is not None:
        config["transport"]["link"]["tls"] = tls.connecting()
    return config


def _common(mode: str) -> Config:
    return {
        "mode": mode,
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}, "delay": 0},
        "adminspace": {"enabled": False},
        "plugins_loading": {"enabled": False},
        "transport": {
            # Its segments would lie in /dev/shm beside ours and outlive a killed process.
            "shared_memory": {"enabled": False},
            "link": {
                "tx": {
                    "lease": _LEASE_MS,
                    "queue": {"congestion_control": {"block": {"wait_before_close": _BLOCK_US}}},
                }
            },
        },
    }


def _socket(folder: Path) -> str:
    return f"unixsock-stream/{folder.absolute() / HUB_SOCKET}"
