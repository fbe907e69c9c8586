"""``python -m baselines.evaluate RUN_FOLDER``: evaluate a policy of any algorithm, those of `cfp` included."""

import sys
from functools import partial

from baselines.train import PROGRAM
from cfp import evaluate

main = partial(evaluate.main, program=PROGRAM)

if __name__ == "__main__":
    sys.exit(main())
