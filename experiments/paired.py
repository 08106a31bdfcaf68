"""Replaced by `skin study study=table`; the next release removes this file."""

import sys

if __name__ == "__main__":
    sys.exit(
        "experiments/paired.py is now: skin study study=table study.rows=[...] study.differences=greater"
    )
