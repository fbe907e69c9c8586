"""A window on the screen for ``render_mode="human"``; the only place that needs pygame."""

from __future__ import annotations

import numpy as np

try:
    import pygame
except ImportError as error:
    raise ImportError("render_mode='human' needs pygame: pip install 'torchmpm[human]'") from error


#: Keys that pause and go on, take one step, and close the window.
PAUSE, STEP, QUIT = pygame.K_SPACE, pygame.K_RIGHT, (pygame.K_q, pygame.K_ESCAPE)


class Screen:
    """A window that shows at most ``fps`` pictures per second."""

    def __init__(self, title: str, fps: int) -> None:
        pygame.display.init()
        self._title, self._fps = title, fps
        self._clock = pygame.time.Clock()
        self._surface: pygame.Surface | None = None
        self._paused = False

    def show(self, picture: np.ndarray) -> bool:
        """Show an RGB picture (H, W, 3) uint8, and wait while paused; returns whether the window is to stay open."""
        if self._surface is None:
            self._surface = pygame.display.set_mode(picture.shape[1::-1])
            pygame.display.set_caption(self._title)
        if pygame.display.get_surface() is not self._surface:  # pygame has one window; another environment took it
            return False
        pygame.surfarray.blit_array(self._surface, picture.transpose(1, 0, 2))
        pygame.display.flip()
        self._clock.tick(self._fps)
        while True:
            event = pygame.event.poll()
            key = event.key if event.type == pygame.KEYDOWN else None
            if event.type == pygame.QUIT or key in QUIT:
                return False
            if key == STEP:
                self._paused = True
                return True
            if key == PAUSE:
                self._paused = not self._paused
            if event.type == pygame.NOEVENT:
                if not self._paused:
                    return True
                self._clock.tick(self._fps)

    def close(self) -> None:
        """Close the window, unless it belongs to another environment by now."""
        if pygame.display.get_init() and pygame.display.get_surface() is self._surface:
            pygame.display.quit()
