"""`python -m lqrsim` is the command `lqrsim`."""

import sys

from lqrsim.cli import main

if __name__ == "__main__":
    sys.exit(main())
