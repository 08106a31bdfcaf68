"""Fusion of the frames of a window: each module is one choice of ``fusion=``."""
