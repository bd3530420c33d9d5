"""What a file of rerun holds."""

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rerun.chunk import Chunk, RrdReader


def rows_of(path: Path, entity: str) -> Iterator[dict[str, Any]]:
    """What was sent under a name, in order: values by component, and the frame ("frame") unless it holds for all."""
    for chunk in _chunks(path):
        if chunk.entity_path == f"/{entity}":
            batch = chunk.to_record_batch()
            kept = [name for name in batch.column_names if ":" in name or name == "frame"]  # not rerun's own columns
            yield from batch.select(kept).to_pylist()


def entities_of(path: Path) -> dict[str, int]:
    """How many rows each name has."""
    counts: dict[str, int] = {}
    for chunk in _chunks(path):
        name = chunk.entity_path.removeprefix("/")
        counts[name] = counts.get(name, 0) + chunk.num_rows
    return counts


def _chunks(path: Path) -> list[Chunk]:
    with warnings.catch_warnings():
        # A viewer that the fleet does not wait for, on a busy machine, leaves a file without its end.
        warnings.filterwarnings("ignore", "RRD file has no footer")
        return RrdReader(str(path)).stream().to_chunks()
