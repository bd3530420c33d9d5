"""A run folder opened again together with its source: sections, poses and renderings of its frames."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from vtslam.common.config import load
from vtslam.common.exposure import Exposure
from vtslam.common.frame import Frame
from vtslam.common.geometry import se3
from vtslam.common.section import Section
from vtslam.common.settings import Settings
from vtslam.common.splat.engine import Rendering
from vtslam.services.engines import make_engine
from vtslam.services.sensor.sources.registry import open_source
from vtslam.services.supervisor.processes import LIVE_SOURCE
from vtslam.storage.catalog_rows import STORED
from vtslam.storage.errors import RunFolderError
from vtslam.storage.run_folder import RunFolder
from vtslam.storage.section_convert import SectionArchive


class RecordedRun:
    """What a run left, read back; sections are loaded one by one, so memory does not grow with the run.

    Args:
        path: The run folder.

    Attributes:
        folder: The run folder, open for reading.
        info: What the run was made with.
        settings: Its effective settings.
        source: Its recording, opened again.
        rows: The facts per frame.
        poses: float64 [F,4,4], ``T_world_camera`` of frames 0 to F-1, by their newest version.

    Raises:
        StorageError: There is no run, or it cannot be read.
        ConfigError: Its settings are refused, or its engine is not there.
        SourceError: Its source cannot be opened any more.
    """

    def __init__(self, path: Path) -> None:
        self.folder = RunFolder.open(path)
        self.info = self.folder.read_info()
        if self.info.facts.source == LIVE_SOURCE:
            raise RunFolderError(
                f"{path}: publishers fed this run, and their frames, which its map is held against, are gone; "
                "record the next one (vtslam up --record FILE)"
            )
        self.settings: Settings = load(Settings, [(f"{path / 'run.toml'} [settings]", self.info.settings)])
        self.source = open_source(self.info.facts.source)
        self._engine = make_engine(self.settings.splat)
        self._archive = SectionArchive(self.folder)
        # Sections first: of a run that goes on, what comes after them may be longer, and never shorter.
        self._section_ids = [row.section_id for row in self.folder.catalog.sections() if row.state == STORED]
        self.rows: list[dict[str, Any]] = self.folder.read_frames()
        self.poses = self.folder.catalog.poses()[1][: len(self.rows)]
        self._check()
        self._frames_of = _ranges([row["section_id"] for row in self.rows])

    @property
    def num_frames(self) -> int:
        """Frames that were committed."""
        return len(self.rows)

    def section(self, section_id: int) -> Section:
        """A section from disk."""
        return self._archive.read(section_id)

    def section_ids(self) -> list[int]:
        """Ids of the sections that are whole on disk and in the catalogue, in order."""
        return list(self._section_ids)

    def frames_in_sections(self) -> list[int]:
        """The committed frames that belong to one of these sections."""
        return [frame_id for section_id in self._section_ids for frame_id in self.frames_of(section_id)]

    def frames_of(self, section_id: int) -> range:
        """The committed frames of a section, which are consecutive; empty for a section that there is not."""
        return self._frames_of.get(section_id, range(0))

    def frame(self, frame_id: int) -> Frame:
        """A frame of the recording."""
        return self.source.frame(frame_id)

    def render(self, section: Section, frame_id: int) -> Rendering:
        """``section`` as frame ``frame_id`` would show it: from its committed pose, with its exposure."""
        T_camera_section = se3.inverse(section.T_section_camera(self.poses[frame_id]))
        rendering = self._engine.render(section.splats, section.camera, T_camera_section)
        return replace(rendering, rgb=self._exposure(frame_id).applied(rendering.rgb))

    def _exposure(self, frame_id: int) -> Exposure:
        row = self.rows[frame_id]
        return Exposure(
            gain=np.array(row["exposure_gain"], np.float32), offset=np.array(row["exposure_offset"], np.float32)
        )

    def true_poses(self) -> npt.NDArray[np.float64] | None:
        """True ``T_world_camera`` [F,4,4] of the committed frames, NaN where it is not known; None if nowhere."""
        truth = self.source.ground_truth()
        truth = None if truth is None else truth[: self.num_frames]
        return None if truth is None or not np.isfinite(truth).any() else truth

    def _check(self) -> None:
        facts = self.info.facts
        size = (self.source.camera.width, self.source.camera.height)
        if size != (facts.width, facts.height) or len(self.source) != facts.end_frame:
            raise RunFolderError(
                f"{self.folder.path}: {facts.source}: expected the {facts.end_frame} frames of "
                f"{facts.width}x{facts.height} that the run was made from, found {len(self.source)} of "
                f"{size[0]}x{size[1]}"
            )
        if not self.rows:
            raise RunFolderError(f"{self.folder.path}: no frame was committed; nothing to evaluate")
        frame_ids = [row["frame_id"] for row in self.rows]
        if frame_ids != list(range(len(frame_ids))):
            raise RunFolderError(
                f"{self.folder.path}: expected every frame up to frame {frame_ids[-1]}, found {len(frame_ids)} of "
                f"{frame_ids[-1] + 1}: a run that leaves frames out, as --pacing realtime does to keep up with time, "
                "cannot be looked at or judged"
            )


def holds_every_frame(run: RunFolder) -> bool:
    """Whether a run mapped frames, and left none of them out."""
    return 0 < run.catalog.num_frames == run.catalog.last_frame_id + 1


def _ranges(section_ids: list[int]) -> dict[int, range]:
    """Where each section begins and ends, given the section of every frame."""
    out: dict[int, range] = {}
    for frame_id, section_id in enumerate(section_ids):
        out[section_id] = range(out[section_id].start if section_id in out else frame_id, frame_id + 1)
    return out
