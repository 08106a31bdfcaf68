"""Calibration: from presses of known force to the constants of a simulated device."""
