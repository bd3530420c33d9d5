"""Readers of recordings and simulated sensors, behind one protocol."""
