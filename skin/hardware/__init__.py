"""Working with a real skin: recording, calibration, the emulator, the live view."""
