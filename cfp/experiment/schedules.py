"""Schedules of learning rates over a stage of a run."""

#: Fraction of the learning rate that is left at the end of a stage.
FINAL_FRACTION = 0.1


def linear_decay(progress: float, final: float = FINAL_FRACTION) -> float:
    """Factor that falls from 1 to ``final`` along a line as ``progress`` goes from 0 to 1."""
    return 1.0 - (1.0 - final) * progress
