"""The simulated source ``sim:city``: a car's camera driving through a procedural town, with exact ground truth."""

import os
from functools import lru_cache
from pathlib import Path as FilePath

import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.geometry.camera import Camera
from vtslam.services.sensor.sources import sim_stereo
from vtslam.services.sensor.sources._city import Town
from vtslam.services.sensor.sources.base import SourceError, SourceUri
from vtslam.services.sensor.sources.sim_city_bodies import body_arrays, make_town
from vtslam.services.sensor.sources.sim_city_layout import town_bodies
from vtslam.services.sensor.sources.sim_city_materials import textures
from vtslam.services.sensor.sources.sim_city_path import (
    MIN_LAP_M,
    block_streets,
    lap_path,
    recorded_path,
)
from vtslam.services.sensor.sources.sim_city_streets import path_streets, segments
from vtslam.services.sensor.sources.sim_city_traffic import Traffic
from vtslam.services.sensor.sources.sim_options import SimOptions, num_threads

DEPTH_SCALE_M = 1.0 / 256.0
FRAME_PERIOD_NS = 100_000_000  # 10 Hz
NOISES = ("none", "stereo")

# KITTI odometry, sequences 00 to 02, pixel centres at whole numbers.
_KITTI = Camera.from_integer_centred(width=1241, height=376, fx=718.856, fy=718.856, cx=607.1928, cy=185.2157)
_OPTIONS = ("laps", "block", "trajectory", "traffic", "seed", "noise", "size")
_MAX_LAPS, _MAX_LAP_M, _MAX_SEED, _MAX_SIDE, _MAX_TRAFFIC = 10_000, 20_000, 2**31 - 1, 8192, 100
_CHECKED = SimOptions("sim:city")


