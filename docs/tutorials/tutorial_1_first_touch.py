"""
From the first touch to a verdict
=================================

This tutorial presses a simulated skin, trains a small classifier and asks it what a touch was.
"""

from contextlib import chdir
from tempfile import mkdtemp

import matplotlib.pyplot as plt
import torch

import skin
from skin.__main__ import main

folder = mkdtemp()  # commands store runs in the current folder, which is this one below

# %%
# A skin and a touch
# ------------------
# A skin is a body with sensors. This one is a sheet of silicone of 160 x 120 mm, 12 mm thick, with 20
# sensors 6 mm below its surface. The simulator is a PyTorch module from pressures to readings.

layers = [{"material": "EcoFlex 00-30", "thickness": 0.012}]  # m
body = skin.Sheet(size=(0.16, 0.12), cells=(16, 12), layers=layers)
sensors = skin.Grid(rows=4, columns=5, depth=0.006).sensors(body)
simulator = skin.Solid(body, sensors)

pressure = torch.zeros(body.shape)  # Pa on each cell, rows along x
pressure[4:7, 3:6] = 20e3
readings = simulator(pressure).readings  # N, one per sensor
print(f"{len(readings)} readings, the largest {readings.max():.2f} N")

# %%
# The sensors around the touch respond; those far from it do not.

figure, axis = plt.subplots(figsize=(6, 4), layout="constrained")
shown = axis.imshow(pressure / 1e3, cmap="Greys", extent=(0, 160, 120, 0))
figure.colorbar(shown, label="pressure, kPa")
for (x, y), value in zip(1e3 * sensors.positions[:, :2], readings, strict=True):
    axis.annotate(f"{value:.2f}", (x, y), ha="center", va="center", bbox={"boxstyle": "round", "fc": "white"})
axis.set(title="pressure, and readings in N at the sensors", xlabel="x, mm", ylabel="y, mm")

# %%
# Train a classifier
# ------------------
# ``skin train`` draws touches on the default skin, trains a model, evaluates it and stores the run. In a
# shell this line is ``skin train experiment=features simulator=naive ...``. ``features`` are boosted trees
# on engineered features; ``simulator=naive`` needs no mechanics. The numbers of touches are far below the
# defaults.

with chdir(folder):
    main(
        [
            "train",
            "experiment=features",
            "simulator=naive",
            "data.gestures=400",
            "device.test_gestures=200",
            "evaluation.safe_gestures=2000",
            "evaluation.devices=0",
            "evaluation.layouts=0",
        ]
    )

# %%
# Ask for a verdict
# -----------------
# A trained run predicts the probability of each label for windows of readings, (touches, frames, sensors).
# The alarm is raised above the threshold that the training chose for 2 % false alarms.

with chdir(folder):
    run = skin.load_run("latest")
touches = run.device.touches("test")[:5]
probabilities = run.predict(touches.readings)
alarms = probabilities[:, run.labels.index("dangerous")] > run.threshold
print(*(f"{label:>10}" for label in run.labels), "     alarm", "  truly dangerous")
for row, alarm, truth in zip(probabilities, alarms, touches.labels, strict=True):
    print(
        *(f"{probability:10.2f}" for probability in row),
        f"{'yes' if alarm else 'no':>10}",
        f"{bool(truth[-1])!s:>17}",
    )

# %%
# ``skin live`` shows these predictions for a stream of frames (:doc:`/live`). Train with ``simulator=solid``
# for a real skin.
