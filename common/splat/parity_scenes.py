"""Random scenes on which two rasterisers are compared, with what is hard for a fast one in each kind."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vtslam.common.geometry import se3
from vtslam.common.geometry.camera import Camera
from vtslam.common.splat.engine import RasterSettings, Splats

# Width, height: within a tile, across several, rarely a multiple of one; small enough for the reference.
_SIZES = ((33, 17), (7, 5), (65, 47), (1, 1), (50, 40), (31, 64), (16, 16), (1, 40), (61, 3), (48, 35), (97, 66))
_DEPTH_GAP_M = 2e-5  # float32 keeps the order of depths further apart than this
_NEAR_GAP_M = 1e-4  # and agrees on what lies behind the near plane


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene:
    """One comparison.

    Attributes:
        name: Kind and number.
        splats, camera, T_camera_map, settings: What is rendered.
        d_rgb, d_depth, d_alpha: Random image derivatives to pull back, float32, shapes of the images.
    """

    name: str
    splats: Splats
    camera: Camera
    T_camera_map: npt.NDArray[np.float64]
    settings: RasterSettings
    d_rgb: npt.NDArray[np.float32]
    d_depth: npt.NDArray[np.float32]
    d_alpha: npt.NDArray[np.float32]


@dataclass(slots=True, kw_only=True, eq=False)
class _Draft:
    """Gaussians in the camera frame while a scene is made: image means, depth, sigma in pixels, opacity."""

    means_px: npt.NDArray[np.float64]  # [N,2]
    depth_m: npt.NDArray[np.float64]  # [N], may be negative
    sigma_px: npt.NDArray[np.float64]  # [N], at the depth's magnitude
    opacity: npt.NDArray[np.float64]  # [N]


def _scattered(rng: np.random.Generator, camera: Camera, count: int) -> _Draft:
    """Over the image and a margin around it, mostly about a pixel wide, as view-tied Gaussians are."""
    size = np.array([camera.width, camera.height])
    return _Draft(
        means_px=rng.uniform(-0.15, 1.15, (count, 2)) * size,
        depth_m=rng.uniform(0.4, 6.0, count),
        sigma_px=np.exp(rng.uniform(np.log(0.4), np.log(4.0), count)),
        opacity=rng.uniform(0.02, 0.98, count),
    )


def _borders(rng: np.random.Generator, camera: Camera, count: int) -> _Draft:
    draft = _scattered(rng, camera, count)
    side = rng.integers(0, 4, count)
    limit = np.array([0.0, 0.0, camera.width, camera.height])[side]
    draft.means_px[np.arange(count), side % 2] = limit + rng.choice([-1.5, -0.5, 0.0, 0.5, 1.5], count)
    return draft


def _behind(rng: np.random.Generator, camera: Camera, count: int) -> _Draft:
    draft = _scattered(rng, camera, count)
    draft.depth_m *= rng.choice([-1.0, 1.0], count)
    draft.depth_m[: count // 8] = rng.uniform(-0.05, 0.05, count // 8)
    return draft


def _near_plane(rng: np.random.Generator, camera: Camera, count: int) -> _Draft:
    draft = _scattered(rng, camera, count)
    draft.depth_m = rng.uniform(0.15, 0.3, count)
    return draft


def _deep(rng: np.random.Generator, camera: Camera, count: int) -> _Draft:
    """Hundreds over each other in the middle, each faint."""
    draft = _scattered(rng, camera, 4 * count)
    size = np.array([camera.width, camera.height])
    draft.means_px = size * 0.5 + rng.normal(0.0, 1.5, (4 * count, 2))
    draft.sigma_px = rng.uniform(1.0, 3.0, 4 * count)
    draft.opacity = rng.uniform(0.01, 0.06, 4 * count)
    return draft


def _huge(rng: np.random.Generator, camera: Camera, count: int) -> _Draft:
    draft = _scattered(rng, camera, max(count // 8, 3))
    draft.sigma_px = rng.uniform(0.5, 4.0, draft.sigma_px.shape) * max(camera.width, camera.height)
    draft.opacity *= 0.7
    return draft


def _invisible(rng: np.random.Generator, camera: Camera, count: int) -> _Draft:
    draft = _scattered(rng, camera, count)
    draft.opacity[rng.random(count) < 0.7] = rng.uniform(1e-7, 0.003)
    return draft


def _none(rng: np.random.Generator, camera: Camera, count: int) -> _Draft:
    return _scattered(rng, camera, 0)


def _opaque(rng: np.random.Generator, camera: Camera, count: int) -> _Draft:
    """Many reach the cap, and pixels end early."""
    draft = _scattered(rng, camera, count)
    draft.opacity = 1.0 - 10.0 ** rng.uniform(-5.0, -1.0, count)
    return draft


def _tiny(rng: np.random.Generator, camera: Camera, count: int) -> _Draft:
    """Far below a pixel: only the low-pass gives them a width."""
    draft = _scattered(rng, camera, count)
    draft.sigma_px = 10.0 ** rng.uniform(-4.0, -1.0, count)
    return draft


def _view_tied(rng: np.random.Generator, camera: Camera, count: int) -> _Draft:
    """One per pixel of a slanted, stepped surface with the radius of Eq. 3, seen from a little aside."""
    v, u = np.mgrid[: camera.height, : camera.width].reshape(2, -1) + 0.5
    depth = 1.5 + 0.02 * u + 0.5 * (v > camera.height / 2) + rng.uniform(0.0, 0.01, u.shape)
    pick = rng.permutation(u.size)[: 6 * count]
    aside = rng.uniform(-2.0, 2.0, 2)
    return _Draft(
        means_px=np.stack([u, v], 1)[pick] + aside,
        depth_m=depth[pick],
        sigma_px=rng.uniform(0.8, 1.25, pick.size),
        opacity=rng.uniform(0.4, 0.95, pick.size),
    )


_KINDS: dict[str, Callable[[np.random.Generator, Camera, int], _Draft]] = {
    "scattered": _scattered,
    "borders": _borders,
    "view-tied": _view_tied,
    "behind": _behind,
    "near-plane": _near_plane,
    "deep": _deep,
    "huge": _huge,
    "invisible": _invisible,
    "opaque": _opaque,
    "ties": _scattered,
    "tiny": _tiny,
    "none": _none,
}


def _spread(depth_m: npt.NDArray[np.float64], near_m: float) -> npt.NDArray[np.float64]:
    """Depths moved apart where float32 could order them differently, and away from the near plane."""
    order = np.argsort(depth_m, kind="stable")
    ordered = depth_m[order]
    steps = np.arange(ordered.size) * _DEPTH_GAP_M
    ordered = np.maximum.accumulate(ordered - steps) + steps  # at least one gap apart
    close = np.abs(ordered - near_m) < _NEAR_GAP_M
    out = np.empty_like(depth_m)
    out[order] = np.where(close, near_m - _NEAR_GAP_M - steps, ordered)
    return out


def _random_camera(rng: np.random.Generator, width: int, height: int) -> Camera:
    fx = float(max(width, height) * rng.uniform(0.7, 1.4))
    fy = float(fx * rng.uniform(0.9, 1.1))
    cx, cy = (float(value) for value in rng.uniform(0.4, 0.6, 2) * (width, height))
    return Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)


def _splats(rng: np.random.Generator, draft: _Draft, camera: Camera, T_map_camera: npt.NDArray[np.float64]) -> Splats:
    depth = draft.depth_m
    rays = np.ones((depth.size, 3))
    rays[:, :2] = (draft.means_px - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    means = (rays * depth[:, None]) @ T_map_camera[:3, :3].T + T_map_camera[:3, 3]
    sigma_m = draft.sigma_px * np.maximum(np.abs(depth), 1e-3) / camera.mean_focal_px
    return Splats(
        means_m=means.astype(np.float32),
        colors=rng.uniform(-0.3, 1.3, (depth.size, 3)).astype(np.float32),
        log_radii=np.log(sigma_m).astype(np.float32),
        opacity_logits=np.log(draft.opacity / (1.0 - draft.opacity)).astype(np.float32),
    )


def _with_ties(splats: Splats) -> Splats:
    """The second half takes the first half's positions: exact ties in depth, other looks."""
    half = splats.count // 2
    means = splats.means_m.copy()
    means[half : 2 * half] = means[:half]
    return Splats(means_m=means, colors=splats.colors, log_radii=splats.log_radii, opacity_logits=splats.opacity_logits)


