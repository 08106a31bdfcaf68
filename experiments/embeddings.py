"""Replaced by `skin study study=embeddings`; the next release removes this file."""

import sys

if __name__ == "__main__":
    sys.exit("experiments/embeddings.py is now: skin study study=embeddings")
