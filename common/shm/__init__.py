"""Shared memory of a fleet's processes: frame ring and map store (docs/protocol-shm.md)."""
