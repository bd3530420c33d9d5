"""Memory that a process has freed goes back to the system."""

import ctypes

_M_MMAP_THRESHOLD = -3  # of mallopt
_LARGE_BYTES, _RARE_BYTES = 4 << 20, 128 << 10


def give_back_free_memory() -> None:
    """Let go of pages that hold nothing any more; does nothing where the C library is not glibc.

    Arrays of some megabytes that come and go in changing sizes leave holes in the heap, which grows by them for
    thousands of frames. This takes some milliseconds, and pages that are wanted again are then taken anew.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def keep_large_arrays_apart(*, rare: bool = False) -> None:
    """Give each large array pages of its own from now on, which go back when it does; glibc only.

    A section's arrays are replaced by slightly larger ones with every frame. In the heap, where glibc would soon put
    them, each leaves a hole that no later one fits in. New pages cost a fourth of a millisecond per megabyte.

    Args:
        rare: Arrays are made now and then only: smaller ones have pages of their own too.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _RARE_BYTES if rare else _LARGE_BYTES)
