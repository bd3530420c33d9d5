"""The simulated source ``sim:room``: a furnished room seen by a hand-held RGB-D camera, with exact ground truth."""

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.geometry.camera import Camera
from vtslam.services.sensor.sources import sim_kinect, sim_path
from vtslam.services.sensor.sources._raycast import Scene
from vtslam.services.sensor.sources.base import SourceError, SourceUri
from vtslam.services.sensor.sources.sim_layout import PATH_CENTRE_M, furnished_room
from vtslam.services.sensor.sources.sim_options import SimOptions, num_threads

DEPTH_SCALE_M = 0.0002
FRAME_PERIOD_NS = 33_333_333  # 30 Hz
NOISES = ("none", "kinect")

_FOCAL_PER_WIDTH = 525.0 / 640.0
_MAX_FRAMES, _MAX_SEED, _MAX_SIDE = 100_000, 2**31 - 1, 8192
_CHECKED = SimOptions("sim:room")


class SimRoom:
    """A walk through a textured, furnished room of 5 x 4 x 2.6 m that ends where it began; see :class:`Source`.

    Every pixel has the exact depth of the ray through its centre, rounded to 0.2 mm; colour is the same from every
    view but for sampling. Frames are the same bytes in whatever order and by however many threads they are made.

    Args:
        frames: Length of the closed path, 2 to 100000.
        seed: Of textures, path and noise, 0 to 2**31 - 1.
        noise: ``none``, or ``kinect`` for the noise of a structured-light camera.
        size: Width and height of both images in pixels; pixels are square, the horizontal field of view is 62.7
            degrees.

    Raises:
        SourceError: A value is not among those allowed; the text names it.
    """

    family = "tum"
    depth_scale_m = DEPTH_SCALE_M

    def __init__(
        self, *, frames: int = 120, seed: int = 0, noise: str = "none", size: tuple[int, int] = (640, 480)
    ) -> None:
        _CHECKED.check("frames", frames, 2, _MAX_FRAMES)
        _CHECKED.check("seed", seed, 0, _MAX_SEED)
        _CHECKED.check("size, width", size[0], 1, _MAX_SIDE)
        _CHECKED.check("size, height", size[1], 1, _MAX_SIDE)
        if noise not in NOISES:
            raise SourceError(f"sim:room: noise must be one of {', '.join(NOISES)}; got {noise!r}")
        width, height = size
        self.uri = f"sim:room?frames={frames}&seed={seed}&noise={noise}&size={width}x{height}"
        focal = _FOCAL_PER_WIDTH * width
        self.camera = Camera(width=width, height=height, fx=focal, fy=focal, cx=0.5 * width, cy=0.5 * height)
        self._seed = seed
        self._noise = noise
        self._poses = sim_path.poses(frames, centre_m=PATH_CENTRE_M, seed=seed)

    @classmethod
    def open(cls, uri: SourceUri, *, size: tuple[int, int] | None = None) -> "SimRoom":
        """Open ``sim:room?frames=60&seed=1&noise=kinect&size=320x240``; ``size`` wins over the one in the URI.

        Raises:
            SourceError: The path is not ``room``, or an option is unknown or has a value that is not allowed.
        """
        if uri.scheme != "sim" or uri.path != "room":
            raise SourceError(f"the simulated source is sim:room; got {uri.scheme}:{uri.path}")
        unknown = sorted(uri.options.keys() - {"frames", "seed", "noise", "size"})
        if unknown:
            raise SourceError(f"sim:room: unknown option {unknown[0]!r}; allowed are frames, seed, noise and size")
        options = uri.options
        return cls(
            frames=_CHECKED.whole("frames", options.get("frames", "120")),
            seed=_CHECKED.whole("seed", options.get("seed", "0")),
            noise=options.get("noise", "none"),
            size=size or _CHECKED.size(options.get("size", "640x480"), usual="320x240"),
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
            raise SourceError(f"sim:room: frame must be 0 to {len(self) - 1}; got {index}")
        camera = self.camera
        rgb, depth_m, cosine = _scene(self._seed).render(
            self._poses[index],
            camera.width,
            camera.height,
            (camera.fx, camera.fy, camera.cx, camera.cy),
            num_threads(),
        )
        if self._noise == "kinect":
            rng = np.random.Generator(np.random.Philox(key=[self._seed, index]))
            depth_m = sim_kinect.noisy_depth(depth_m, cosine, rng)
            rgb = sim_kinect.noisy_colour(rgb, rng)
        return Frame(
            frame_id=index,
            capture_time_ns=index * FRAME_PERIOD_NS,
            rgb=rgb,
            depth=np.rint(depth_m / DEPTH_SCALE_M).astype(np.uint16),
            depth_scale_m=DEPTH_SCALE_M,
            camera=camera,
        )

    def ground_truth(self) -> npt.NDArray[np.float64]:
        """Exact poses ``T_world_camera`` float64 [F,4,4]; world z is up, the origin a corner of the floor."""
        return self._poses.copy()


@lru_cache(maxsize=2)
def _scene(seed: int) -> Scene:
    return furnished_room(seed, num_threads=num_threads())
