"""Write the sample configurations of a hub that is open to other hosts, from the code that the fleet itself uses.

They show what a `NetworkAccess` comes to; `zenohd --config FILE` takes them as well. Run it again after the topic table
or the rules changed: ``python deploy/make_hub_samples.py deploy``.
"""

import json
import sys
from pathlib import Path

from vtslam.common.bus_access import NetworkAccess, TlsFiles
from vtslam.common.bus_config import hub_config
from vtslam.common.topics import Role

FLEET = "kitchen"
_SECRETS = Path("/etc/vtslam")
_MEMBERS = {"camera": Role.REMOTE_SENSOR, "robot": Role.OBSERVER}
_TLS = TlsFiles(authority=_SECRETS / "authority.pem", certificate=_SECRETS / "hub.pem", key=_SECRETS / "hub.key")

SAMPLES = {
    "hub-certificates.json5": (
        "Members are told apart by the common names of their certificates.",
        NetworkAccess(endpoint="tls/0.0.0.0:7447", members=_MEMBERS, tls=_TLS),
    ),
    "hub-passwords.json5": (
        "Members log in by password, over TLS; /etc/vtslam/passwords has a line user:password for each, and for local.",
        NetworkAccess(endpoint="tls/0.0.0.0:7447", members=_MEMBERS, password_file=_SECRETS / "passwords", tls=_TLS),
    ),
}


def sample(name: str) -> str:
    """The text of a sample."""
    what, access = SAMPLES[name]
    config = hub_config(Path("/run/vtslam") / FLEET, FLEET, access)
    return f"// {what}\n// Written by deploy/make_hub_samples.py.\n{json.dumps(config, indent=2)}\n"


def main(folder: Path) -> None:
    """Write all samples."""
    for name in SAMPLES:
        (folder / name).write_text(sample(name))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
