import io
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from parity.gsplat_stand_in import stand_in_module

from vtslam.common.geometry.camera import Camera
from vtslam.common.splat import parity
from vtslam.common.splat.engine import RasterSettings, Splats
from vtslam.common.splat.gsplat_engine import VIEW_MARGIN, GsplatEngine, GsplatUnavailableError
from vtslam.common.splat.parity_scenes import scenes
from vtslam.services.cli.doctor_gpu import run_gpu_doctor


@pytest.fixture(autouse=True)
def one_torch_thread() -> Iterator[None]:
    """OpenMP's spinning threads make small tensors many times slower wherever something else runs."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def _install(monkeypatch: pytest.MonkeyPatch, **changes: object) -> None:
    monkeypatch.setitem(sys.modules, "gsplat", stand_in_module(**changes))


def _suite(count: int) -> parity.SuiteReport:
    return parity.run_suite(
        lambda settings: GsplatEngine(settings, device="cpu"),
        count=count,
        tolerances=parity.GSPLAT_TOLERANCES,
        alpha_caps=(0.999,),
        view_margin=VIEW_MARGIN,
    )


def test_agrees_with_the_reference_through_gsplats_signature(monkeypatch: pytest.MonkeyPatch) -> None:
    _install(monkeypatch)
    assert _suite(12).failures() == []


@pytest.mark.parametrize(
    "changes",
    [
        {"eps2d": 0.35},
        {"near_plane": 0.25},
        {"viewmats": torch.diag(torch.tensor([1.0, 1.0, 1.01, 1.0]))[None]},
    ],
)
def test_the_suite_sees_a_wrong_argument(monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any]) -> None:
    _install(monkeypatch, **changes)
    assert _suite(5).failures() != []


@pytest.mark.parametrize(
    ("name", "value"), [("alpha_cap", 0.99), ("alpha_min", 1.0 / 128.0), ("transmittance_min", 1e-3)]
)
def test_refuses_constants_that_gsplat_fixes(monkeypatch: pytest.MonkeyPatch, name: str, value: float) -> None:
    _install(monkeypatch)
    with pytest.raises(ValueError, match=f"gsplat fixes {name}"):
        GsplatEngine(RasterSettings(**{name: value}), device="cpu")


def test_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(GsplatUnavailableError, match="pip install"):
        GsplatEngine(device="cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(GsplatUnavailableError, match="no CUDA device"):
        GsplatEngine()


def test_tensors_in_tensors_out(monkeypatch: pytest.MonkeyPatch) -> None:
    _install(monkeypatch)
    scene = next(scenes(3, 1))
    columns = [scene.splats.means_m, scene.splats.colors, scene.splats.log_radii, scene.splats.opacity_logits]
    means, colors, log_radii, opacity_logits = (torch.from_numpy(column) for column in columns)
    given: Any = {"means_m": means, "colors": colors, "log_radii": log_radii, "opacity_logits": opacity_logits}
    engine = GsplatEngine(device="cpu")
    ours = engine.render(Splats(**given), scene.camera, scene.T_camera_map)
    theirs = engine.render(scene.splats, scene.camera, scene.T_camera_map)
    assert isinstance(ours.rgb, torch.Tensor)
    assert isinstance(theirs.rgb, np.ndarray)
    np.testing.assert_array_equal(ours.rgb.numpy(), theirs.rgb)


def test_no_gaussians(monkeypatch: pytest.MonkeyPatch) -> None:
    _install(monkeypatch)
    empty = np.zeros((0, 3), np.float32)
    splats = Splats(means_m=empty, colors=empty, log_radii=empty[:, 0], opacity_logits=empty[:, 0])
    camera = Camera(width=7, height=5, fx=6.0, fy=6.0, cx=3.5, cy=2.5)
    engine = GsplatEngine(device="cpu")
    rendering = engine.render(splats, camera, np.eye(4))
    gradients = engine.backward(rendering, d_rgb=np.ones((5, 7, 3), np.float32), d_depth=np.ones((5, 7), np.float32))
    assert not rendering.alpha.any()
    assert gradients.colors.shape == (0, 3)
    assert not gradients.pose.any()


def test_refuses_what_is_not_finite(monkeypatch: pytest.MonkeyPatch) -> None:
    _install(monkeypatch)
    scene = next(scenes(3, 1))
    scene.splats.log_radii[0] = np.nan
    with pytest.raises(ValueError, match="log_radii"):
        GsplatEngine(device="cpu").render(scene.splats, scene.camera, scene.T_camera_map)


def test_doctor_passes(monkeypatch: pytest.MonkeyPatch) -> None:
    _install(monkeypatch)
    out = io.StringIO()
    assert run_gpu_doctor(out, count=12, device="cpu") == 0
    assert "never been executed" in out.getvalue()
    assert "gsplat   1.5.3" in out.getvalue()


def test_doctor_reports_a_wrong_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    _install(monkeypatch, eps2d=0.5)
    out = io.StringIO()
    assert run_gpu_doctor(out, count=2, device="cpu") == 1
    assert "FAILED scattered-0" in out.getvalue()


def test_doctor_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    out = io.StringIO()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert run_gpu_doctor(out) == 2
    assert "no CUDA device" in out.getvalue()
    monkeypatch.setitem(sys.modules, "gsplat", None)
    assert run_gpu_doctor(out, device="cpu") == 2
    assert 'pip install "vtslam[cuda]"' in out.getvalue()


def test_doctor_reports_kernels_that_do_not_build(monkeypatch: pytest.MonkeyPatch) -> None:
    def rasterization(**_: object) -> None:  # as gsplat does where its extension did not load
        raise AttributeError("'NoneType' object has no attribute 'CameraModelType'")

    module = stand_in_module()
    module.__dict__["rasterization"] = rasterization
    monkeypatch.setitem(sys.modules, "gsplat", module)
    out = io.StringIO()
    assert run_gpu_doctor(out, count=1, device="cpu") == 2
    assert "nvcc" in out.getvalue()
