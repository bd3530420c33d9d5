"""What is known of the sections on disk without reading them again."""

from collections import Counter
from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from vtslam.common.shm.residency import ViewPlaces
from vtslam.common.shm.sealed_block import sealed_bytes_of
from vtslam.storage.catalog import Catalog
from vtslam.storage.section_record import SectionRecord


class ArchivedSections:
    """What each section takes in memory, and where its candidate views were taken.

    Args:
        catalog: Of what is on disk already.
    """

    def __init__(self, catalog: Catalog) -> None:
        rows = catalog.sections()
        views = list(catalog.views(0, len(rows)))
        counts = Counter(view.section_id for view in views)
        self._num_bytes = [
            sealed_bytes_of(
                row.camera, frames=row.num_frames, views=counts[row.section_id], gaussians=row.num_gaussians
            )
            for row in rows
        ]
        self._ids: list[int] = []
        self._poses: list[npt.NDArray[np.float64]] = []  # [6]: position, direction
        self._places: ViewPlaces | None = None
        self._add((view.section_id for view in views), (view.T_world_camera for view in views))

    def num_bytes(self, section_id: int) -> int:
        """What a section takes in memory."""
        return self._num_bytes[section_id]

    @property
    def places(self) -> ViewPlaces:
        """The candidate views."""
        if self._places is None:
            poses = np.array(self._poses, np.float64).reshape(-1, 6)
            self._places = ViewPlaces(
                section_ids=np.array(self._ids, np.int64), positions_m=poses[:, :3], directions=poses[:, 3:]
            )
        return self._places

    def add(self, record: SectionRecord) -> None:
        """One more section, the next one."""
        assert record.section_id == len(self._num_bytes)
        rows = record.view_index.tolist()
        self._num_bytes.append(
            sealed_bytes_of(record.camera, frames=record.num_frames, views=len(rows), gaussians=record.num_gaussians)
        )
        poses = (record.T_world_section @ record.T_section_frame[row] for row in rows)
        self._add((record.section_id for _ in rows), poses)

    def _add(self, section_ids: Iterable[int], T_world_camera: Iterable[npt.NDArray[np.float64]]) -> None:
        self._ids.extend(section_ids)
        self._poses.extend(np.concatenate([T[:3, 3], T[:3, 2]]) for T in T_world_camera)
        self._places = None
