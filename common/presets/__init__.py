"""Presets: schedules and families as TOML files."""
