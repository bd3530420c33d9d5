"""The protocol of all sources, their errors, and the URI that names one."""

import os
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable
from urllib.parse import parse_qsl, urlencode

import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.geometry.camera import Camera


class SourceError(ValueError):
    """A source cannot be read: the text names the file, what was expected and what was found."""


class Source(Protocol):
    """Frames in order, seekable, the same bytes at each reading."""

    @property
    def uri(self) -> str:
        """The text that opens it again, from any working directory."""
        ...

    @property
    def family(self) -> str:
        """The settings family that fits it (`vtslam.common.preset_loading.FAMILIES`)."""
        ...

    @property
    def camera(self) -> Camera:
        """Intrinsics of all frames."""
        ...

    @property
    def depth_scale_m(self) -> float:
        """Metres per unit of the uint16 depth."""
        ...

    def __len__(self) -> int:
        """Number of frames."""
        ...

    def frame(self, index: int) -> Frame:
        """Frame ``index``; raises SourceError if its files are missing, cut or inconsistent."""
        ...

    def ground_truth(self) -> npt.NDArray[np.float64] | None:
        """True poses ``T_world_camera`` float64 [F,4,4], NaN for single frames without, or None if there are none."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SourceAround:
    """A source that changes the frames of another, and is like it in all else.

    Attributes:
        inner: The other.
        uri: The text that opens the changed one.
    """

    inner: Source
    uri: str

    @property
    def family(self) -> str:
        """As `Source.family`."""
        return self.inner.family

    @property
    def camera(self) -> Camera:
        """As `Source.camera`."""
        return self.inner.camera

    @property
    def depth_scale_m(self) -> float:
        """As `Source.depth_scale_m`."""
        return self.inner.depth_scale_m

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.inner)

    def frame(self, index: int) -> Frame:
        """As `Source.frame`."""
        return self.inner.frame(index)

    def ground_truth(self) -> npt.NDArray[np.float64] | None:
        """As `Source.ground_truth`."""
        return self.inner.ground_truth()


@runtime_checkable
class LiveCamera(Protocol):
    """What a source that is a camera offers beside `Source`: its frames are there once, and never end."""

    @property
    def counters(self) -> dict[str, int]:
        """What was lost so far, by kind."""
        ...

    def close(self) -> None:
        """Stop the camera."""
        ...


def live_camera(source: Source) -> LiveCamera | None:
    """The camera that a source takes its frames from; None for recordings."""
    inner: object = source
    while not isinstance(inner, LiveCamera):
        inner = getattr(inner, "inner", None)
        if inner is None:
            return None
    return inner


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceUri:
    """``scheme:path?key=value&key=value``, as typed by users."""

    scheme: str
    path: str
    options: dict[str, str] = field(default_factory=dict)

    @classmethod
    def parse(cls, text: str) -> "SourceUri":
        """Split a source URI.

        Raises:
            SourceError: There is no scheme, or an option is not ``key=value``.
        """
        scheme, colon, rest = text.partition(":")
        if not colon or not scheme:
            raise SourceError(f"a source reads scheme:path, as in replica:DIR or sim:room; got {text!r}")
        path, _, query = rest.partition("?")
        try:
            options = dict(parse_qsl(query, strict_parsing=True)) if query else {}
        except ValueError as error:
            raise SourceError(f"options of a source read ?key=value&key=value; got {query!r}") from error
        return cls(scheme=scheme, path=path, options=options)

    def files(self) -> list[str]:
        """What the path and the options may name on disk."""
        return [os.path.expanduser(text) for text in (self.path, *self.options.values()) if text]

    def __str__(self) -> str:
        """The text that :meth:`parse` reads back."""
        query = f"?{urlencode(self.options, safe=':/,')}" if self.options else ""
        return f"{self.scheme}:{self.path}{query}"


def with_option(uri: str, key: str, value: str) -> str:
    """The URI with an option more, or with another value of it."""
    parsed = SourceUri.parse(uri)
    return str(replace(parsed, options={**parsed.options, key: value}))
