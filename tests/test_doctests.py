"""The examples in the docstrings of the public names run."""

import doctest
import inspect
from unittest import mock

import gymnasium
import pytest

import baselines
import cfp
import dittogym
import torchmpm

PACKAGES = (torchmpm, dittogym, cfp, baselines)
FINDER = doctest.DocTestFinder(exclude_empty=True)
EXAMPLES = [
    test
    for package in PACKAGES
    for name in package.__all__
    if callable(item := getattr(package, name)) or inspect.ismodule(item)
    for test in FINDER.find(item, f"{package.__name__}.{name}", module=inspect.getmodule(item), globs={})
    if test.examples
]


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: example.name)
def test_example(example: doctest.DocTest) -> None:
    report: list[str] = []
    with mock.patch.dict(dittogym.TASKS), mock.patch.dict(gymnasium.registry):  # one example registers a task
        failed, attempted = doctest.DocTestRunner().run(example, out=report.append, clear_globs=False)
    assert attempted > 0
    assert failed == 0, "".join(report)


def test_main_classes_have_examples() -> None:
    found = {example.name for example in EXAMPLES}
    assert found >= {"torchmpm.Solver", "dittogym.TorchEnv", "cfp.load", "baselines.GradientPlanner"}
