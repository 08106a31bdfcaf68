"""Encoders of frames: each module is one choice of ``model=``."""
