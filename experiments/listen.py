"""Replaced by `skin listen`; the next release removes this file."""

import sys

from skin.cli import main

if __name__ == "__main__":
    print("experiments/listen.py is now: skin listen", file=sys.stderr)
    main(["listen", *sys.argv[1:]])