def _within_view(draft: _Draft, camera: Camera, margin: float) -> _Draft:
    """Only what lies within the image widened by ``margin`` half-sizes on each side."""
    size = np.array([camera.width, camera.height])
    keep = (np.abs(draft.means_px - 0.5 * size) < 0.5 * (1.0 + margin) * size).all(1)
    return _Draft(
        means_px=draft.means_px[keep],
        depth_m=draft.depth_m[keep],
        sigma_px=draft.sigma_px[keep],
        opacity=draft.opacity[keep],
    )


def _scene(
    rng: np.random.Generator, name: str, draft: _Draft, camera: Camera, settings: RasterSettings, *, ties: bool = False
) -> Scene:
    T_camera_map = se3.exp(rng.normal(0.0, [0.3, 0.3, 0.3, 0.8, 0.8, 0.8]))
    draft.depth_m = _spread(draft.depth_m, settings.near_m)
    splats = _splats(rng, draft, camera, se3.inverse(T_camera_map))
    size = (camera.height, camera.width)
    return Scene(
        name=name,
        splats=_with_ties(splats) if ties else splats,
        camera=camera,
        T_camera_map=T_camera_map,
        settings=settings,
        d_rgb=rng.normal(size=(*size, 3)).astype(np.float32),
        d_depth=rng.normal(size=size).astype(np.float32),
        d_alpha=rng.normal(size=size).astype(np.float32),
    )


