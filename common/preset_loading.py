"""Effective settings: defaults, then the family, the schedule, the user's file and single assignments."""

import tomllib
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from vtslam.common.config import ConfigError, Layer, load, load_toml, parse_assignment
from vtslam.common.settings import Settings

SCHEDULES = ("fast", "paper", "released", "realtime")
FAMILIES = ("tum", "replica", "scannet", "scannetpp", "kitti")


def _preset(kind: str, name: str, known: tuple[str, ...]) -> Layer:
    if name not in known:
        raise ConfigError(f"unknown {kind} {name!r}; one of {', '.join(known)}")
    text = (files("vtslam.common.presets") / kind / f"{name}.toml").read_text(encoding="utf-8")
    table: dict[str, Any] = tomllib.loads(text)
    return f"{kind} {name}", table


def load_settings(
    *, preset: str = "fast", family: str = "tum", file: Path | None = None, assignments: Sequence[str] = ()
) -> Settings:
    """The settings of a run, later layers over earlier ones.

    Args:
        preset: Schedule, one of ``SCHEDULES``.
        family: Kind of recording, one of ``FAMILIES``.
        file: A user's TOML file, or None.
        assignments: ``key=value`` texts.

    Raises:
        ConfigError: An unknown key or preset, a wrong type, a value out of range; the text names its origin.
    """
    layers: list[Layer] = [_preset("family", family, FAMILIES), _preset("schedule", preset, SCHEDULES)]
    if file is not None:
        layers.append((str(file), load_toml(file)))
    layers += [(f"--set {text}", parse_assignment(text)) for text in assignments]
    return load(Settings, layers)
