"""A headless Chromium that is told what to do over a pipe, and shows what its page looks like."""

import base64
import ctypes
import fcntl
import json
import os
import select
import shutil
import subprocess
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import cv2
import numpy as np
import numpy.typing as npt
import pytest

_NAMES = ("chromium", "chromium-browser", "google-chrome")
_WORDS = (
    "--headless=new",
    "--no-sandbox",
    "--use-angle=swiftshader",  # WebGL without a graphics card
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-background-networking",
    "--disable-component-update",
    "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1",  # nothing but this host
    "--no-first-run",
    "--remote-debugging-pipe",
    "--window-size=1600,1000",
)


def chromium() -> str:
    """The browser; the test is skipped where there is none."""
    for name in _NAMES:
        if (found := shutil.which(name)) is not None:
            return found
    pytest.skip(f"no browser: none of {', '.join(_NAMES)} is installed")


_LIBC = ctypes.CDLL(None, use_errno=True)
_PR_CAPBSET_DROP, _CAP_SYS_NICE = 24, 23


class Browser:
    """A browser with one page.

    Args:
        url: The page.
        folder: Of its own.
        deadline_s: For all that is asked of it.
    """

    def __init__(self, url: str, folder: Path, *, deadline_s: float) -> None:
        theirs_in, self._out = _high_pipe()
        self._in, theirs_out = _high_pipe()

        def prepare() -> None:
            _LIBC.prctl(_PR_CAPBSET_DROP, _CAP_SYS_NICE)  # as root, it would put itself before everybody else
            os.dup2(theirs_in, 3)
            os.dup2(theirs_out, 4)

        self._process = subprocess.Popen(
            [chromium(), *_WORDS, f"--user-data-dir={folder}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            preexec_fn=prepare,  # 3 and 4 are where the browser looks
            pass_fds=(3, 4),
            process_group=0,
        )
        os.close(theirs_in)
        os.close(theirs_out)
        self._deadline_s = time.monotonic() + deadline_s
        self._number, self._read = 0, b""
        pages = self._ask("Target.getTargets", {})["targetInfos"]
        target = next(page["targetId"] for page in pages if page["type"] == "page")
        self._session = self._ask("Target.attachToTarget", {"targetId": target, "flatten": True})["sessionId"]
        self._ask("Page.navigate", {"url": url}, session=self._session)

    def picture(self) -> npt.NDArray[np.uint8]:
        """What the page looks like now, uint8 [H,W,3], blue first."""
        answer = self._ask("Page.captureScreenshot", {"format": "png"}, session=self._session)
        data = np.frombuffer(base64.b64decode(answer["data"]), np.uint8)
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)

    def _ask(self, method: str, params: dict[str, Any], *, session: str | None = None) -> dict[str, Any]:
        self._number += 1
        message = {"id": self._number, "method": method, "params": params}
        message |= {} if session is None else {"sessionId": session}
        os.write(self._out, json.dumps(message).encode() + b"\0")
        while True:
            answer = json.loads(self._next())
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return dict(answer["result"])

    def _next(self) -> bytes:
        while b"\0" not in self._read:
            left_s = max(self._deadline_s - time.monotonic(), 0.0)
            assert select.select([self._in], [], [], left_s)[0], "the browser did not answer in time"
            data = os.read(self._in, 1 << 20)
            assert data, f"the browser ended with {self._process.poll()}"
            self._read += data
        found, _, self._read = self._read.partition(b"\0")
        return found

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.killpg(self._process.pid, 9)
        self._process.wait()
        os.close(self._in)
        os.close(self._out)


def _high_pipe() -> tuple[int, int]:
    """A pipe whose ends are not the descriptors that the browser's are to be."""
    low = os.pipe()
    high = tuple(fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10) for end in low)
    for end in low:
        os.close(end)
    return high[0], high[1]


def shows(page: npt.NDArray[np.uint8], image: npt.NDArray[np.uint8]) -> float:
    """How well an image (uint8 [h,w,3], blue first) is found in a page at any size: correlation, 1 is perfect."""
    gray, best = _blurred(page), -1.0
    for width in np.geomspace(160, 720, 150).astype(int).tolist():
        height = round(width * image.shape[0] / image.shape[1])
        if height > gray.shape[0] or width > gray.shape[1]:
            continue
        scaled = _blurred(cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR))
        best = max(best, float(cv2.matchTemplate(gray, scaled, cv2.TM_CCOEFF_NORMED).max()))
    return best


def _blurred(picture: "cv2.typing.MatLike") -> "cv2.typing.MatLike":
    return cv2.GaussianBlur(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), (0, 0), 2.0)