class SimCity:
    """A drive through streets with houses, trees and parked cars; see :class:`Source`.

    The ground is flat, the camera 1.65 m above it. World axes are x right, y down, z forward at a heading of 0; the
    ground is y = 0. Every pixel has the exact depth of the ray through its centre, up to 255 m, in units of 1/256 m.
    Frames are the same bytes in whatever order and by however many threads they are made.

    Args:
        laps: Closed laps around a square block, 1 to 10000; without ``trajectory``.
        block: Metres of a lap.
        trajectory: A KITTI pose file to drive along instead: its x, z and heading. Streets follow it.
        traffic: Oncoming cars per kilometre.
        seed: Of town, springs and noise, 0 to 2**31 - 1.
        noise: ``none``, or ``stereo`` for depth noise that grows with the square of depth and ends at 90 m.
        size: Width and height of both images in pixels; intrinsics are those of KITTI 00 scaled to it.

    Raises:
        SourceError: A value is not among those allowed, or the trajectory cannot be read; the text names it.
    """

    family = "kitti"
    depth_scale_m = DEPTH_SCALE_M

    def __init__(
        self,
        *,
        laps: int = 1,
        block: int = 300,
        trajectory: str = "",
        traffic: int = 0,
        seed: int = 0,
        noise: str = "stereo",
        size: tuple[int, int] = (_KITTI.width, _KITTI.height),
    ) -> None:
        _CHECKED.check("laps", laps, 1, _MAX_LAPS)
        _CHECKED.check("block", block, int(MIN_LAP_M) + 1, _MAX_LAP_M)
        _CHECKED.check("traffic", traffic, 0, _MAX_TRAFFIC)
        _CHECKED.check("seed", seed, 0, _MAX_SEED)
        _CHECKED.check("size, width", size[0], 1, _MAX_SIDE)
        _CHECKED.check("size, height", size[1], 1, _MAX_SIDE)
        if noise not in NOISES:
            raise SourceError(f"sim:city: noise must be one of {', '.join(NOISES)}; got {noise!r}")
        if trajectory:
            file = FilePath(os.path.abspath(os.path.expanduser(trajectory)))
            self._path, drive = recorded_path(file), {"trajectory": str(file)}
            self._streets, self._driven = path_streets(self._path), self._path.places_m
        else:
            self._path, drive = lap_path(lap_m=block, laps=laps), {"laps": str(laps), "block": str(block)}
            self._streets, self._driven = block_streets(lap_m=block), lap_path(lap_m=block, laps=1).places_m
        options = {"traffic": traffic, "seed": seed, "noise": noise, "size": f"{size[0]}x{size[1]}"}
        self.uri = str(
            SourceUri(scheme="sim", path="city", options={**drive, **{k: str(v) for k, v in options.items()}})
        )
        self.camera = _KITTI.resized(*size)
        self._seed, self._noise = seed, noise
        self._poses = self._path.poses(seed)
        self._traffic = Traffic(self._path, per_km=traffic, seed=seed)
        self._town: Town | None = None
        self._texture_names: list[str] = []

    @classmethod
    def open(cls, uri: SourceUri, *, size: tuple[int, int] | None = None) -> "SimCity":
        """Open ``sim:city?laps=3&block=300&seed=1&noise=stereo&size=620x188``; ``size`` wins over the URI's.

        Raises:
            SourceError: An option is unknown, has a value that is not allowed, or does not go with another one.
        """
        options = dict(uri.options)
        unknown = sorted(options.keys() - set(_OPTIONS))
        if unknown:
            raise SourceError(f"sim:city: unknown option {unknown[0]!r}; allowed are {', '.join(_OPTIONS)}")
        if "trajectory" in options and {"laps", "block"} & options.keys():
            raise SourceError("sim:city: trajectory=FILE goes without laps and block")
        return cls(
            laps=_CHECKED.whole("laps", options.get("laps", "1")),
            block=_CHECKED.whole("block", options.get("block", "300")),
            trajectory=options.get("trajectory", ""),
            traffic=_CHECKED.whole("traffic", options.get("traffic", "0")),
            seed=_CHECKED.whole("seed", options.get("seed", "0")),
            noise=options.get("noise", "stereo"),
            size=size or _CHECKED.size(options.get("size", f"{_KITTI.width}x{_KITTI.height}"), usual="620x188"),
        )

    def __len__(self) -> int:
        """Number of frames."""
        return len(self._poses)

    def frame(self, index: int) -> Frame:
        """Frame ``index``.

        Raises:
            SourceError: There is no such frame.
        """
        if not 0 <= index < len(self):
            raise SourceError(f"sim:city: frame must be 0 to {len(self) - 1}; got {index}")
        town, camera = self._built(), self.camera
        rgb, depth_m = town.render(
            self._poses[index],
            camera.width,
            camera.height,
            (camera.fx, camera.fy, camera.cx, camera.cy),
            *body_arrays(self._traffic.cars(index), self._texture_names),
            num_threads(),
        )
        if self._noise == "stereo":
            rng = np.random.Generator(np.random.Philox(key=[self._seed, index]))
            depth_m = sim_stereo.noisy_depth(depth_m, rng)
            rgb = sim_stereo.noisy_colour(rgb, rng)
        return Frame(
            frame_id=index,
            capture_time_ns=index * FRAME_PERIOD_NS,
            rgb=rgb,
            depth=np.rint(depth_m / DEPTH_SCALE_M).astype(np.uint16),
            depth_scale_m=DEPTH_SCALE_M,
            camera=camera,
        )

    def ground_truth(self) -> npt.NDArray[np.float64]:
        """Exact poses ``T_world_camera`` float64 [F,4,4]."""
        return self._poses.copy()

    def _built(self) -> Town:
        """The town, built when its first frame is asked for."""
        if self._town is None:
            skins = _textures(self._seed)
            bodies = town_bodies(self._streets, self._driven, seed=self._seed)
            self._town, self._texture_names = make_town(bodies, segments(self._streets), skins), list(skins)
        return self._town


@lru_cache(maxsize=1)
def _textures(seed: int) -> dict[str, npt.NDArray[np.uint8]]:
    return textures(seed, num_threads=num_threads())
