"""Processes for tests of shared memory: forked from a script with one thread, as forking with more is not safe.

A test calls :func:`run_script` on a module of this folder; the script forks its actors and prints one JSON value.
"""

import json
import os
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from helpers.processes import source_environment


def run_script(name: str, *arguments: str, prefix: Sequence[str] = (), timeout_s: float = 120.0) -> Any:  # noqa: ANN401
    """Run ``tests/helpers/NAME.py`` with arguments, perhaps by way of another command; the JSON value it prints."""
    folder = Path(__file__).resolve().parent
    environment = source_environment()
    environment["PYTHONPATH"] = os.pathsep.join([str(folder.parent), environment["PYTHONPATH"]])
    environment |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [*prefix, sys.executable, str(folder / f"{name}.py"), *arguments],
        env=environment,
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def forked(action: Callable[[], None]) -> int:
    """The pid of a new process that does ``action`` and ends, with status 0 if nothing was raised."""
    assert len(os.listdir("/proc/self/task")) == 1
    pid = os.fork()
    if pid:
        return pid
    status = 1
    try:
        action()
        status = 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(status)


def ended(pid: int) -> int:
    """Wait for a process: its exit status, or minus the signal that ended it."""
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def killed(pid: int) -> None:
    """Kill a process, stopped or not, and wait for its end."""
    os.kill(pid, signal.SIGKILL)
    ended(pid)


class Progress:
    """What forked processes report through a pipe, so that waiting for it needs no polling."""

    def __init__(self) -> None:
        self._read, self._write = os.pipe()
        self.text = ""

    def say(self, text: str) -> None:
        """Report some characters."""
        os.write(self._write, text.encode())

    def listen(self) -> None:
        """Leave reporting to the processes forked so far: when they have ended, so has the report."""
        os.close(self._write)

    def wait_for(self, count: int) -> None:
        """Wait until so many characters were reported, or those who report have ended."""
        while len(self.text) < count and (data := os.read(self._read, 4096)):
            self.text += data.decode()

    def rest(self) -> str:
        """All that was reported, once those who report have ended."""
        with os.fdopen(self._read) as rest:
            self.text += rest.read()
        return self.text
