"""Which device ``auto`` stands for."""

import pytest
import torch

from cfp.envs import make


@pytest.mark.parametrize(
    ("gpu", "reason", "device"), [(False, None, "cpu"), (True, None, "cuda"), (True, "it has 7.5", "cpu")]
)
def test_auto_is_a_gpu_that_the_kernels_run_on(monkeypatch, caplog, gpu, reason, device):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(make, "kernels_fail", lambda device: reason)
    make._automatic_device.cache_clear()
    assert make.choose_device("auto") == make.choose_device("auto") == device
    make._automatic_device.cache_clear()
    said = [record.message for record in caplog.records]
    assert said == (
        [] if reason is None else [f"device auto is the CPU, because the physics would be slow on the GPU: {reason}"]
    )
    assert make.choose_device("cpu") == "cpu"
