"""The gradient laboratory: against functions whose gradients are known, and as a command."""

import json
import math
import re
from dataclasses import dataclass, fields, replace

import pytest
import torch

import dittogym
from baselines.gradlab import __main__ as command
from baselines.gradlab.measure import Probe, Row, Smoothing, finite_differences, measure
from baselines.gradlab.report import conclude, objections, write
from cfp.errors import ConfigError

GOOD = Row(8, 10.0, 2.0, 1.0, 1e-8, 1e-5, 1.0, 1e-6, 0.1, 30.0, 4.0, 3.0, 0.5, 0)
SHAPE = (4, 2, 3, 3)


def normal(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@dataclass(frozen=True)
class Known(Probe):
    """Rewards ``c_t . a_t + curvature / 2 |a_t|^2`` in place of a simulation."""

    slope: torch.Tensor | None = None
    curvature: float = 0.0

    def to(self, dtype):
        return replace(self, slope=self.slope.to(dtype))

    def returns(self, plans):
        slope = self.slope[: plans.shape[1]]
        earned = slope * plans + 0.5 * self.curvature * plans**2
        return earned.flatten(2).sum(2).cumsum(1).to(slope.dtype)

    def gradients(self, plans):
        return (self.slope[: plans.shape[1]] + self.curvature * plans).to(self.slope.dtype)


def known(slope: torch.Tensor, curvature: float = 0.0) -> Known:
    return Known(None, None, None, 1, print, slope, curvature)


def test_linear_return_gives_known_rows() -> None:
    slope, plan = normal(*SHAPE), torch.zeros(SHAPE, dtype=torch.float64)
    smoothing = Smoothing(normal(8000, *SHAPE, seed=1), 0.1)
    rows, errors = measure(known(slope), plan, (2, 4), (1e-2, 1e-4), normal(3, *SHAPE, seed=2), smoothing)
    assert errors.shape == (2, 2) and errors.max() < 1e-10
    for row, horizon in zip(rows, (2, 4), strict=True):
        part = slope[:horizon]
        count = part.numel()
        assert row.horizon == horizon and row.failed == 0
        assert row.norm == pytest.approx(float(part.norm()))
        assert row.first_norm == pytest.approx(float(slope[0].norm()))
        assert row.cosine == pytest.approx(1.0) and 0 < row.relative_error < 1e-6
        # Of a pair's sample (c . e) e: E |.|^2 = (n + 2) |c|^2, less |c|^2 of the mean; half as many pairs as samples.
        assert row.zeroth_variance == pytest.approx(float((count + 1) * part.square().sum()) / 4000, rel=0.1)
        assert row.first_variance < 1e-9 * row.zeroth_variance
        length = 0.1 * count**0.5
        assert row.promised == pytest.approx(length * row.norm, rel=1e-5)
        assert row.first_gain == pytest.approx(row.promised, rel=1e-4)
        assert 0.9 * row.promised < row.zeroth_gain < row.promised


def test_difference_error_of_a_wrong_gradient() -> None:
    slope, plan = normal(*SHAPE), torch.zeros(SHAPE, dtype=torch.float64)
    directions = normal(500, *SHAPE, seed=3)
    errors = finite_differences(known(slope), plan, [slope, 1.5 * slope], (1e-3,), directions)
    assert errors[0] < 1e-10
    assert float(errors[1]) == pytest.approx(1 / 3, rel=0.1)


def test_samples_that_are_not_finite_are_counted_and_left_out() -> None:
    slope, plan = normal(*SHAPE), torch.zeros(SHAPE, dtype=torch.float64)
    noise = normal(8, *SHAPE, seed=1)
    noise[2] = torch.nan  # also in the second pair
    rows, _ = measure(known(slope), plan, (4,), (1e-3,), normal(1, *SHAPE), Smoothing(noise, 0.1))
    assert rows[0].failed == 1 + 1
    assert rows[0].first_gain == pytest.approx(rows[0].promised, rel=1e-4)
    assert rows[0].zeroth_variance > 0
    assert "2 samples are not finite" in objections(rows[0])


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"difference_error": 0.2}, "finite differences differ by 20%"),
        ({"difference_error": torch.nan}, "finite differences differ"),
        ({"cosine": 0.5}, r"float32 and float64 differ \(cosine 0.500\)"),
        ({"first_variance": 31.0}, "scatters more"),
        ({"first_gain": -1.0, "zeroth_gain": -2.0}, "a step along it gains -1"),
        ({"zeroth_gain": 3.5}, r"gains more \(3.5 against 3\)"),
        ({"failed": 2}, "2 samples are not finite"),
    ],
)
def test_conclusion_stops_at_the_first_objection(change: dict, reason: str) -> None:
    assert objections(GOOD) == []
    bad = replace(GOOD, horizon=16, **change)
    (objection,) = objections(bad)
    rows = [GOOD, bad, replace(GOOD, horizon=32)]
    reach, sentence = conclude("run", rows)
    assert reach == 8 and f"At 16, {objection}." in sentence
    assert re.search(reason, objection)
    assert conclude("run", [bad])[0] == 0
    assert conclude("run", [GOOD])[0] == 8


