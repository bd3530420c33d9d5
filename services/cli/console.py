"""Where the words of a command go: text for people, JSON for programs, and progress on a terminal or in a log."""

import json
import sys
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TextIO

from tqdm import tqdm

from vtslam.common.config import ConfigError
from vtslam.storage.errors import WriteFailed

_LINE_INTERVAL_S = 5.0


class Console:
    """Text goes to standard output, unless JSON was asked for there: then to standard error.

    Args:
        json_target: A file name, ``-`` for standard output, or None for no JSON.

    Raises:
        ConfigError: The folder of the file does not exist.
    """

    def __init__(self, json_target: str | None) -> None:
        self._json_target = json_target
        self.text: TextIO = sys.stderr if json_target == "-" else sys.stdout
        if json_target not in (None, "-") and not Path(str(json_target)).parent.is_dir():
            raise ConfigError(f"--json {json_target}: there is no folder {Path(str(json_target)).parent}")

    def print(self, text: str) -> None:
        """One text for people."""
        print(text, file=self.text, flush=True)

    def result(self, values: dict[str, Any]) -> None:
        """The result as JSON, if it was asked for; raises WriteFailed."""
        if self._json_target is None:
            return
        text = json.dumps(values, indent=1, allow_nan=False)
        if self._json_target == "-":
            print(text)
            return
        try:
            Path(self._json_target).write_text(f"{text}\n", encoding="utf-8")
        except OSError as error:
            raise WriteFailed(f"--json {self._json_target}: cannot write: {error.strerror}") from error


class Progress:
    """How far a command is: a bar with rate and time left on a terminal, else a plain line every few seconds.

    Args:
        total: Steps in all; None if nobody knows.
        what: What is under way, as in "mapping".
        unit: Name of a step.
    """

    def __init__(self, total: int | None, *, what: str, unit: str) -> None:
        self._total, self._what, self._unit, self._done = total, what, unit, 0
        self._start_s = self._last_line_s = time.monotonic()
        terminal = sys.stderr.isatty()
        self._bar = tqdm(total=total, desc=what, unit=f" {unit}", file=sys.stderr, leave=False) if terminal else None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.close()

    def step(self) -> None:
        """One step is done."""
        self._done += 1
        if self._bar is not None:
            self._bar.update()
            return
        now_s = time.monotonic()
        if now_s - self._last_line_s >= _LINE_INTERVAL_S:
            self._last_line_s = now_s
            rate = self._done / (now_s - self._start_s)
            self.note(f"{self._what}: {self._done}{self._of_total(rate)}")

    def _of_total(self, rate: float) -> str:
        if self._total is None:
            return f" {self._unit}s, {rate:.2f}/s"
        left_s = (self._total - self._done) / rate
        return f" of {self._total} {self._unit}s, {rate:.2f}/s, {left_s:.0f} s left"

    def note(self, text: str) -> None:
        """A line that stays, beside the bar."""
        if self._bar is not None:
            self._bar.write(text, file=sys.stderr)
        else:
            print(text, file=sys.stderr, flush=True)
