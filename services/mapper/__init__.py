"""Grows and optimises the active section."""
