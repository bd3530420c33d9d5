"""``vtslam doctor``: is everything here that a run needs, and does it compute what it should? Is a recording sound?"""

import os
import platform
import shutil
import sys
from argparse import Namespace
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from vtslam.common.config import ConfigError
from vtslam.common.frame import Frame
from vtslam.services.cli.console import Console, Progress
from vtslam.services.process_facts import package_version, program_version

_CAMERA_FRAMES = 144  # that are looked at of a live camera
_MIN_FREE_MB = 2000.0  # a long run at 640x480 stays below this


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One line of the examination: what was looked at, whether it is well, and what was found."""

    name: str
    ok: bool
    found: str


def doctor_command(args: Namespace) -> int:
    """Examine as the arguments say; 0 if all is well."""
    if args.source is not None and args.gpu:
        raise ConfigError(f"doctor: expected a recording to look at or --gpu, found {args.source} and --gpu")
    console = Console(args.json)
    if args.source is not None:
        return _examine_source(args.source, console)
    if args.gpu:
        return _examine_gpu(console)
    findings = []
    for finding in examine():
        findings.append(finding)
        console.print(f"{'ok  ' if finding.ok else 'FAIL'}  {finding.name:<10}  {finding.found}")
    console.result({"ok": all(f.ok for f in findings), "findings": [asdict(f) for f in findings]})
    return 0 if all(f.ok for f in findings) else 1


def _examine_gpu(console: Console) -> int:
    """Examine the CUDA engine; the status of `run_gpu_doctor`."""
    from vtslam.services.cli.doctor_gpu import run_gpu_doctor

    status = run_gpu_doctor(console.text)
    console.result({"ok": status == 0, "status": status})
    return status


def _examine_source(uri: str, console: Console) -> int:
    """Examine a recording; 0 if nothing is wrong with it."""
    from vtslam.services.sensor.sources.base import live_camera
    from vtslam.services.sensor.sources.registry import open_source
    from vtslam.services.sensor_check.examination import examine, planned_looks

    source = open_source(uri)
    camera = live_camera(source)
    looks = planned_looks(len(source) if camera is None else _CAMERA_FRAMES)
    with ExitStack() as stack:
        if camera is not None:
            stack.callback(camera.close)
        progress = stack.enter_context(Progress(len(looks.frames), what="looking", unit="frame"))

        def looked_at(index: int) -> Frame:
            progress.step()
            return source.frame(index)

        frames = (looked_at(index) for index in looks.frames)
        findings = examine(frames, looks, family=source.family, truth=source.ground_truth())
    for finding in findings:
        console.print(f"{'ok  ' if finding.ok else 'FAIL'}  {finding.name:<15}  {finding.found}")
    ok = all(finding.ok for finding in findings)
    console.result({"ok": ok, "source": source.uri, "findings": [asdict(finding) for finding in findings]})
    return 0 if ok else 1


def examine() -> Iterator[Finding]:
    """All findings, one by one."""
    yield Finding(name="vtslam", ok=True, found=program_version())
    system = f"{platform.system()} {platform.release()}, {platform.machine()}"
    yield Finding(name="system", ok=platform.system() == "Linux", found=system)
    yield Finding(name="python", ok=sys.version_info >= (3, 11), found=platform.python_version())
    for package in ("numpy", "opencv-python-headless", "msgpack"):
        yield Finding(name=package.partition("-")[0], ok=True, found=package_version(package))
    yield from _native_findings()
    yield _memory()
    yield _disk()


def _native_findings() -> Iterator[Finding]:
    try:
        from vtslam.common.optim import _align  # noqa: F401
        from vtslam.common.splat import _native
        from vtslam.services.sensor.sources import _raycast  # noqa: F401
    except ImportError as error:
        yield Finding(name="native", ok=False, found=f"{error}; install vtslam again with a C++ compiler at hand")
        return
    cores = len(os.sched_getaffinity(0))
    yield Finding(name="threads", ok=True, found=f"{_native.threads()} of {cores} cores that this process may use")
    for name in _native.available_simd():
        chosen = " (in use)" if name == _native.simd() else ""
        yield _checked(name, partial(_on_simd, name), after=chosen)


def _on_simd(name: str) -> str:
    """The self-test on one instruction set, leaving the choice as it was."""
    from vtslam.common.splat import _native
    from vtslam.services.cli.render_check import largest_error

    chosen = _native.simd()
    _native.select_simd(name)
    try:
        error = largest_error()
    finally:
        _native.select_simd(chosen)
    if not error < 1e-5:
        raise ArithmeticError(f"renders wrongly: {error:.2g} away from the known numbers")
    return f"renders the known numbers to {error:.1g}"


def _checked(name: str, check: Callable[[], str], *, after: str) -> Finding:
    try:
        return Finding(name=name, ok=True, found=check() + after)
    except (ArithmeticError, ValueError) as error:
        return Finding(name=name, ok=False, found=f"{error}{after}")


def _memory() -> Finding:
    lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
    free_mb = next(int(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith("MemAvailable:"))
    return Finding(name="memory", ok=free_mb > _MIN_FREE_MB, found=f"{free_mb:.0f} MB available")


def _disk() -> Finding:
    free_mb = shutil.disk_usage(Path.cwd()).free / 1e6
    return Finding(name="disk", ok=free_mb > _MIN_FREE_MB, found=f"{free_mb:.0f} MB free in {Path.cwd()}")
