"""Replaced by `skin study study=robustness study.part=dead`; the next release removes this file."""

import sys

if __name__ == "__main__":
    sys.exit("experiments/dead.py is now: skin study study=robustness study.part=dead")
