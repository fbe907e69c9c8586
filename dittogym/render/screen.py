"""A window on the screen for ``render_mode="human"``; the only place that needs pygame."""

from __future__ import annotations

import numpy as np

try:
    import pygame
except ImportError as error:
    raise ImportError("render_mode='human' needs pygame: pip install 'torchmpm[human]'") from error


class Screen:
    """A window that shows at most ``fps`` pictures per second."""

    def __init__(self, title: str, fps: int) -> None:
        pygame.display.init()
        self._title, self._fps = title, fps
        self._clock = pygame.time.Clock()
        self._surface: pygame.Surface | None = None

    def show(self, picture: np.ndarray) -> None:
        """Show an RGB picture (H, W, 3) uint8."""
        if self._surface is None:
            self._surface = pygame.display.set_mode(picture.shape[1::-1])
            pygame.display.set_caption(self._title)
        pygame.surfarray.blit_array(self._surface, picture.transpose(1, 0, 2))
        pygame.event.pump()
        pygame.display.flip()
        self._clock.tick(self._fps)

    def close(self) -> None:
        """Close the window."""
        pygame.display.quit()
