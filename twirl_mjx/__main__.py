"""Run the command line with ``python -m twirl_mjx``."""

import sys

from twirl_mjx.cli import main

if __name__ == "__main__":
    sys.exit(main())
