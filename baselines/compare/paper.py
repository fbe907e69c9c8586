"""The numbers of the paper (DittoGym, ICLR 2024): Figures 5 to 8, Tables 4 and 5.

Values of figures were measured from the drawn curves: mean and half the width of the band over the last tenth of
the steps, three seeds, training returns. A resting robot was measured in the reference environment with full particles.
"""

from cfp.presets import TASKS
from cfp.sections import Particles

#: Particles of the paper's figures.
PARTICLES: Particles = "full"

#: Names that the paper's methods have here, in the order of ``CURVES``.
COLUMNS = ("cfp", "coarse", "fine", "gnn-16", "gnn-64", "transformer-16", "transformer-64")

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

#: Task to environment steps of its curves.
STEPS = {task: TASKS[task].steps for task in CURVES}

#: Task to action grid to the best return of "expert policies" and its error bar. Grids of SHAPE MATCH are doubtful.
EXPERTS: dict[str, dict[int, tuple[float, float]]] = {
    "shapematch": {4: (255, 6), 8: (297, 7), 16: (317, 5)},
    "run": {4: (4940, 1070), 8: (9210, 890), 16: (9790, 430)},
    "grow": {4: (5810, 780), 8: (5620, 690), 16: (5930, 40)},
    "kick": {4: (3070, 570), 8: (9690, 200), 16: (18800, 820)},
    "dig": {4: (1880, 980), 8: (3970, 480), 16: (4750, 40)},
    "obstacle": {4: (12300, 6300), 8: (11000, 2900), 16: (14600, 490)},
    "catch": {4: (8150, 1150), 8: (11300, 680), 16: (9720, 530)},
    "slot": {4: (15100, 2600), 8: (53800, 8600), 16: (73200, 1500)},
}

#: Seconds of an average training episode in RUN, and memory (MB), on an RTX 4090.
COST: dict[str, tuple[float, float]] = {"cfp": (54, 4053), "transformer-64": (104, 6895), "gnn-64": (83, 4199)}

#: Share of successful episodes in SLOT; of how many is not said.
SUCCESS: dict[str, float] = {"cfp": 0.154, "transformer-64": 0.059, "gnn-64": 0.0}

#: Ratio to the unperturbed return of CFP when 20 % of the observation, of the action are set to zero.
DROPOUT_RATIOS: dict[str, tuple[float, float]] = {
    "shapematch": (0.932, 0.911),
    "run": (0.877, 0.954),
    "grow": (0.891, 0.892),
    "kick": (0.083, 0.985),
    "dig": (0.675, 0.730),
    "obstacle": (0.326, 0.936),
    "catch": (0.915, 0.989),
    "slot": (0.941, 0.970),
}

_REST = (21, 2500, 3100, 890, -1500, 2400, -1900, 7000)
#: Task to the return of a robot that does not move (SHAPE MATCH: 12 to 30, by the particles).
REST: dict[str, float] = dict(zip(CURVES, _REST, strict=True))

#: Tasks in which the paper evaluates policies without action noise; in all others they act with it.
WITHOUT_NOISE = tuple(task for task, numbers in TASKS.items() if numbers.deterministic)


def curve(algo: str, task: str) -> tuple[float, float] | None:
    """The paper's return and band of a method, None where it has none."""
    return CURVES[task][COLUMNS.index(algo)] if task in CURVES and algo in COLUMNS else None


def normalised(task: str, value: float) -> float:
    """A return on a scale where a resting robot has 0 and the paper's CFP 1."""
    return (value - REST[task]) / (CURVES[task][0][0] - REST[task])
