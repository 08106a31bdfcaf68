"""
A real board, or the emulator
=============================

This tutorial reads frames from an emulated skin. A real board is read in the same way: give its port, such
as ``/dev/ttyACM0``, instead of the address of the emulator. :doc:`/hardware` describes formats, wiring and
errors.
"""

import subprocess
import sys

import matplotlib.pyplot as plt
import numpy as np

import skin

# %%
# Start the emulator
# ------------------
# In a terminal of its own this is ``skin emulate port=0``, or ``port=pty`` for a pseudo-terminal. It
# prints its address and the settings that connect to it, then plays simulated touches in real time.

command = [sys.executable, "-m", "skin", "emulate", "port=0", "simulator=naive", "emulate.idle=2.5"]
emulator = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
address = emulator.stdout.readline().strip()
settings = emulator.stdout.readline().split()
scale = float(next(word for word in settings if "scale=" in word).partition("=")[2])  # N per count
print(scale, "N per count")

# %%
# Read it
# -------
# ``open_skin`` detects the format and the number of sensors. Take the tare while nothing touches the skin:
# it is refused otherwise.

with skin.open_skin(address) as opened:
    opened.tare(seconds=1.0)
    frames = opened.read(500, timeout=30)
    stats = opened.stats
emulator.terminate()
emulator.wait(30)
emulator.stdout.close()
readings = scale * (np.array([frame.values for frame in frames]) - opened.baseline)  # N
print(f"{readings.shape[1]} sensors, {stats.format} with {stats.check}")
print(f"{stats.bad_frames} bad frames, {stats.lost} lost")

# %%
# The readings of a few seconds, in newtons; the sensor with the largest reading is bold.

figure, axis = plt.subplots(figsize=(8, 3), layout="constrained")
time = np.array([frame.t for frame in frames]) - frames[0].t
strongest = readings.max(axis=0).argmax()
axis.plot(time, readings, color="0.6", linewidth=0.7)
axis.plot(time, readings[:, strongest], color="black", linewidth=2)
axis.set(xlabel="time, s", ylabel="reading, N", title=f"sensor {strongest} has the largest reading")

# %%
# Predictions on it
# -----------------
# With a trained run, ``skin live`` classifies the stream and serves a page (:doc:`/live`); ``skin record``
# stores gestures with their labels, and ``skin calibrate`` estimates the gains of a real skin
# (:doc:`/calibration`):
#
# .. code-block:: bash
#
#     skin train experiment=features simulator=solid
#     skin emulate link=./skin-port simulator=solid
#     skin live device=serial device.port=./skin-port device.scale=0.0390625 web=true
