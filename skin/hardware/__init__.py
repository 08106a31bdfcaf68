"""The real skin and its stand-in: recording, calibration, the emulator, the live view."""
