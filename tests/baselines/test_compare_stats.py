"""Statistics of a comparison against values worked out by hand."""

import numpy as np
import pytest

from baselines.compare import paper
from baselines.compare.stats import align_curves, bootstrap_interval, first_step_at, interquartile_mean, score_interval


def test_interquartile_mean_cuts_whole_runs():
    assert interquartile_mean([1.0, 5.0, 100.0]) == pytest.approx(106 / 3)  # a quarter of 3 is less than one
    assert interquartile_mean([100.0, 1.0, 2.0, -50.0]) == 1.5
    assert interquartile_mean(np.array([[0.0, 10.0], [2.0, 12.0]])).tolist() == [1, 11]


def test_bootstrap_of_two_runs_spans_their_range():
    # Means of two draws: 0, 1, 2 with probabilities 1/4, 1/2, 1/4.
    assert score_interval([[0.0, 2.0]]) == (0.0, 2.0)
    assert score_interval([[]]) == score_interval([[3.0]]) == score_interval([[3.0], [5.0]]) == (None, None)


def test_bootstrap_resamples_within_strata():
    # The second task has one run, so it is in every resample: (0 or 1 or 2 halves + 10) / 3. Unstratified, resamples
    # of three tens would occur: (1/3)^3 = 3.7 %, beyond the upper 2.5 %.
    assert score_interval([[0.0, 2.0], [10.0]]) == pytest.approx((10 / 3, 14 / 3))
    # Two tasks of two runs each: (0, 1 or 2) + (10, 11 or 12), and the mean of the middle two of four.
    assert score_interval([[0.0, 2.0], [10.0, 12.0]]) == pytest.approx((5.0, 7.0))


def test_bootstrap_resamples_whole_curves():
    low, high = bootstrap_interval([np.array([[0.0, 10.0], [2.0, 12.0]])], resamples=500)
    assert low == pytest.approx([0, 10]) and high == pytest.approx([2, 12])


def test_first_step_at_a_value():
    curve = np.array([10.0, 20.0, 30.0]), np.array([1.0, 5.0, 4.0])
    assert [first_step_at(curve, value) for value in (1.0, 4.0, 6.0)] == [10, 20, None]


def test_curves_are_aligned_where_all_have_values():
    one = np.array([0.0, 10.0, 20.0]), np.array([0.0, 10.0, 20.0])
    two = np.array([5.0, 15.0]), np.array([1.0, 3.0])
    steps, values = align_curves([one, two])
    assert steps.tolist() == [5, 10, 15]
    assert values.tolist() == [[5, 10, 15], [1, 2, 3]]
    apart = np.array([30.0]), np.array([1.0])
    assert align_curves([one, apart])[1].shape == (2, 0)


def test_numbers_of_the_paper_are_complete():
    assert set(paper.CURVES) == set(paper.EXPERTS) == set(paper.DROPOUT_RATIOS) == set(paper.REST)
    assert all(len(values) == len(paper.COLUMNS) for values in paper.CURVES.values())
    assert paper.curve("transformer-64", "catch") == (7200, 1260)
    assert paper.curve("fine", "dig") == (570, 40)
    assert paper.curve("shac", "run") is paper.curve("cfp", "own task") is None
    assert paper.normalised("run", 2500) == 0 and paper.normalised("run", 8650) == 1
    assert paper.WITHOUT_NOISE == ("shapematch",) and paper.STEPS["slot"] == 600_000
