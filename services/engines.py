"""The rasteriser that the settings ask for; an engine is imported only when it is chosen."""

import os
from dataclasses import replace

from vtslam.common.config import ConfigError
from vtslam.common.settings import Settings, SplatSettings
from vtslam.common.splat.engine import Engine, RasterSettings
from vtslam.services.process_facts import package_version


def thread_count(settings: SplatSettings) -> int:
    """Threads of the CPU engine: as set, or one per core that this process may use."""
    return settings.threads or len(os.sched_getaffinity(0))


def with_threads(settings: SplatSettings, threads: int) -> SplatSettings:
    """The settings with that many threads; 0 leaves them as they are."""
    return replace(settings, threads=threads or settings.threads)


def fleet_threads(settings: Settings, own: int, *, is_realtime: bool) -> int:
    """Threads of the tracker or the mapper of a fleet.

    Args:
        settings: The effective settings.
        own: What they say of this process.
        is_realtime: Both work all the time: unless threads are set, they share the cores out. More threads than cores
            would finish nothing sooner, and whoever else has something to say would wait for all of them.
    """
    if own or not is_realtime or settings.splat.threads:
        return own
    return max(thread_count(settings.splat) // 2, 1)


def make_engine(settings: SplatSettings) -> Engine:
    """The engine of ``settings``.

    Raises:
        ConfigError: The engine is not installed, has no device, or cannot do what the settings ask for.
    """
    raster = RasterSettings(low_pass_px2=settings.low_pass_px2, near_m=settings.near_m, alpha_cap=settings.alpha_cap)
    try:
        return _made(settings, raster)
    except (ImportError, ValueError, RuntimeError) as error:
        raise ConfigError(f"splat.engine = {settings.engine}: {error}") from error


def engine_versions(settings: SplatSettings) -> dict[str, str]:
    """By name, what the chosen engine's results depend on beside the settings."""
    if settings.engine == "native":
        from vtslam.common.splat import _native

        return {"simd": _native.simd()}
    packages = ("torch", "gsplat") if settings.engine == "gsplat" else ("torch",)
    return {name: package_version(name) for name in packages}


def _made(settings: SplatSettings, raster: RasterSettings) -> Engine:
    if settings.engine == "gsplat":
        from vtslam.common.splat.gsplat_engine import GsplatEngine

        return GsplatEngine(raster)
    if settings.engine == "reference":
        from vtslam.common.splat.reference import ReferenceEngine

        return ReferenceEngine(raster)
    from vtslam.common.splat.native_engine import NativeEngine

    return NativeEngine(raster, threads=thread_count(settings))
