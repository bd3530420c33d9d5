"""Memory that a process has freed goes back to the system."""

import ctypes


def give_back_free_memory() -> None:
    """Let go of pages that hold nothing any more; does nothing where the C library is not glibc.

    Arrays of some megabytes that come and go in changing sizes leave holes in the heap, which grows by them for
    thousands of frames. This takes some milliseconds, and pages that are wanted again are then taken anew.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
