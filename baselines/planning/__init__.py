"""Receding-horizon planners: by gradients and by the cross-entropy method."""
