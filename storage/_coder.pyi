"""Coders of section files."""

from typing import Annotated

import numpy
from numpy.typing import NDArray


def split_planes(data: Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu', writable=False)], item: int, stride: int) -> Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu')]:
    """
    Bytes uint8 [n*item] grouped by significance; with a stride, of folded differences to that element before.
    """

def join_planes(data: Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu', writable=False)], item: int, stride: int) -> Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu')]:
    """What split_planes was given."""

def quantise(values: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)], low: float, step: float) -> Annotated[NDArray[numpy.uint16], dict(shape=(None,), order='C', device='cpu')]:
    """round((values - low) / step), each of which must lie in 0 to 65535."""

def dequantise(levels: Annotated[NDArray[numpy.uint16], dict(shape=(None,), order='C', device='cpu', writable=False)], low: float, step: float) -> Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu')]:
    """low + step * levels."""

def encode_depth_images(ranks: Annotated[NDArray[numpy.int32], dict(shape=(None, None, None), order='C', device='cpu', writable=False)], largest: int) -> bytes:
    """
    Images int32 [V,H,W] of places 0 (no depth) to ``largest`` in a list, without loss.
    """

def decode_depth_images(data: bytes, shape: tuple[int, int, int], largest: int) -> Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu')]:
    """The images, flat; ValueError if the bytes are not theirs."""

def encode_gaussians(size: tuple[int, int], counts: Annotated[NDArray[numpy.uint32], dict(shape=(None, None), order='C', device='cpu', writable=False)], view_of: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu', writable=False)], view_ranks: Annotated[NDArray[numpy.int32], dict(shape=(None, None, None), order='C', device='cpu', writable=False)], largest_rank: int, scales: tuple[int, int], pixel: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu', writable=False)], subpixel: Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu', writable=False)], rank: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu', writable=False)], levels: Annotated[NDArray[numpy.int32], dict(shape=(None, None), order='C', device='cpu', writable=False)]) -> bytes:
    """
    Gaussians in the order of the format's section 6; ValueError if they are not.
    """

def decode_gaussians(data: bytes, size: tuple[int, int], counts: Annotated[NDArray[numpy.uint32], dict(shape=(None, None), order='C', device='cpu', writable=False)], view_of: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu', writable=False)], view_ranks: Annotated[NDArray[numpy.int32], dict(shape=(None, None, None), order='C', device='cpu', writable=False)], largest_rank: int, scales: tuple[int, int]) -> tuple[Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu')], Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu')], Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu')], Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu')]]:
    """
    Pixels, sub-pixels, places of depths, levels (flat); ValueError if the bytes are not theirs.
    """
