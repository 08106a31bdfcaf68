"""Replaced by `skin validate`; the next release removes this file."""

import sys

if __name__ == "__main__":
    sys.exit("experiments/verify_physics.py is now: skin validate")
