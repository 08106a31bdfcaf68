"""Replaced by `skin study study=ensemble`; the next release removes this file."""

import sys

if __name__ == "__main__":
    sys.exit("experiments/ensemble.py is now: skin study study=ensemble")
