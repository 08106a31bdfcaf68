"""Sensor layouts: each module is one choice of ``layout=``."""
