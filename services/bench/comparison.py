"""A benchmark's result beside an earlier one, and where it was measured."""

import json
import platform
import statistics
import subprocess
from pathlib import Path
from typing import Any

from vtslam.common.config import ConfigError
from vtslam.services.process_facts import versions

_CPU_INFO = Path("/proc/cpuinfo")


def median_ms(seconds: list[float]) -> float:
    """The median in milliseconds."""
    return round(1e3 * statistics.median(seconds), 3)


def surroundings(command: list[str]) -> dict[str, object]:
    """Command line, machine, versions and commit: what a figure is worth nothing without."""
    return {"command": " ".join(command), "processor": _processor(), "commit": _commit(), "versions": versions()}


def read_result(path: Path) -> dict[str, Any]:
    """A result written before with ``--json``.

    Raises:
        ConfigError: It cannot be read, or is not a benchmark's result.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"--compare {path}: cannot read: {error}") from error
    if not isinstance(values, dict) or "bench" not in values:
        raise ConfigError(f"--compare {path}: expected a result of vtslam bench, found something else")
    return values


def comparison_table(found: dict[str, Any], earlier: dict[str, Any] | None) -> str:
    """One line per figure; with an earlier result also its figure and the ratio."""
    ours = flat(found)
    if earlier is None:
        return "\n".join(f"{key:32s} {_text(value):>12s}" for key, value in ours.items())
    theirs = flat(earlier)
    lines = [f"{'':32s} {'now':>12s} {'before':>12s} {'ratio':>8s}"]
    for key, value in ours.items():
        before = theirs.get(key)
        ratio = f"{value / before:8.3f}" if _is_number(value) and _is_number(before) and before else " " * 8
        lines.append(f"{key:32s} {_text(value):>12s} {_text(before):>12s} {ratio}")
    return "\n".join(lines)


def flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested figures by dotted names."""
    out: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, dict):
            out |= flat(value, f"{prefix}{key}.")
        else:
            out[prefix + key] = value
    return out


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _text(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def _processor() -> str:
    try:
        lines = _CPU_INFO.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return platform.processor() or "unknown"
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{names[0]}, {len(names)} cores" if names else "unknown"


def _commit() -> str:
    """The commit of the source tree this runs from, or "unknown"."""
    folder = Path(__file__).resolve().parent
    command = ["git", "-C", str(folder), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return "unknown"
