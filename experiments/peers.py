"""Replaced by `make peers`; the next release removes this file."""

import sys

if __name__ == "__main__":
    sys.exit("experiments/peers.py is now: make peers SEEDS=3")
