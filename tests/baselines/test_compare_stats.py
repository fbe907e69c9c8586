"""Statistics of a comparison against values worked out by hand, and scipy's."""

import numpy as np
import pytest
import scipy.stats

from baselines.compare import paper
from baselines.compare.stats import bootstrap, common_curve, first_reach, interquartile_mean, interval, wilson


def test_interquartile_mean_cuts_whole_runs():
    assert interquartile_mean(np.array([1.0, 5.0, 100.0])) == pytest.approx(106 / 3)  # a quarter of 3 is less than one
    assert interquartile_mean(np.array([100.0, 1.0, 2.0, -50.0])) == 1.5
    scores = np.random.default_rng(0).normal(size=(11, 3))
    assert interquartile_mean(scores) == pytest.approx(scipy.stats.trim_mean(scores, 0.25))


def test_bootstrap_of_two_runs_spans_their_range():
    # Means of two draws: 0, 1, 2 with probabilities 1/4, 1/2, 1/4.
    assert interval([[0.0, 2.0]]) == (0.0, 2.0)
    assert interval([[3.0]]) is None
    assert interval([[3.0], [5.0]]) is None


def test_bootstrap_resamples_within_strata():
    # The second task has one run, so it is in every resample: (0 or 1 or 2 halves + 10) / 3.
    low, high = interval([[0.0, 2.0], [10.0]])
    assert (low, high) == pytest.approx((10 / 3, 14 / 3))
    # Unstratified, resamples of three tens would occur: (1/3)^3 = 3.7 %, beyond the upper 2.5 %.
    assert high < 10


def test_bootstrap_finds_the_interval_of_a_normal_mean():
    scores = np.random.default_rng(1).normal(size=200)
    low, high = bootstrap([scores], lambda drawn: drawn.mean(0))
    half = 1.96 * scores.std() / np.sqrt(200)
    assert (low, high) == pytest.approx((scores.mean() - half, scores.mean() + half), abs=0.01)


def test_bootstrap_draws_curves_as_wholes():
    curves = np.array([[0.0, 10.0], [2.0, 12.0]])
    low, high = bootstrap([curves], repeats=500)
    assert low == pytest.approx([0, 10]) and high == pytest.approx([2, 12])


def test_wilson():
    # Newcombe (1998), Statistics in Medicine 17, Table I, method 3.
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=5e-5)
    assert wilson(20, 20) == pytest.approx((1 - 0.1611, 1.0), abs=5e-5)
    with pytest.raises(ValueError, match="got 3 of 2"):
        wilson(3, 2)


def test_first_reach():
    steps, values = np.array([10.0, 20.0, 30.0]), np.array([1.0, 5.0, 4.0])
    assert first_reach(steps, values, 4.0) == 20
    assert first_reach(steps, values, 1.0) == 10
    assert first_reach(steps, values, 6.0) is None


def test_curves_are_joined_where_all_have_values():
    one = np.array([0.0, 10.0, 20.0]), np.array([0.0, 10.0, 20.0])
    two = np.array([5.0, 15.0]), np.array([1.0, 3.0])
    steps, values = common_curve([one, two])
    assert steps.tolist() == [5, 10, 15]
    assert values.tolist() == [[5, 10, 15], [1, 2, 3]]
    apart = np.array([30.0]), np.array([1.0])
    assert common_curve([one, apart])[1].shape == (2, 0)


def test_paper_s_numbers_are_complete():
    assert set(paper.CURVES) == set(paper.EXPERTS) == set(paper.FAULTS) == set(paper.REST)
    assert all(len(values) == len(paper.COLUMNS) for _, values in paper.CURVES.values())
    assert paper.curve("transformer-64", "catch") == (7200, 1260)
    assert paper.curve("fine", "dig") == (570, 40)
    assert paper.curve("shac", "run") is paper.curve("cfp", "own task") is None
    assert paper.normalised("run", 2500) == 0 and paper.normalised("run", 8650) == 1
