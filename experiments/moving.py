"""Replaced by `skin study`; the next release removes this file."""

import sys

if __name__ == "__main__":
    sys.exit("experiments/moving.py is now: skin study study=robustness study.part=misplaced")
