"""Replaced by `skin calibrate`; the next release removes this file."""

import sys

from skin.cli import main

if __name__ == "__main__":
    print("experiments/calibrate.py is now: skin calibrate", file=sys.stderr)
    main(["calibrate", *sys.argv[1:]])
