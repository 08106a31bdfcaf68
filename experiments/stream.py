"""Replaced by `skin study study=streams study.run=latest`; the next release removes this file."""

import sys

if __name__ == "__main__":
    sys.exit("experiments/stream.py is now: skin study study=streams study.run=latest")
