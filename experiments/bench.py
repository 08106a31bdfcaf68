"""Replaced by `skin bench`; the next release removes this file."""

import sys

if __name__ == "__main__":
    sys.exit("experiments/bench.py is now: skin bench")
