"""What a run was made with, as `run.toml` keeps it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tomli_w

from vtslam.common.config import ConfigError, Range, load, load_toml, to_dict
from vtslam.storage.errors import RunFolderError

_FORMAT = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class RunFacts:
    """The run in few words.

    Attributes:
        created_by: Program and version.
        source: URI that opens the recording again.
        family, preset: Names of the settings layers.
        width, height: Size of the images as mapped, pixels; 0 while a live run knows none.
        first_frame, end_frame: The part of the source, from 0, its end not included.
        finished: The run came to its end; False while it is under way, and after it was cut off.
        interrupted: It was asked to stop early, and kept what was done.
        frames: Frames committed so far.
        seconds: Wall-clock time of the run, reading and writing included.
        peak_rss_mb: Largest resident memory of the process, or the sum over those of a fleet, 10^6 bytes.
    """

    created_by: str
    source: str
    family: str
    preset: str
    width: Annotated[int, Range(0)]
    height: Annotated[int, Range(0)]
    first_frame: Annotated[int, Range(0)]
    end_frame: Annotated[int, Range(0)]
    finished: bool = False
    interrupted: bool = False
    frames: Annotated[int, Range(0)] = 0
    seconds: Annotated[float, Range(0.0)] = 0.0
    peak_rss_mb: Annotated[float, Range(0.0)] = 0.0

    def __post_init__(self) -> None:
        if self.end_frame < self.first_frame:
            raise ValueError(f"frames: expected first_frame <= end_frame, found {self.first_frame}:{self.end_frame}")


@dataclass(frozen=True, slots=True, kw_only=True)
class RunInfo:
    """The content of `run.toml`.

    Attributes:
        facts: See there.
        settings: The effective settings as a nested table (``config.to_dict``).
        versions: Versions of what the result may depend on, by name.
    """

    facts: RunFacts
    settings: Mapping[str, Any]
    versions: Mapping[str, str] = field(default_factory=dict)

    def as_toml(self) -> str:
        """The text of the file; equal contents give equal text."""
        table = {
            "format": _FORMAT,
            "run": to_dict(self.facts),
            "versions": {name: self.versions[name] for name in sorted(self.versions)},
            "settings": self.settings,
        }
        return tomli_w.dumps(table)


def read_run_info(path: Path) -> RunInfo:
    """The content of the `run.toml` at ``path``; the settings are left to be checked by their own class.

    Raises:
        RunFolderError: The file is missing, not TOML, or not of this format.
    """
    try:
        table = load_toml(path)
        if table.get("format") != _FORMAT:
            raise ConfigError(f"{path}: format: expected {_FORMAT}, found {table.get('format', 'none')}")
        parts = {key: value for key, value in table.items() if isinstance(value, dict)}
        if set(parts) != {"run", "versions", "settings"} or len(table) != len(parts) + 1:
            raise ConfigError(f"{path}: expected format, [run], [versions] and [settings], found {sorted(table)}")
        for name, version in parts["versions"].items():
            if not isinstance(version, str):
                raise ConfigError(f"{path}: versions.{name}: expected a string, found {version!r}")
        facts = load(RunFacts, [(f"{path} [run]", parts["run"])])
    except ConfigError as error:
        raise RunFolderError(str(error)) from error
    return RunInfo(facts=facts, settings=parts["settings"], versions=parts["versions"])
