"""Replaced by `skin study study=margins study.run=latest`; the next release removes this file."""

import sys

if __name__ == "__main__":
    sys.exit("experiments/margins.py is now: skin study study=margins study.run=latest")
