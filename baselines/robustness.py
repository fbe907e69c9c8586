"""``python -m baselines.robustness RUN_FOLDER``: `cfp.robustness` for a policy of any algorithm."""

import sys
from functools import partial

from baselines.train import PROGRAM
from cfp import robustness

main = partial(robustness.main, program=PROGRAM)

if __name__ == "__main__":
    sys.exit(main())
