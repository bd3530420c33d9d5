"""RGB-D SLAM by splatting view-tied 3D Gaussians.

Run a recording, look at what it left, judge it::

    >>> import tempfile, vtslam
    >>> out = tempfile.mkdtemp() + "/run"
    >>> short = ["source.frames=0:6", "section.length=3"]
    >>> summary = vtslam.run("sim:room?frames=60&size=96x72", out, assignments=short)
    >>> summary.frames, summary.sections, summary.lost
    (6, 2, 0)
    >>> run = vtslam.open_run(out)
    >>> run.poses.shape  # T_world_camera of every frame
    (6, 4, 4)
    >>> run.render(run.section(1), 5).rgb.shape  # the map of section 1 as frame 5 sees it
    (72, 96, 3)
    >>> metrics = vtslam.evaluate(out)
    >>> metrics["ate_rmse_m"] < 0.05
    True

Or feed frames of your own, one by one, and take the poses as they come::

    >>> class Sections(vtslam.Archive):  # where finished sections go; a run folder has SectionArchive
    ...     def __init__(self): self.kept = {}
    ...     def write(self, section): self.kept[section.section_id] = section
    ...     def read(self, section_id): return self.kept[section_id]
    >>> settings = vtslam.load_settings(preset="fast", assignments=["section.length=2"])
    >>> sections = Sections()
    >>> system = vtslam.System(settings, vtslam.make_engine(settings.splat), sections, threads=1)
    >>> source = vtslam.open_source("sim:room?frames=60", size=(96, 72))
    >>> for index in range(3):
    ...     report = system.process(source.frame(index))
    >>> report.tracking.state.name, report.commit.T_world_camera.shape, sorted(sections.kept)
    ('OK', (4, 4), [0])

Names are imported when they are first used, so that ``import vtslam`` costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vtslam.common.config import ConfigError
    from vtslam.common.external_pose import ExternalPose
    from vtslam.common.frame import Frame
    from vtslam.common.gaussians import ViewTiedGaussians
    from vtslam.common.geometry.camera import Camera
    from vtslam.common.preset_loading import load_settings
    from vtslam.common.section import Section
    from vtslam.common.settings import Settings
    from vtslam.common.splat.engine import Engine, RasterSettings, Rendering, Splats
    from vtslam.common.splat.native_engine import NativeEngine
    from vtslam.services.api import evaluate, open_run, run
    from vtslam.services.engines import make_engine
    from vtslam.services.frame_facts import FrameFacts
    from vtslam.services.recorded_run import RecordedRun
    from vtslam.services.run_record import RunSummary
    from vtslam.services.sensor.publisher import FramePublisher
    from vtslam.services.sensor.sources.base import Source, SourceError
    from vtslam.services.sensor.sources.registry import open_source
    from vtslam.services.system import Archive, FrameReport, System
    from vtslam.storage.errors import StorageError
    from vtslam.storage.run_folder import RunFolder
    from vtslam.storage.section_convert import SectionArchive

_HOMES = {
    "Archive": "services.system",
    "Camera": "common.geometry.camera",
    "ConfigError": "common.config",
    "Engine": "common.splat.engine",
    "ExternalPose": "common.external_pose",
    "Frame": "common.frame",
    "FrameFacts": "services.frame_facts",
    "FramePublisher": "services.sensor.publisher",
    "FrameReport": "services.system",
    "NativeEngine": "common.splat.native_engine",
    "RasterSettings": "common.splat.engine",
    "RecordedRun": "services.recorded_run",
    "Rendering": "common.splat.engine",
    "RunFolder": "storage.run_folder",
    "RunSummary": "services.run_record",
    "Section": "common.section",
    "SectionArchive": "storage.section_convert",
    "Settings": "common.settings",
    "Source": "services.sensor.sources.base",
    "SourceError": "services.sensor.sources.base",
    "Splats": "common.splat.engine",
    "StorageError": "storage.errors",
    "System": "services.system",
    "ViewTiedGaussians": "common.gaussians",
    "evaluate": "services.api",
    "load_settings": "common.preset_loading",
    "make_engine": "services.engines",
    "open_run": "services.api",
    "open_source": "services.sensor.sources.registry",
    "run": "services.api",
}

__all__ = [
    "Archive",
    "Camera",
    "ConfigError",
    "Engine",
    "ExternalPose",
    "Frame",
    "FrameFacts",
    "FramePublisher",
    "FrameReport",
    "NativeEngine",
    "RasterSettings",
    "RecordedRun",
    "Rendering",
    "RunFolder",
    "RunSummary",
    "Section",
    "SectionArchive",
    "Settings",
    "Source",
    "SourceError",
    "Splats",
    "StorageError",
    "System",
    "ViewTiedGaussians",
    "evaluate",
    "load_settings",
    "make_engine",
    "open_run",
    "open_source",
    "run",
]


def __getattr__(name: str) -> object:
    """A public name, imported from where it lives (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module 'vtslam' has no attribute {name!r}")
    value: object = getattr(import_module(f"vtslam.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """The public names."""
    return __all__
