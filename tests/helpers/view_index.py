"""Candidate views whose depth is at hand, as an index."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vtslam.common.overlap.coarse import CoarseDepth
from vtslam.common.overlap.selection import CandidateView
from vtslam.common.overlap.view_index import ViewFacts, ViewIndex


@dataclass(frozen=True, slots=True)
class DepthsAtHand:
    """Depth by section and row."""

    of_views: dict[tuple[int, int], npt.NDArray[np.uint16]]

    def view_depth(self, section_id: int, section_row: int) -> npt.NDArray[np.uint16]:
        return self.of_views[section_id, section_row]

    def coarse_depth(self, section_id: int, section_row: int, frame_id: int) -> CoarseDepth | None:
        return None


def index_of(views: Sequence[CandidateView]) -> ViewIndex:
    """An index of views, given in order of time."""
    rows = [0 if view.is_head else 1 + number for number, view in enumerate(views)]
    index = ViewIndex(DepthsAtHand({(v.section_id, row): v.depth for v, row in zip(views, rows, strict=True)}))
    for view, row in zip(views, rows, strict=True):
        index.add(
            ViewFacts(
                section_id=view.section_id,
                section_row=row,
                frame_id=view.frame_id,
                T_world_camera=view.T_world_camera,
                farthest=int(view.depth.max()),
                depth_scale_m=view.depth_scale_m,
                camera=view.camera,
            )
        )
    return index
