"""Rigid motions and the pinhole camera."""
