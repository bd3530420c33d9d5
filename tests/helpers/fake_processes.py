"""Processes of a fleet that are none: what stands for `subprocess.Popen` where a supervisor is looked at."""

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

import pytest


class FakePopen:
    """A process that ends when it is killed, or told to."""

    started = 0
    refused: OSError | None = None  # what the system answers to further ones
    pid = 4711

    def __init__(self, *args: object, **options: object) -> None:
        if FakePopen.refused is not None:
            raise FakePopen.refused
        FakePopen.started += 1
        self.code: int | None = None

    def poll(self) -> int | None:
        return self.code

    def kill(self) -> None:
        self.code = -9

    def wait(self) -> int | None:
        return self.code


@contextmanager
def fake_processes() -> Iterator[None]:
    """While entered, no process is started."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(subprocess, "Popen", FakePopen)
        FakePopen.started, FakePopen.refused = 0, None
        yield
