"""The rasteriser that the settings ask for; an engine is imported only when it is chosen."""

import os
from dataclasses import replace

from vtslam.common.config import ConfigError
from vtslam.common.settings import SplatSettings
from vtslam.common.splat.engine import Engine, RasterSettings
from vtslam.services.process_facts import package_version


def thread_count(settings: SplatSettings) -> int:
    """Threads of the CPU engine: as set, or one per core that this process may use."""
    return settings.threads or len(os.sched_getaffinity(0))


def with_threads(settings: SplatSettings, threads: int) -> SplatSettings:
    """The settings with that many threads; 0 leaves them as they are."""
    return replace(settings, threads=threads or settings.threads)


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
