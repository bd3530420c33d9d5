"""What storing sections costs in each codec: bytes per Gaussian against the quality of what comes back, and speed."""

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

import cv2
import numpy as np

from vtslam.common import metrics
from vtslam.common.frame import Frame
from vtslam.services.recorded_run import RecordedRun
from vtslam.services.run_plan import RunPlan
from vtslam.services.sensor.sources.base import Source
from vtslam.storage.dense_section import DenseGrid
from vtslam.storage.section_codecs import SectionCodec
from vtslam.storage.section_convert import section_of
from vtslam.storage.section_file import column_bytes, decode_section, encode_section
from vtslam.storage.section_record import SectionRecord

RATE_WEIGHT, RATE_COARSENESS = 0.05, 1.4  # of `dense_rate`; unless the settings have a weight; times storage.coarseness
OTHER_FORMATS = {"ply_3dgs": 248, "splatam_14_floats": 56, "vtgaussian_released": 64}  # bytes per Gaussian, raw
_HOLDOUT, _EVALUATED_INTERVAL = 8, 5
_CURVE_FACTORS = (0.6, 1.0, 1.6, 2.5)
_VIEW_COLUMNS = ("view_depth", "view_stream", "view_index")
_REPEATS = 2

T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class Quality:
    """Mean PSNR over every 5th mapped frame (paper's protocol) and over held-out frames (valid pixels); None: none."""

    psnr_paper_db: float | None
    psnr_heldout_db: float | None


@dataclass(slots=True)
class _Sums:
    """Over the sections stored so far; seconds are of one core."""

    gaussians: int = 0
    file_bytes: int = 0
    view_bytes: int = 0
    raw_bytes: int = 0
    encode_s: float = 0.0
    decode_s: float = 0.0
    exact: bool = True


def bench_codec(plan: RunPlan, *, curves: bool, on_step: Callable[[], None] = lambda: None) -> dict[str, object]:
    """Map the recording without and with a rate term, and store both maps.

    Args:
        plan: The recording and settings. Without ``holdout`` every 8th regular frame is held out. ``dense`` is on the
            usual grid, ``dense_rate`` on one 1.4 times as coarse as ``storage.coarseness``.
        curves: Also measure ``dense`` on coarser and finer grids.
        on_step: Called after each of the 2 runs and each map stored and looked at.

    Returns:
        By codec: bytes per Gaussian, quality and what of it is lost, speed. Losses are from the map that was mapped
        without a rate term and kept bit by bit.
    """
    weight = plan.settings.mapper.rate_weight or RATE_WEIGHT
    with TemporaryDirectory(prefix="vtslam-bench-") as folder:
        plain, rated = (
            _mapped(plan, Path(folder) / name, rate_weight=value, on_done=on_step)
            for name, value in (("plain", 0.0), ("rated", weight))
        )
        recording = _recording_bytes(plan.source)
        reference = _quality(plain, lambda record: record)
        found: dict[str, object] = {}
        coarseness = RATE_COARSENESS * plan.settings.storage.coarseness
        coarser = DenseGrid().coarser(coarseness)
        stored: tuple[tuple[str, RecordedRun, SectionCodec, DenseGrid | None], ...] = (
            ("lossless", plain, "lossless", None),
            ("fast", plain, "fast", None),
            ("dense", plain, "dense", None),
            ("dense_rate", rated, "dense", coarser),
        )
        for name, run, codec, grid in stored:
            found[name] = _stored(run, codec, grid, reference, recording)
            on_step()
        if curves:
            found["curves"] = {
                name: [_point(run, factor, on_step) for factor in _CURVE_FACTORS]
                for name, run in (("dense", plain), ("dense_rate", rated))
            }
    settings = {
        "rate_weight": weight,
        "rate_coarseness": coarseness,
        "bytes_per_gaussian_of_others": OTHER_FORMATS,
        "recording_bytes": recording,
    }
    return {**found, "reference": asdict(reference), **settings}


def steps(*, curves: bool) -> int:
    """How often :func:`bench_codec` calls ``on_step``."""
    return 6 + (2 * len(_CURVE_FACTORS) if curves else 0)


def _mapped(plan: RunPlan, path: Path, *, rate_weight: float, on_done: Callable[[], None]) -> RecordedRun:
    """The run folder of the recording mapped with that rate term, kept without loss."""
    s = plan.settings
    settings = replace(
        s,
        holdout=s.holdout or _HOLDOUT,
        mapper=replace(s.mapper, rate_weight=rate_weight),
        storage=replace(s.storage, codec="lossless"),
    )
    replace(plan, settings=settings).execute(path)
    on_done()
    return RecordedRun(path)


