"""Opens the source a URI names, at a size and over a range of frames."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.geometry.camera import Camera
from vtslam.services.sensor.sources.base import Source, SourceAround, SourceError, SourceUri, with_option
from vtslam.services.sensor.sources.pose_priors import OPTIONS, with_pose_priors

Size = tuple[int, int]


def _open_replica(uri: SourceUri, size: Size | None) -> Source:
    from vtslam.services.sensor.sources.replica import open_replica

    return open_replica(uri)


def _open_seven_scenes(uri: SourceUri, size: Size | None) -> Source:
    from vtslam.services.sensor.sources.seven_scenes import open_seven_scenes

    return open_seven_scenes(uri)


def _open_kitti(uri: SourceUri, size: Size | None) -> Source:
    from vtslam.services.sensor.sources.kitti import open_kitti

    return open_kitti(uri)


def _open_tum(uri: SourceUri, size: Size | None) -> Source:
    from vtslam.services.sensor.sources.tum import open_tum

    return open_tum(uri)


def _open_scannet(uri: SourceUri, size: Size | None) -> Source:
    from vtslam.services.sensor.sources.scannet import open_scannet

    return open_scannet(uri)


def _open_scannetpp(uri: SourceUri, size: Size | None) -> Source:
    """At half size unless another is asked for, as the paper does."""
    from vtslam.services.sensor.sources.scannetpp import open_scannetpp

    source = open_scannetpp(uri)
    half = max(1, source.camera.width // 2), max(1, source.camera.height // 2)
    return source if size is not None else _resized(source, half)


def _open_realsense(uri: SourceUri, size: Size | None) -> Source:
    from vtslam.services.sensor.sources.realsense import open_realsense

    return open_realsense(uri, size)


def _open_sim(uri: SourceUri, size: Size | None) -> Source:
    if uri.path == "city":
        from vtslam.services.sensor.sources.sim_city import SimCity

        return SimCity.open(uri, size=size)
    from vtslam.services.sensor.sources.sim_room import SimRoom

    return SimRoom.open(uri, size=size)


def _open_mcap(uri: SourceUri, size: Size | None) -> Source:
    from vtslam.services.sensor.sources.mcap_recording import open_mcap

    return open_mcap(uri)


# Scheme -> (form for messages, opener). Openers import their reader when called: a run needs one of them.
_READERS: dict[str, tuple[str, Callable[[SourceUri, Size | None], Source]]] = {
    "replica": ("replica:DIR", _open_replica),
    "7scenes": ("7scenes:DIR", _open_seven_scenes),
    "tum": ("tum:DIR", _open_tum),
    "scannet": ("scannet:DIR|FILE.sens", _open_scannet),
    "scannetpp": ("scannetpp:DIR", _open_scannetpp),
    "realsense": ("realsense:[SERIAL]", _open_realsense),
    "kitti": ("kitti:DIR", _open_kitti),
    "sim": ("sim:room, sim:city", _open_sim),
    "mcap": ("mcap:FILE", _open_mcap),
}


def open_source(
    uri: str,
    *,
    size: Size | None = None,
    frames: tuple[int, int] | None = None,
    overrides: Mapping[str, str] | None = None,
) -> Source:
    """Open a source.

    Every source also takes the options ``size=WxH`` and ``range=A:B`` (frames A to B-1, then counted from 0; B may be
    left out), and those of `vtslam.services.sensor.sources.pose_priors`. The arguments replace them. They are part of
    the ``uri`` of the result, which therefore opens the very same frames again, also when the same arguments are given
    once more.

    Args:
        uri: ``scheme:path?key=value``.
        size: Width and height in pixels to resize to (a simulator renders at that size); None keeps the source's.
        frames: First frame and the one after the last; None takes all.
        overrides: Options added to the URI's, replacing those of the same name.

    Raises:
        SourceError: Unknown scheme or option, a range outside the source, or the reader's own refusals.
    """
    parsed = SourceUri.parse(uri)
    options = {**parsed.options, **(overrides or {})}
    size_text, range_text = options.pop("size", None), options.pop("range", None)
    if size is None and size_text is not None:
        size = _parsed_size(size_text)
    if parsed.scheme not in _READERS:
        known = ", ".join(form for form, _ in _READERS.values())
        raise SourceError(f"expected a source among {known}; found {uri!r}")
    asked = {key: options.pop(key) for key in OPTIONS if key in options}
    recording = source = _READERS[parsed.scheme][1](replace(parsed, options=options), size)
    if size is not None:
        source = _resized(source, size)
    if asked:
        source = with_pose_priors(source, asked, recording=recording)
    if frames is None and range_text is not None:
        frames = _parsed_range(range_text, len(source))
    return source if frames is None else _sub_range(source, frames)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Resized(SourceAround):
    """A source whose frames are scaled by `Frame.resized`."""

    scaled: Camera

    @property
    def camera(self) -> Camera:
        return self.scaled

    def frame(self, index: int) -> Frame:
        return self.inner.frame(index).resized(self.scaled.width, self.scaled.height)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _SubRange(SourceAround):
    """Frames ``first`` to ``end - 1`` of a source; ids count from 0, capture times stay the recording's."""

    first: int
    end: int

    def __len__(self) -> int:
        return self.end - self.first

    def frame(self, index: int) -> Frame:
        if not 0 <= index < len(self):
            raise IndexError(f"{self.uri}: frame {index} of {len(self)}")
        return replace(self.inner.frame(self.first + index), frame_id=index)

    def ground_truth(self) -> npt.NDArray[np.float64] | None:
        poses = self.inner.ground_truth()
        return None if poses is None else poses[self.first : self.end]


def _resized(source: Source, size: Size) -> Source:
    width, height = size
    if width < 1 or height < 1:
        raise SourceError(f"size: expected a positive width and height, found {width}x{height}")
    if size == (source.camera.width, source.camera.height):
        return source
    uri = with_option(source.uri, "size", f"{width}x{height}")
    return _Resized(inner=source, uri=uri, scaled=source.camera.resized(width, height))


def _sub_range(source: Source, frames: tuple[int, int]) -> Source:
    first, end = frames
    if not 0 <= first < end <= len(source):
        raise SourceError(f"{source.uri}: expected frames A:B with 0 <= A < B <= {len(source)}, found {first}:{end}")
    return _SubRange(inner=source, uri=with_option(source.uri, "range", f"{first}:{end}"), first=first, end=end)


def _parsed_size(text: str) -> Size:
    width, cross, height = text.partition("x")
    if not (cross and width.isdecimal() and height.isdecimal()):
        raise SourceError(f"option size: expected WxH, as in 320x240; found {text!r}")
    return int(width), int(height)


def _parsed_range(text: str, num_frames: int) -> tuple[int, int]:
    first, colon, end = text.partition(":")
    if not (colon and first.isdecimal() and (end.isdecimal() or not end)):
        raise SourceError(f"option range: expected A:B, as in 0:120; found {text!r}")
    return int(first), int(end) if end else num_frames
