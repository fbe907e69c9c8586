"""The problems with closed forms in benchmarks/verification.py, at sizes that take a moment."""

import csv
from pathlib import Path

import pytest
import scenes

from benchmarks import verification as problems

TABLE = Path(__file__).parents[2] / "docs" / "verification.csv"
both = pytest.mark.usefixtures("backend")


@pytest.mark.parametrize(("solve", "steps"), [(problems.free_fall, (2e-3, 1e-3)), (problems.oscillation, (8e-5, 4e-5))])
def test_first_order_in_the_substep(solve, steps: tuple[float, float]) -> None:
    """Symplectic Euler, where the transfers lose nothing."""
    errors = [solve(dt).error for dt in steps]
    assert errors[-1] < 0.025
    assert problems.orders(steps, errors) == pytest.approx([1.0], abs=0.1)


@both
def test_free_fall() -> None:
    """With the error of symplectic Euler: half a substep's speed for the whole time."""
    assert problems.free_fall(2e-3, scenes.BACKEND).error == pytest.approx(0.01, rel=1e-3)


@both
@pytest.mark.parametrize("stretch", [0.6, 1.6])
def test_stress_of_a_stretched_bar(stretch: float) -> None:
    assert problems.traction(stretch, scenes.BACKEND).error < 1e-9


@both
def test_plastic_flow_keeps_the_area() -> None:
    assert problems.plastic_flow(1.1, scenes.BACKEND).error < 1e-12


def test_a_wave_converges_with_the_grid() -> None:
    """Its shape to second order in the end, its speed to first, as the substep shrinks with the cells."""
    sizes = (64, 128)
    waves = [problems.pulse(cells) for cells in sizes]
    (of_shape,) = problems.orders(sizes, [wave.shape.error for wave in waves])
    (of_speed,) = problems.orders(sizes, [wave.speed.error for wave in waves])
    assert -of_shape > 1.5 and -of_speed == pytest.approx(1.0, abs=0.05)
    assert waves[-1].speed.error < 0.0025 and waves[-1].height.error < 0.02


def test_finer_substeps_on_one_grid_damp_more() -> None:
    """As every substep's transfers cost a little of what the grid resolves poorly."""
    heights = [problems.pulse(32, courant).height.measured for courant in (0.8, 0.4, 0.2)]
    assert 1.0 > heights[0] > heights[1] > heights[2] > 0.6


def test_a_column_settles_under_its_weight() -> None:
    results = [problems.settling(cells) for cells in (8, 16)]
    for (middle, stretch), bound in zip(results, (0.08, 0.04), strict=True):
        assert middle.error < bound and stretch.error < 0.3 * bound
    (order,) = problems.orders((8, 16), [middle.error for middle, _ in results])
    assert -order == pytest.approx(1.0, abs=0.15)


def test_the_table_in_the_documentation_is_of_these_problems() -> None:
    """A few rows of it, solved again."""
    rows = {(row["problem"], row["size"]): row for row in csv.DictReader(TABLE.read_text().splitlines())}
    again = {
        ("free fall (m)", "0.002 s"): problems.free_fall(2e-3),
        ("stress of a bar (Pa)", "1.6 stretch"): problems.traction(1.6),
        ("wave: speed (m/s)", "64 cells"): problems.pulse(64).speed,
        ("column under its weight: middle (m)", "16 cells"): problems.settling(16)[0],
    }
    for key, result in again.items():
        assert float(rows[key]["exact"]) == pytest.approx(result.exact, rel=1e-5)
        assert float(rows[key]["measured"]) == pytest.approx(result.measured, rel=1e-4)
