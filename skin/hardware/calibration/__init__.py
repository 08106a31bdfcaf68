"""Calibration: fit the constants of a simulated device to presses of known force."""
