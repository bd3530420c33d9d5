"""Poses of the camera from the transforms of a recording."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vtslam.common.geometry import se3
from vtslam.services.sensor.sources.base import SourceError
from vtslam.storage.recording import decoding
from vtslam.storage.recording.mcap_file import McapFile

_LONGEST_GAP_NS = 500_000_000  # between two transforms that are interpolated
_STATIC = "static"  # in the names of topics whose transforms hold for ever


@dataclass(frozen=True, slots=True, eq=False)
class _Link:
    """``T_parent_child`` over time: strictly increasing times int64 [M] and poses float64 [M,4,4]."""

    parent: str
    times_ns: npt.NDArray[np.int64]
    poses: npt.NDArray[np.float64]
    is_static: bool

    def at(self, time_ns: int) -> npt.NDArray[np.float64] | None:
        """The transform at a time, interpolated; None outside of what was recorded."""
        if self.is_static:
            return np.asarray(self.poses[0])
        after = int(np.searchsorted(self.times_ns, time_ns))
        if after < len(self.times_ns) and self.times_ns[after] == time_ns:
            return np.asarray(self.poses[after])
        if after in (0, len(self.times_ns)):
            return None
        start_ns, end_ns = int(self.times_ns[after - 1]), int(self.times_ns[after])
        if end_ns - start_ns > _LONGEST_GAP_NS:
            return None
        start, end = self.poses[after - 1], self.poses[after]
        share = (time_ns - start_ns) / (end_ns - start_ns)
        return se3.orthonormalized(se3.exp(share * se3.log(end @ se3.inverse(start))) @ start)


class TransformPoses:
    """Where the camera is by the transforms of a recording.

    Args:
        file: The recording.
        topic: The topic of transforms; those of topics with "static" in their names are added.
        camera: Coordinate frame of the camera (x right, y down, z forward), as its images name it.
        world: Coordinate frame of the world; None for the one that everything hangs on.

    Raises:
        SourceError: The camera does not hang on such a frame.
        StorageError: A message is damaged.
    """

    def __init__(self, file: McapFile, topic: str, camera: str, world: str | None) -> None:
        links = _links(file, topic)
        self._chain: list[_Link] = []
        name, seen = camera.lstrip("/"), set[str]()
        while name in links and name != world and name not in seen:
            seen.add(name)
            self._chain.append(links[name])
            name = links[name].parent
        if not self._chain or (world is not None and name != world):
            known = ", ".join(sorted({*links, *(link.parent for link in links.values())}))
            raise SourceError(
                f"{file.path}: {topic}: expected transforms from {camera!r} up to {world or 'a world'!r}, "
                f"found them among {known or 'no frames'}"
            )

    def at(self, time_ns: int) -> npt.NDArray[np.float64] | None:
        """``T_world_camera`` float64 [4,4] at a time; None where it was not recorded."""
        out = np.eye(4)
        for link in self._chain:
            T_parent_child = link.at(time_ns)
            if T_parent_child is None:
                return None
            out = T_parent_child @ out
        return se3.orthonormalized(out) if len(self._chain) > 1 else out


def _links(file: McapFile, topic: str) -> dict[str, _Link]:
    """What is known of each child's parent."""
    found: dict[str, dict[int, decoding.TransformMessage]] = {}
    static: set[str] = set()
    for name, each in file.topics.items():
        if not decoding.is_transform(each) or (name != topic and _STATIC not in name):
            continue
        where = f"{file.path}: {name}"
        for index in range(len(each)):
            for transform in decoding.transforms_of(each, file.message(each, index).data, where):
                found.setdefault(transform.child, {})[transform.stamp_ns] = transform
                if _STATIC in name:
                    static.add(transform.child)
    return {child: _link(by_time, is_static=child in static) for child, by_time in found.items()}


def _link(by_time: dict[int, decoding.TransformMessage], *, is_static: bool) -> _Link:
    ordered = [by_time[time_ns] for time_ns in sorted(by_time)]
    return _Link(
        parent=ordered[-1].parent,
        times_ns=np.array([each.stamp_ns for each in ordered], np.int64),
        poses=np.stack([each.T_parent_child for each in ordered]),
        is_static=is_static,
    )
