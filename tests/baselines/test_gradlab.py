"""The benchmark of gradients at growing horizons: against functions whose gradients are known, and as a script."""

import csv
from dataclasses import dataclass

import pytest
import torch

from baselines import train
from benchmarks.gradlab import COLUMNS, STEP_SIZES, conclude, finite_difference_errors, main, measure, objections

GOOD = dict(zip(COLUMNS, (8, 2.0, 1.0, 1e-8, 1e-5, 1.0, 1e-6, 0.1, 30.0, 4.0, 3.0, 0.5, 0), strict=True))
SHAPE = (4, 2, 3, 3)


def normal(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@dataclass(frozen=True)
class LinearReturn:
    """Rewards ``slope_t . a_t`` in place of a simulation."""

    slope: torch.Tensor

    def to(self, dtype):
        return LinearReturn(self.slope.to(dtype))

    def returns(self, actions):
        slope = self.slope[: actions.shape[1]]
        return (slope * actions).flatten(2).sum(2).cumsum(1).to(slope.dtype)

    def gradients(self, actions):
        return self.slope[: actions.shape[1]].expand_as(actions) + 0.0 * actions.to(self.slope.dtype)


def test_measurements_of_a_linear_return() -> None:
    slope, actions = normal(*SHAPE), torch.zeros(SHAPE, dtype=torch.float64)
    noise = normal(8000, *SHAPE, seed=1)
    results, errors = measure(LinearReturn(slope), actions, (2, 4), normal(3, *SHAPE, seed=2), noise)
    assert errors.shape == (2, len(STEP_SIZES)) and errors[:, 0].max() < 1e-10
    for result, horizon in zip(results, (2, 4), strict=True):
        part = slope[:horizon]
        count = part.numel()
        assert result["horizon"] == horizon and result["failed"] == 0
        assert result["norm"] == pytest.approx(float(part.norm()))
        assert result["first_norm"] == pytest.approx(float(slope[0].norm()))
        assert result["cosine"] == pytest.approx(1.0) and 0 < result["relative_error"] < 1e-6
        # Of a pair's sample (c . e) e: E |.|^2 = (n + 2) |c|^2, less |c|^2 of the mean; half as many pairs as samples.
        assert result["zeroth_variance"] == pytest.approx(float((count + 1) * part.square().sum()) / 4000, rel=0.1)
        assert result["first_variance"] < 1e-9 * result["zeroth_variance"]
        assert result["promised"] == pytest.approx(0.1 * count**0.5 * result["norm"], rel=1e-5)
        assert result["first_gain"] == pytest.approx(result["promised"], rel=1e-4)
        assert 0.9 * result["promised"] < result["zeroth_gain"] < result["promised"]


def test_difference_error_of_a_wrong_gradient() -> None:
    slope, actions = normal(*SHAPE), torch.zeros(SHAPE, dtype=torch.float64)
    errors = finite_difference_errors(LinearReturn(slope), actions, [slope, 1.5 * slope], normal(500, *SHAPE, seed=3))
    assert errors[0, 0] < 1e-10
    assert float(errors[1, 0]) == pytest.approx(1 / 3, rel=0.1)


def test_samples_that_are_not_finite_are_counted_and_left_out() -> None:
    noise = normal(8, *SHAPE, seed=1)
    noise[2] = torch.nan  # also in the second pair
    actions = torch.zeros(SHAPE, dtype=torch.float64)
    (result,), _ = measure(LinearReturn(normal(*SHAPE)), actions, (4,), normal(1, *SHAPE), noise)
    assert result["failed"] == 2 and "2 samples are not finite" in objections(result)
    assert result["first_gain"] == pytest.approx(result["promised"], rel=1e-4)
    assert result["zeroth_variance"] > 0


@pytest.mark.parametrize(
    "change",
    [
        {"difference_error": 0.2},
        {"difference_error": torch.nan},
        {"cosine": 0.5},
        {"first_variance": 31.0},
        {"first_gain": -1.0, "zeroth_gain": -2.0},
        {"zeroth_gain": 3.5},
        {"failed": 2},
    ],
)
def test_conclusion_stops_at_the_first_objection(change: dict) -> None:
    assert objections(GOOD) == []
    bad = GOOD | {"horizon": 16} | change
    (objection,) = objections(bad)
    reach, sentence = conclude("run", [GOOD, bad, GOOD | {"horizon": 32}])
    assert reach == 8 and f"At 16, {objection}." in sentence
    assert conclude("run", [bad])[0] == 0
    assert conclude("run", [GOOD])[0] == 8
    assert "inf times smaller" in conclude("run", [GOOD | {"first_variance": 0.0}])[1]  # a linear return


def test_program_measures_up_to_the_end_of_the_episode(tmp_path, capsys) -> None:
    main(["--quick", "--task", "shapematch", "--resolution", "4", "--warmup", "27", "--out", str(tmp_path)])
    assert "the gradient helps" in capsys.readouterr().out
    with (tmp_path / "horizons.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["horizon"] for row in rows] == ["1", "2"]  # of an episode of 30 steps
    assert all(float(row["difference_error"]) < 1e-6 and float(row["cosine"]) > 0.999 for row in rows)
    assert (tmp_path / "gradients.png").read_bytes()[:4] == b"\x89PNG"


def test_task_without_a_gradient_is_named(tmp_path, capsys, own_task) -> None:
    task = own_task(lambda step: step.now.radius_of_gyration.detach(), action=2e-4, split=1.0)  # costs have a gradient
    options = f"--task {task} --particles 300 --substeps 4 --no-video --out".split()
    for algo in ("gradient --train-particles 300", "mpc"):
        assert train.main(["--algo", *algo.split(), *options, str(tmp_path / algo[:3])]) == 2
        assert "'own' has no gradient" in capsys.readouterr().err