def scenes(
    seed: int, count: int, *, alpha_caps: tuple[float, ...] = (0.999, 0.99), view_margin: float | None = None
) -> Iterator[Scene]:
    """``count`` random scenes of all kinds and sizes in turn, the same for the same ``seed``.

    Args:
        seed: Seed of all random choices.
        count: Number of scenes.
        alpha_caps: Caps to alternate; an engine with a fixed cap is given that one only.
        view_margin: Leave out Gaussians further outside the image than this many half-sizes, for an engine whose
            image model differs there.
    """
    for index in range(count):
        rng = np.random.default_rng([seed, index])
        kind = list(_KINDS)[index % len(_KINDS)]
        width, height = _SIZES[(index + index // len(_KINDS)) % len(_SIZES)]
        camera = _random_camera(rng, width, height)
        low_pass = 0.3 if kind == "tiny" or index % 3 == 2 else 0.001
        settings = RasterSettings(low_pass_px2=low_pass, alpha_cap=alpha_caps[(index // 2) % len(alpha_caps)])
        draft = _KINDS[kind](rng, camera, int(rng.integers(4, 120)))
        if view_margin is not None:
            draft = _within_view(draft, camera, view_margin)
        yield _scene(rng, f"{kind}-{index}", draft, camera, settings, ties=kind == "ties")


def crowded_scene(seed: int, count: int = 20_000) -> Scene:
    """A small image with ``count`` Gaussians in and around it: more than a fast engine takes in one piece."""
    rng = np.random.default_rng([seed, 2])
    camera = _random_camera(rng, 33, 17)
    draft = _scattered(rng, camera, count)
    draft.means_px = rng.uniform(-1.0, 2.0, (count, 2)) * (camera.width, camera.height)
    draft.sigma_px *= 0.5
    draft.opacity *= 0.1
    return _scene(rng, "crowded", draft, camera, RasterSettings(low_pass_px2=0.3))


def smooth_scenes(seed: int, count: int) -> Iterator[Scene]:
    """Scenes without cuts: each Gaussian is above ``alpha_min`` and below the cap at every pixel, none ends a pixel.

    Their images are differentiable, so that finite differences mean something.
    """
    for index in range(count):
        rng = np.random.default_rng([seed, index, 1])
        width, height = _SIZES[index % len(_SIZES)]
        camera = _random_camera(rng, width, height)
        diagonal = float(np.hypot(width, height))
        number = int(rng.integers(3, 9))
        draft = _Draft(
            means_px=rng.uniform(0.3, 0.7, (number, 2)) * (width, height),
            depth_m=rng.uniform(0.8, 5.0, number),
            sigma_px=rng.uniform(0.4, 1.0, number) * diagonal,
            opacity=rng.uniform(0.2, 0.6, number),
        )
        yield _scene(rng, f"smooth-{index}", draft, camera, RasterSettings(low_pass_px2=(0.001, 0.3)[index % 2]))
