"""Runs the CUDA kernels wherever tests run: on a GPU, or in Triton's interpreter on the CPU."""

import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import torch

if importlib.util.find_spec("triton") is None:
    pytest.skip("no Triton", allow_module_level=True)

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


@contextmanager
def interpreted() -> Iterator[None]:
    """Triton's interpreter where there is no GPU; all others who use Triton in this process want its compiler."""
    with pytest.MonkeyPatch.context() as patch:
        if DEVICE == "cpu":
            patch.setenv("TRITON_INTERPRET", "1")
        yield


with interpreted():  # read where a kernel is defined, those of Triton itself included
    from torchmpm.native import cuda, kernels


@contextmanager
def in_use() -> Iterator[None]:
    """Meanwhile, tensors on the CPU go to the CUDA kernels instead of those in C++."""
    with interpreted(), pytest.MonkeyPatch.context() as patch:
        if DEVICE == "cpu":
            patch.setattr(kernels, "forward", cuda.forward)
            patch.setattr(kernels, "backward", cuda.backward)
        yield
