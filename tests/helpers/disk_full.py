"""Script: a small recording through a fleet whose run folder lies on a disk that gets full, and again with more room.

Arguments: a folder that is a small tmpfs, the recording's folder. Prints how the run ended, what was durable, how
going on ended, and the checksums of what the run left.
"""

import contextlib
import hashlib
import io
import json
import subprocess
import sys
from pathlib import Path

from helpers.fleet_runs import ASSIGNMENTS, result_bytes

from vtslam.services.cli.__main__ import main as vtslam
from vtslam.storage.run_folder import RunFolder


def main() -> None:
    """Run, make room, go on."""
    disk, recording = (Path(word) for word in sys.argv[1:3])
    run, words = disk / "run", [word for each in ASSIGNMENTS for word in ("--set", each)]
    told = io.StringIO()
    with contextlib.redirect_stdout(told), contextlib.redirect_stderr(told):
        status = vtslam(["run", f"replica:{recording}", "--out", str(run), "--family", "tum", *words])
        catalog = RunFolder.open(run).catalog
        durable = catalog.num_frames
        catalog.close()
        subprocess.run(["mount", "-o", "remount,size=64m", str(disk)], check=True)
        resumed = vtslam(["run", "--resume", str(run)])
    files = {name: hashlib.sha256(data).hexdigest() for name, data in result_bytes(run).items()}
    lines = told.getvalue().splitlines()
    print(json.dumps({"status": status, "durable": durable, "resumed": resumed, "told": lines, "files": files}))


if __name__ == "__main__":
    main()