def test_report_without_a_finite_sample_is_written(tmp_path) -> None:
    nothing = {field.name: math.nan for field in fields(Row)} | {"horizon": 8, "failed": 32}
    sentence = write(tmp_path, {"task": "run"}, [Row(**nothing)], (1e-2, 1e-4), [[math.nan, math.inf]])
    assert "32 samples are not finite" in sentence
    text = (tmp_path / "report.json").read_text()
    report = json.loads(text, parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))
    assert report["horizons"][0] == dict.fromkeys(nothing) | {"horizon": 8, "failed": 32}
    assert [row["error"] for row in report["differences"]] == [None, None]
    assert (tmp_path / "gradients.png").read_bytes()[:4] == b"\x89PNG"


def test_command_writes_the_same_twice(tmp_path, capsys) -> None:
    for name in ("one", "two"):
        assert command.main(["--quick", "--task", "kick", "--out", str(tmp_path / name)]) == 0
    assert "the gradient helps" in capsys.readouterr().out
    for name in ("horizons.csv", "differences.csv"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()
    report = json.loads((tmp_path / "one" / "report.json").read_text())
    assert [row["horizon"] for row in report["horizons"]] == [1, 2, 4]
    assert all(row["difference_error"] < 1e-6 and row["cosine"] > 0.999 for row in report["horizons"])
    assert (tmp_path / "one" / "gradients.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--task fly", "task must be one of"),
        ("--samples 5", "samples: got 5, allowed an even number"),
        ("--horizons 4 2", r"horizons: got \(4, 2\), allowed are growing"),
        ("--widths 0", "widths: got"),
        ("--sigma 0", "sigma: got 0.0, allowed more than 0"),
        ("--warmup -1", "warmup: got -1, allowed 0 or more"),
        ("--task shapematch --warmup 30", "warmup: got 30, allowed at most 29"),
        ("--device tpu", "device: got 'tpu'"),
    ],
)
def test_command_rejects(arguments: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        command.run(command.parse(["--quick", *arguments.split()]))


def test_folder_is_made_before_the_work(tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(command, "measure", lambda *_: pytest.fail("worked for nothing"))
    (tmp_path / "file").touch()
    assert command.main(["--quick", "--out", str(tmp_path / "file")]) == 2
    assert "file" in capsys.readouterr().err


def test_task_without_a_gradient_is_named(tmp_path, capsys, monkeypatch) -> None:
    spec = dittogym.make_spec("shapematch")
    outcome = lambda moment, _: dittogym.Outcome({"n": moment.now.split.detach()})  # noqa: E731
    counts = replace(spec, name="count", reward_fn=outcome, weights={"n": 1.0})
    monkeypatch.setitem(dittogym.TASKS, "count", lambda: counts)
    assert command.main(["--quick", "--task", "count", "--out", str(tmp_path)]) == 2
    assert "reward of task 'count' has no gradient" in capsys.readouterr().err


def test_horizons_end_with_the_episode(tmp_path) -> None:
    arguments = ["--quick", "--task", "shapematch", "--resolution", "4", "--warmup", "27"]
    command.run(command.parse([*arguments, "--out", str(tmp_path)]))
    report = json.loads((tmp_path / "report.json").read_text())
    assert [row["horizon"] for row in report["horizons"]] == [1, 2]
