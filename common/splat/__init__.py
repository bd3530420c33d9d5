"""Rasteriser engines behind one protocol."""
