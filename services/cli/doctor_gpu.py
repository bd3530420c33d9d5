"""``vtslam doctor --gpu``: what the CUDA engine needs, and whether it computes what the reference does."""

from typing import TextIO

_OK, _WRONG, _UNAVAILABLE = 0, 1, 2
_INSTALL = 'pip install "vtslam[cuda]"'


def run_gpu_doctor(out: TextIO, *, count: int = 200, device: str = "cuda") -> int:
    """Report torch, CUDA device and gsplat, then compare the CUDA engine with the reference on random scenes.

    Args:
        out: Where the report goes.
        count: Number of scenes.
        device: torch device to run gsplat on.

    Returns:
        Exit status: 0 if all is well, 1 if the engine computes something else, 2 if something is missing.
    """
    print(
        "The CUDA path has never been executed by the authors of vtslam; this command is how to find out about yours.",
        file=out,
    )
    missing = _missing(out, device)
    if missing is not None:
        print(f"Cannot run: {missing}", file=out)
        return _UNAVAILABLE
    return _run_suite(out, count, device)


def _missing(out: TextIO, device: str) -> str | None:
    """Print what was found; the first thing missing, with what to do about it."""
    try:
        import torch
    except ImportError:
        return f"torch is not installed. Install it with: {_INSTALL}"
    print(f"torch    {torch.__version__}, built for CUDA {torch.version.cuda or 'none'}", file=out)
    if device.startswith("cuda"):
        if not torch.cuda.is_available():
            return "torch finds no CUDA device. Check `nvidia-smi`, and that torch is built for CUDA."
        print(f"device   {torch.cuda.get_device_name(device)}", file=out)
    try:
        import gsplat
    except ImportError as error:
        return f"gsplat cannot be imported ({error}). Install it with: {_INSTALL}"
    print(f"gsplat   {getattr(gsplat, '__version__', 'of unknown version')}", file=out)
    return None


def _run_suite(out: TextIO, count: int, device: str) -> int:
    from vtslam.common.splat import parity
    from vtslam.common.splat.gsplat_engine import FIXED_CONSTANTS, VIEW_MARGIN, GsplatEngine

    print("Comparing (gsplat builds its kernels at first use, which takes minutes) ...", file=out, flush=True)
    try:
        report = parity.run_suite(
            lambda settings: GsplatEngine(settings, device=device),
            count=count,
            tolerances=parity.GSPLAT_TOLERANCES,
            alpha_caps=(FIXED_CONSTANTS["alpha_cap"],),
            view_margin=VIEW_MARGIN,
        )
    except (RuntimeError, AttributeError, OSError) as error:
        # gsplat reports kernels that it could not build in any of these ways.
        print(f"Cannot run: gsplat failed with {type(error).__name__}: {error}", file=out)
        print("Its kernels need the CUDA toolkit (nvcc) of torch's CUDA version, and a C++ compiler.", file=out)
        return _UNAVAILABLE
    print(report.table(), file=out)
    failures = report.failures()
    for line in failures:
        print(f"FAILED {line}", file=out)
    print("The CUDA engine disagrees with the reference." if failures else "The CUDA engine is right.", file=out)
    return _WRONG if failures else _OK
