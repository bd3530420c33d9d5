"""Frames read ahead: in order, each error at its frame's turn, a live camera only when asked."""

from dataclasses import dataclass, field

import pytest

from vtslam.common.frame import Frame
from vtslam.services.sensor.sources.base import SourceAround, SourceError
from vtslam.services.sensor.sources.read_ahead import ReadAhead
from vtslam.services.sensor.sources.registry import open_source

_URI = "sim:room?frames=4&size=16x12"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Watched(SourceAround):
    """Notes what is read; one frame cannot be."""

    broken: int = -1
    read: list[int] = field(default_factory=list)

    def frame(self, index: int) -> Frame:
        self.read.append(index)
        if index == self.broken:
            raise SourceError(f"frame {index} is broken")
        return self.inner.frame(index)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Camera(_Watched):
    """As a camera offers itself."""

    @property
    def counters(self) -> dict[str, int]:
        return {}

    def close(self) -> None:
        """Nothing to stop."""


def test_frames_come_in_order_from_the_first_asked_for() -> None:
    source = open_source(_URI)
    with ReadAhead(source, first=1) as frames:
        found = [frames.next() for _ in range(3)]
    assert [frame.frame_id for frame in found] == [1, 2, 3]
    assert all((frame.depth == source.frame(frame.frame_id).depth).all() for frame in found)


def test_error_is_raised_at_its_frames_turn() -> None:
    source = _Watched(inner=open_source(_URI), uri=_URI, broken=2)
    with ReadAhead(source) as frames:
        assert [frames.next().frame_id, frames.next().frame_id] == [0, 1]
        with pytest.raises(SourceError, match="frame 2 is broken"):
            frames.next()
    assert source.read == [0, 1, 2]


def test_camera_is_read_only_when_asked() -> None:
    camera = _Camera(inner=open_source(_URI), uri=_URI)
    with ReadAhead(camera) as frames:
        frames.next()
    assert camera.read == [0]
    recording = _Watched(inner=open_source(_URI), uri=_URI)
    with ReadAhead(recording) as frames:
        frames.next()
    assert recording.read[:1] == [0]
    assert set(recording.read) <= {0, 1}
