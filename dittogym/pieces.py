"""How much of a robot is still in one piece."""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from torch import Tensor

from dittogym.geometry import NODES

#: Cells are neighbours in a plane with their eight around them, and not with those of another robot.
_NEIGHBOURS = np.stack((np.zeros((3, 3)), np.ones((3, 3)), np.zeros((3, 3))))


def largest_piece(x: Tensor, origin: Tensor) -> np.ndarray:
    """Return the share of a robot's particles that its largest connected piece holds.

    A piece consists of cells of the grid, 1/128 m wide, that hold particles. Only blocks of 2 x 2 such cells count, so
    that a strand one cell wide connects nothing and belongs to no piece; blocks that touch, even at a corner, are
    connected. With fewer than about 2,000 particles robots have holes, and the share means little.

    Args:
        x: (B, N, 2) positions of the robots' particles in the world, m. Particles outside the window, or whose position
            is not finite, are in no piece.
        origin: (B, 2) lower left corners of the windows, m, as in ``env.env_state.origin``.

    Returns:
        (B,) shares from 0 to 1.
    """
    x_cell, y_cell = ((x - origin[:, None]) * NODES).detach().cpu().numpy().transpose(2, 0, 1)
    robot, particle = np.nonzero((x_cell >= 0) & (x_cell < NODES) & (y_cell >= 0) & (y_cell < NODES))
    cells = robot, *(cell[robot, particle].astype(np.intp) for cell in (x_cell, y_cell))
    full = np.zeros((len(x), NODES, NODES), bool)
    full[cells] = True
    # The same as ndimage.binary_opening, in a tenth of the time.
    corners = full[:, :-1, :-1] & full[:, 1:, :-1] & full[:, :-1, 1:] & full[:, 1:, 1:]  # lower left ones of blocks
    blocks = np.zeros_like(full)
    for i, j in np.ndindex(2, 2):
        blocks[:, i : i + NODES - 1, j : j + NODES - 1] |= corners
    labels, pieces = ndimage.label(blocks, _NEIGHBOURS)
    piece = robot * (pieces + 1) + labels[cells]  # 0 of each robot: what is in no block
    sizes = np.bincount(piece, minlength=len(x) * (pieces + 1)).reshape(len(x), -1)
    return sizes[:, 1:].max(1, initial=0) / x.shape[1]