def _stored(
    run: RecordedRun, codec: SectionCodec, grid: DenseGrid | None, reference: Quality, recording_bytes: int
) -> dict[str, float | bool | None]:
    """A codec's figures on a run."""
    sums = _Sums()
    quality = _quality(run, partial(_through, codec=codec, grid=grid, sums=sums))
    return {
        "bytes_per_gaussian": round((sums.file_bytes - sums.view_bytes) / sums.gaussians, 4),
        "file_bytes_per_gaussian": round(sums.file_bytes / sums.gaussians, 4),
        "gaussians": sums.gaussians,
        **asdict(quality),
        "psnr_loss_db": _difference(reference.psnr_paper_db, quality.psnr_paper_db),
        "heldout_loss_db": _difference(reference.psnr_heldout_db, quality.psnr_heldout_db),
        "encode_mb_s": round(1e-6 * sums.raw_bytes / sums.encode_s, 1),
        "decode_mb_s": round(1e-6 * sums.raw_bytes / sums.decode_s, 1),
        "exact": sums.exact,
        "map_over_recording": round(sums.file_bytes / recording_bytes, 4),
    }


def _point(run: RecordedRun, factor: float, on_done: Callable[[], None]) -> dict[str, float | None]:
    """The dense codec on a grid ``factor`` times as coarse."""
    sums = _Sums()
    quality = _quality(run, partial(_through, codec="dense", grid=DenseGrid().coarser(factor), sums=sums))
    on_done()
    size = round((sums.file_bytes - sums.view_bytes) / sums.gaussians, 4)
    return {"grid_factor": factor, "bytes_per_gaussian": size, **asdict(quality)}


def _through(record: SectionRecord, *, codec: SectionCodec, grid: DenseGrid | None, sums: _Sums) -> SectionRecord:
    """The section as it comes back, its costs added to ``sums``."""
    name = Path(f"section {record.section_id}")
    encode_s, data = _timed(lambda: encode_section(record, codec, name=name, grid=grid))
    decode_s, found = _timed(lambda: decode_section(data, name=name))
    stored = column_bytes(data, name=name)
    sums.gaussians += record.num_gaussians
    sums.file_bytes += len(data)
    sums.view_bytes += sum(stored.get(column, 0) for column in _VIEW_COLUMNS)
    sums.raw_bytes += sum(column.nbytes for column in record.columns().values())
    sums.encode_s += encode_s
    sums.decode_s += decode_s
    same = (
        a.tobytes() == b.tobytes() for a, b in zip(record.columns().values(), found.columns().values(), strict=True)
    )
    sums.exact &= all(same)
    return found


def _timed(work: Callable[[], T]) -> tuple[float, T]:
    """The shortest of some times that ``work`` took this thread, seconds, and its result."""
    times = []
    for _ in range(_REPEATS):
        start_s = time.thread_time()
        result = work()
        times.append(time.thread_time() - start_s)
    return min(times), result


def _quality(run: RecordedRun, through: Callable[[SectionRecord], SectionRecord]) -> Quality:
    """Quality of a run whose sections are passed through something first."""
    mapped: list[float | None] = []
    heldout: list[float | None] = []
    for section_id in run.section_ids():
        section = section_of(through(run.folder.read_section(section_id)))
        for frame_id in run.frames_of(section_id):
            held_out = run.rows[frame_id]["held_out"]
            if not held_out and frame_id % _EVALUATED_INTERVAL:
                continue
            found = metrics.frame_quality(run.render(section, frame_id), run.frame(frame_id), section=section_id)
            (heldout if held_out else mapped).append(found.psnr_valid_db if held_out else found.psnr_paper_db)
    return Quality(psnr_paper_db=_mean(mapped), psnr_heldout_db=_mean(heldout))


def _recording_bytes(source: Source) -> int:
    """Bytes of the recording as JPEG of quality 90 and PNG depth."""
    return sum(_frame_bytes(source.frame(index)) for index in range(len(source)))


def _frame_bytes(frame: Frame) -> int:
    colour = cv2.imencode(".jpg", frame.rgb[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])[1]
    return int(colour.size + cv2.imencode(".png", frame.depth)[1].size)


def _mean(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _difference(before: float | None, after: float | None) -> float | None:
    return None if before is None or after is None else round(before - after, 4)
