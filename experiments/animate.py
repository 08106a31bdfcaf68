"""Replaced by `skin animate`; the next release removes this file."""

import sys

from skin.cli import main

if __name__ == "__main__":
    print("experiments/animate.py is now: skin animate", file=sys.stderr)
    main(["animate", *sys.argv[1:]])
