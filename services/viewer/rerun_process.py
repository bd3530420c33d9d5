"""Rerun's own program beside the viewer: serves the browser's page and its data, or opens a window; on 127.0.0.1 only.

The server within rerun's library listens on all interfaces and cannot be told otherwise; the program can. As a module,
this is what becomes that program: ``python -m vtslam.services.viewer.rerun_process PARENT PROGRAM WORDS ...``.
"""

import ctypes
import importlib.util
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from vtslam.services.viewer.errors import ViewerError

HOST = "127.0.0.1"
SERVER_MEMORY_MB = 256  # of what was sent, for browsers that come later; beyond, the oldest that is not lasting goes
_START_S = 120.0  # at idle priority, on a busy machine
_POLL_S = 0.05
_PR_SET_PDEATHSIG = 1


def page_url(web_port: int) -> str:
    """The page that shows what is sent, for a browser."""
    return f"http://{HOST}:{web_port}/?url=rerun%2Bhttp://{HOST}:{data_port(web_port)}/proxy"


def data_port(web_port: int) -> int:
    """Where the page gets its data from."""
    return web_port + 1


class RerunProcess:
    """The program, as long as this object is not closed; it dies with this process.

    Args:
        web_port: Serve the page there, and the data on the next port; 0 to open a window.

    Attributes:
        url: Where data are sent to.

    Raises:
        ViewerError: It is not installed, a port is taken, there is no display, or it did not start.
    """

    def __init__(self, web_port: int) -> None:
        port = data_port(web_port) if web_port else _free_port()
        words = ["--bind", HOST, "--port", str(port), "--server-memory-limit", f"{SERVER_MEMORY_MB}MB"]
        if web_port:
            for needed in (web_port, port):
                _require_free(needed)
            words += ["--serve-web", "--web-viewer-port", str(web_port)]
        elif not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            raise ViewerError("there is no display to open a window on: use --web, or --save FILE.rrd")
        self.url = f"rerun+http://{HOST}:{port}/proxy"
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__, str(os.getpid()), str(_program()), *words],
            env={**os.environ, "CI": "1"},  # where rerun sends no statistics of its use
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        self._wait([port, web_port] if web_port else [port])

    @property
    def is_running(self) -> bool:
        """Whether it is still there."""
        return self._process.poll() is None

    def has_ended(self, timeout_s: float) -> bool:
        """Wait for its end; whether it has come."""
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return False
        return True

    def close(self) -> None:
        """End it."""
        self._process.kill()
        self._process.wait()

    def _wait(self, ports: Sequence[int]) -> None:
        deadline_s = time.monotonic() + _START_S
        while not all(_answers(port) for port in ports):
            if not self.is_running or time.monotonic() > deadline_s:
                self.close()
                raise ViewerError(f"rerun did not start (status {self._process.returncode})")
            time.sleep(_POLL_S)


def _program() -> Path:
    found = importlib.util.find_spec("rerun_cli")
    if found is None or found.origin is None:
        raise ViewerError("rerun is not installed: pip install 'vtslam[viewer]'")
    return Path(found.origin).parent / "rerun"


def _answers(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((HOST, port)) == 0


def _require_free(port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            raise ViewerError(f"port {port} of {HOST} cannot be had: {error.strerror}; choose another one") from error


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


def become_program(parent: int, words: Sequence[str]) -> None:
    """Replace this process by a program that is killed when ``parent`` dies, also if that happened before."""
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() == parent:
        os.execv(words[0], list(words))


if __name__ == "__main__":
    become_program(int(sys.argv[1]), sys.argv[2:])
