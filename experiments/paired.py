"""Replaced by `skin study study=pair`; the next release removes this file."""

import sys

if __name__ == "__main__":
    sys.exit("experiments/paired.py is now: skin study study=pair study.rows=[sequence_image,temporal_image]")
