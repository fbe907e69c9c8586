"""``torchmpm play``: the page of :mod:`cfp.play`, with policies of every algorithm."""

from baselines.registry import load
from cfp.play import __main__ as page


def main() -> int:
    """Command line entry; returns the exit code."""
    return page.main(load=load)
