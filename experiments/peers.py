"""Replaced by `make peers`; the next release removes this file."""

import sys

if __name__ == "__main__":
    sys.exit(
        "experiments/peers.py is now: skin train --config-dir experiments/peers/conf -m "
        "experiment=lightgbm,minirocket,multirocket_hydra seed=0,1,2"
    )
