"""Replaced by `skin study study=NAME`; the next release removes this file."""

import sys

if __name__ == "__main__":
    sys.exit("experiments/study.py is now: skin study study=NAME")
