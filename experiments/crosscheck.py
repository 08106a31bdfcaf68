"""Replaced by `skin study study=crosscheck`; the next release removes this file."""

import sys

if __name__ == "__main__":
    sys.exit("experiments/crosscheck.py is now: skin study study=crosscheck")
