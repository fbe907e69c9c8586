"""The active stress of muscles."""

import torch
from scenes import normal

from torchmpm.substep import muscle_stress


def test_stress_is_the_actuation_between_two_deformations() -> None:
    F, ax, ay = normal(2, 9, 2, 2, seed=1), normal(2, 9, seed=2), normal(2, 9, seed=3)
    planes = tuple(F.flatten(-2).unbind(-1))
    expected = F @ torch.diag_embed(torch.stack((ax, ay), -1)) @ F.mT
    xx, xy, yy = muscle_stress(planes, (ax, ay))
    torch.testing.assert_close(torch.stack((xx, xy, xy, yy), -1).unflatten(-1, (2, 2)), expected)
