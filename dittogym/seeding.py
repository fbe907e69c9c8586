"""Random numbers of torch within a run or an episode."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Seed torch's generators of all devices, and restore them afterwards."""
    with torch.random.fork_rng(devices=range(torch.cuda.device_count())):
        torch.manual_seed(seed)
        yield


def noise_seed(seed: int, step: int) -> int:
    """Seed of a policy's noise in a step of the episode with this seed."""
    return int(np.random.SeedSequence((seed, step)).generate_state(1)[0])
