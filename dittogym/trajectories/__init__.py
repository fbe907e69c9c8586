"""Episodes as arrays, to learn from: recording them, and files of them."""

from dittogym.trajectories.episode import Episode, record
from dittogym.trajectories.storage import load_episodes, load_minari, save_episodes, save_minari

__all__ = ["Episode", "load_episodes", "load_minari", "record", "save_episodes", "save_minari"]
