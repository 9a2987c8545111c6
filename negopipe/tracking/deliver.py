"""The old name of the command `python -m negopipe.tracking.sync`."""

import sys

if __name__ == "__main__":
    sys.exit("python -m negopipe.tracking.deliver is now python -m negopipe.tracking.sync")
