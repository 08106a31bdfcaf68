"""Replaced by `skin study study=direction`; the next release removes this file."""

import sys

if __name__ == "__main__":
    sys.exit("experiments/direction.py is now: skin study study=direction")
