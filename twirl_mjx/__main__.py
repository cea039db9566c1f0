"""Run the command line with ``python -m twirl_mjx``."""

from twirl_mjx.cli import main

if __name__ == "__main__":
    main()
