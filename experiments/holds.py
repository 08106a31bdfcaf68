"""Replaced by `skin study study=holds study.run=latest`; the next release removes this file."""

import sys

if __name__ == "__main__":
    sys.exit("experiments/holds.py is now: skin study study=holds study.run=latest")
