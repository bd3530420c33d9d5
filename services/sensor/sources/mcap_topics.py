"""Which topics of a recording are colour, depth and intrinsics, and which images of them belong together."""

import re
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from vtslam.services.sensor.sources.base import SourceError
from vtslam.storage.recording import decoding
from vtslam.storage.recording.mcap_file import McapFile, Topic

_DEPTH = re.compile("depth", re.IGNORECASE)
_REGISTERED = re.compile("aligned|registered|to_color|to_rgb", re.IGNORECASE)
_COMPRESSED = re.compile("compressed", re.IGNORECASE)
_TRANSPORTS = ("compressed", "compressedDepth", "theora")  # last parts of names
_RECTIFIED = re.compile(r"(^|_)rect(_|$|ified)", re.IGNORECASE)
_NOT_COLOR = re.compile(r"infra|\bir\b|/ir_|disparity|mask|confidence|mono|theora", re.IGNORECASE)


def chosen_topic(file: McapFile, what: str, name: str | None) -> Topic:
    """The topic of colour or depth images.

    Args:
        file: The recording.
        what: "color" or "depth".
        name: The topic the user asks for; None to find it by its name.

    Raises:
        SourceError: There is none, or several that could be meant.
    """
    images = [topic for topic in file.topics.values() if decoding.is_image(topic)]
    if name is not None:
        found = [topic for topic in images if topic.name == name]
        if not found:
            raise SourceError(
                f"{file.path}: option {what}: expected a topic with images {_names(images)}, found {name!r}"
            )
        return found[0]
    if what == "depth":
        candidates = [topic for topic in images if _DEPTH.search(topic.name)]
        candidates = [topic for topic in candidates if _REGISTERED.search(topic.name)] or candidates
    else:
        candidates = [topic for topic in images if not _DEPTH.search(topic.name)]
        candidates = [topic for topic in candidates if not _NOT_COLOR.search(topic.name)] or candidates
    candidates = [topic for topic in candidates if not _COMPRESSED.search(topic.name)] or candidates
    if len(candidates) != 1:
        found_names = _names(candidates) if candidates else f"none among {_names(images)}"
        raise SourceError(
            f"{file.path}: expected one topic of {what} images (or option {what}=TOPIC), found {found_names}"
        )
    return candidates[0]


def calibration_topic(file: McapFile, images: Topic, name: str | None) -> Topic | None:
    """The topic of the intrinsics of ``images``: the one whose name is most like theirs; None if there is none.

    Raises:
        SourceError: The topic that the user asks for is not there.
    """
    candidates = [topic for topic in file.topics.values() if decoding.is_calibration(topic)]
    if name is not None:
        found = [topic for topic in candidates if topic.name == name]
        if not found:
            expected = f"a topic with intrinsics {_names(candidates)}"
            raise SourceError(f"{file.path}: option camera: expected {expected}, found {name!r}")
        return found[0]
    words = images.name.split("/")
    return max(candidates, key=lambda topic: _common(words, topic.name.split("/")), default=None)


def is_rectified(images: Topic) -> bool:
    """Whether images are free of lens distortion, by the last part of their name that does not say how they came."""
    parts = [part for part in images.name.split("/") if part not in _TRANSPORTS]
    return bool(parts) and _RECTIFIED.search(parts[-1]) is not None


def image_times_ns(file: McapFile, topic: Topic, *, by_log_time: bool) -> npt.NDArray[np.int64]:
    """Times of all images of a topic, int64 [M], in the order of the topic.

    Raises:
        StorageError: An image is damaged.
    """
    if by_log_time:
        return topic.places[:, 0]
    where = f"{file.path}: {topic.name}"
    times = (decoding.stamp_of(topic, file.message(topic, index).data, where) for index in range(len(topic)))
    return np.fromiter(times, np.int64, len(topic))


def pairs(color_ns: npt.NDArray[np.int64], depth_ns: npt.NDArray[np.int64], tolerance_ns: int) -> npt.NDArray[np.int64]:
    """Which images belong together: those nearest to each other, at most ``tolerance_ns`` apart, each taken once.

    Args:
        color_ns: Times int64 [M] in any order; of equal ones the first counts.
        depth_ns: The same, [N].
        tolerance_ns: Largest difference.

    Returns:
        int64 [F,2], indices of colour and depth, by increasing time of colour.
    """
    color, color_at = np.unique(color_ns, return_index=True)
    depth, depth_at = np.unique(depth_ns, return_index=True)
    found: list[tuple[int, int]] = []
    i = j = 0
    while i < len(color) and j < len(depth):
        apart = abs(int(depth[j]) - int(color[i]))
        if j + 1 < len(depth) and abs(int(depth[j + 1]) - int(color[i])) < apart:
            j += 1
        elif i + 1 < len(color) and abs(int(depth[j]) - int(color[i + 1])) < apart:
            i += 1
        elif apart <= tolerance_ns:
            found.append((int(color_at[i]), int(depth_at[j])))
            i, j = i + 1, j + 1
        elif color[i] < depth[j]:
            i += 1
        else:
            j += 1
    return np.array(found, np.int64).reshape(-1, 2)


def _common(words: Sequence[str], others: Sequence[str]) -> int:
    """How many leading parts of two names are equal."""
    return next(
        (k for k, (a, b) in enumerate(zip(words, others, strict=False)) if a != b), min(len(words), len(others))
    )


def _names(topics: Sequence[Topic]) -> str:
    return ", ".join(topic.name for topic in topics) or "none"
