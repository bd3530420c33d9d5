"""``vtslam settings``: all keys with their effective values, types and ranges."""

from argparse import Namespace
from typing import Any

from vtslam.common.config import describe, to_dict
from vtslam.common.config_hints import value_text
from vtslam.common.preset_loading import load_settings
from vtslam.common.settings import Settings
from vtslam.services.cli.console import Console


def settings_command(args: Namespace) -> int:
    """List the settings that the arguments make effective; the exit status."""
    console = Console(args.json)
    settings = load_settings(
        preset=args.preset, family=args.family or "tum", file=args.config, assignments=args.assignments
    )
    effective = to_dict(settings)
    rows = []
    for line in describe(Settings):
        value = _value(effective, line.key)
        rows.append({"key": line.key, "value": value, "type": line.type_text, "range": line.range_text})
    width = max(len(row["key"]) for row in rows)
    for row in rows:
        console.print(f"{row['key']:<{width}}  {value_text(row['value']):<14} {row['type']} {row['range']}".rstrip())
    console.result({"preset": args.preset, "settings": rows})
    return 0


def _value(table: dict[str, Any], key: str) -> Any:  # noqa: ANN401
    found: Any = table
    for part in key.split("."):
        found = found[part]
    return found
