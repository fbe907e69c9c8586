"""Latest actions as further channels of an observation, for policies that have to notice a delay.

An image alone hides how late actions arrive; with the latest actions beside it the process is Markovian again (Ramstedt
and Pal, "Real-Time Reinforcement Learning", NeurIPS 2019; Bouteiller et al., "Reinforcement Learning with Random
Delays", ICLR 2021).
"""

from __future__ import annotations

import torch
from torch import Tensor

from dittogym.observation import SIZE

#: Value of a pixel for an action of 1, less that for 0.
SCALE = 127.5


def channels(history: int) -> int:
    """Channels of an observation with the latest ``history`` actions."""
    return 3 + 2 * history


def stack(image: Tensor, actions: Tensor) -> Tensor:
    """An image (B, 3, 64, 64) uint8 with the latest actions (B, H, 2, R, R), newest first: (B, 3 + 2 H, 64, 64) uint8.

    Actions are enlarged without interpolation, and rounded to 1/127.5.
    """
    batch, history, _, size, _ = actions.shape
    values = ((actions.detach().clamp(-1.0, 1.0) + 1.0) * SCALE).round().to(torch.uint8)
    index = torch.arange(SIZE, device=actions.device) * size // SIZE
    enlarged = values.view(batch, 2 * history, size, size)[..., index[:, None], index]
    return torch.cat((image, enlarged), 1)


def clear(actions: Tensor, starts: Tensor) -> Tensor:
    """Latest actions (B, H, 2, R, R), zero where an episode begins, ``starts`` (B,) bool."""
    return actions.masked_fill(starts[:, None, None, None, None], 0.0)


def push(actions: Tensor, newest: Tensor) -> Tensor:
    """Latest actions (B, H, 2, R, R) after one more (B, 2, R, R)."""
    return torch.cat((newest.detach()[:, None], actions[:, :-1]), 1)
