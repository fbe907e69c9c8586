"""Returns of the paper (DittoGym, ICLR 2024).

They were measured from the drawn curves of training returns: mean and half the width of the band over the last tenth of
the steps, three seeds. A resting robot was measured in the reference environment with full particles.
"""

from cfp.presets import PAPER

#: Names that the paper's methods have here, in the order of ``CURVES``.
COLUMNS = ("cfp-sac", "coarse", "fine", "gnn-16", "gnn-64", "transformer-16", "transformer-64")

#: Task to return and band of every method.
CURVES: dict[str, tuple[tuple[float, float], ...]] = {
    "shapematch": ((306, 4), (285, 6), (154, 10), (55, 4), (57, 3), (69, 3), (71, 2)),
    "run": ((8650, 420), (6870, 960), (2750, 630), (2520, 110), (2420, 20), (1820, 2060), (2200, 1480)),
    "grow": ((5530, 130), (4810, 900), (3950, 530), (3480, 410), (4550, 110), (3250, 480), (4310, 690)),
    "kick": ((16200, 1400), (2020, 910), (4600, 1300), (890, 50), (870, 40), (1720, 1070), (1440, 880)),
    "dig": ((4360, 90), (3220, 440), (570, 40), (1740, 750), (1010, 110), (570, 120), (790, 50)),
    "obstacle": ((12300, 1200), (9750, 2600), (4890, 1200), (2080, 180), (2360, 60), (1920, 530), (3300, 1440)),
    "catch": ((6890, 460), (6420, 1790), (1780, 1290), (3610, 460), (5980, 1410), (5530, 1520), (7200, 1260)),
    "slot": ((65000, 2600), (49800, 9300), (12800, 2100), (6480, 2310), (5120, 1610), (26000, 5400), (23300, 6600)),
}

#: Task to what is left of the return of the paper's CFP while a fifth of its actions, or of its images, is set to 0: a
#: quotient, read from the paper's bars.
DROPOUT: dict[str, tuple[float, float]] = {
    "shapematch": (0.91, 0.93),
    "run": (0.95, 0.88),
    "grow": (0.89, 0.89),
    "kick": (0.99, 0.08),
    "dig": (0.73, 0.68),
    "obstacle": (0.94, 0.33),
    "catch": (0.99, 0.92),
    "slot": (0.97, 0.94),
}

_REST = (21, 2500, 3100, 890, -1500, 2400, -1900, 7000)
#: Task to the return of a robot that does not move (SHAPE MATCH: 12 to 30, by the particles).
REST: dict[str, float] = dict(zip(CURVES, _REST, strict=True))

#: Tasks in which the paper evaluates policies without action noise; in all others they act with it.
WITHOUT_NOISE = tuple(task for task, options in PAPER.items() if options.get("eval_deterministic"))


def normalised(task: str, value: float) -> float:
    """A return on a scale where a resting robot has 0 and the paper's CFP 1."""
    return (value - REST[task]) / (CURVES[task][0][0] - REST[task])
