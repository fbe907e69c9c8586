"""``python -m cfp.train``: train the coarse-to-fine policy, watch it, stop it, resume it."""

import sys

from cfp.experiment.training import main

if __name__ == "__main__":
    sys.exit(main())
