"""Replaced by `skin emulate`; the next release removes this file."""

import sys

from skin.cli import main

if __name__ == "__main__":
    print("experiments/emulate.py is now: skin emulate", file=sys.stderr)
    main(["emulate", *sys.argv[1:]])
