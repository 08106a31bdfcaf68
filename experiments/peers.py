"""Replaced by `skin peers`; the next release removes this file."""

import sys

if __name__ == "__main__":
    sys.exit("experiments/peers.py is now: skin peers -m row=lightgbm,minirocket,multirocket_hydra")
