"""Replaced by `skin compare`; the next release removes this file."""

import sys

from skin.cli import main

if __name__ == "__main__":
    print("experiments/compare.py is now: skin compare", file=sys.stderr)
    main(["compare", *sys.argv[1:]])
