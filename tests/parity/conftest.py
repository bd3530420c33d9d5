from collections.abc import Iterator

import pytest
import torch

from vtslam.common.splat import _native


@pytest.fixture(autouse=True)
def one_torch_thread() -> Iterator[None]:
    """OpenMP's spinning threads make small tensors many times slower wherever something else runs."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(params=_native.available_simd())
def simd(request: pytest.FixtureRequest) -> Iterator[str]:
    """Each instruction set in turn, best first."""
    before = _native.simd()
    name: str = request.param
    _native.select_simd(name)
    yield name
    _native.select_simd(before)
