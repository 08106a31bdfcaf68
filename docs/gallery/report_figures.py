"""
The skin of the report
======================

An overview of one touch, and figures 2, 3, 4, 10 and 11 of the report, drawn from simulated gestures.
"""

from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import torch
from hydra import compose, initialize_config_dir

from experiments.studies.pages import draw_skin
from skin.core.files import CONF
from skin.learning.representation import Fourier, Image, Interpolation
from skin.plot import figures
from skin.plot.animation import still
from skin.plot.plot3d import Scene, deflection, surface
from skin.runs.build import build_device
from skin.runs.configuration import validate_config

with initialize_config_dir(str(CONF), version_base="1.3"):
    config = validate_config(compose("train", ["simulator=fem", "device.test_gestures=160"]))
device = build_device(config).simulated("the figures of the report are of a simulated skin")
folder, size = Path(mkdtemp()), device.size


def press(labels):
    """Return 64 gestures with given labels, and which of them is a hand's."""
    movie = device.sampler.sample(64, np.random.default_rng(0), np.tile(labels, (64, 1)))
    hand = movie.parameters["shape"] == device.sampler.shapes.names.index("hand")
    return movie, int(hand.int().argmax())


# %%
# The pressure of a sliding hand with the readings of the sensors, and the frame with the largest readings in
# each representation (figure 4).

movie, hand = press([True] * 4)
readings = device.model.respond(movie).readings[hand]
strongest = int(readings.sum(1).argmax())
positions = torch.from_numpy(device.sensors.positions).float()
makers = {"image": Image(positions, size), "fourier": Fourier(positions, size)} | {
    method: Interpolation(positions, size, method=method) for method in ("nearest", "linear", "cubic")
}
frame = readings[None, strongest : strongest + 1]
pictures = {name: make(frame, torch.ones_like(frame) > 0).x[0, 0, 0] for name, make in makers.items()}
layout = device.sensors.positions
positions = np.broadcast_to(layout, (len(readings), *layout.shape))
title, pressure = "a sliding hand", movie.pressure()[hand].numpy()
scene = Scene(readings.numpy(), positions, size, device.model_rate, title, pressure)
still(scene, "flat", folder / "overview.png")
figures.save_figure(figures.images(pictures, layout, size), folder / "figure04_interpolations.png")

# %%
# The displacement of the surface under a resting hand (figure 2) and of the interface below the top layer
# (figure 3).

movie, hand = press([True, False, True, False])
index = movie.index[hand, int(movie.scale[hand].argmax())]
moved = deflection(device.body, movie.frames[index : index + 1])[0]
for level, name in ((-1, "figure02_hand_top"), (-2, "figure03_hand_bottom")):
    depth = device.body.interfaces[level]
    drawn = surface(moved[level], depth, size, f"finite elements, hand, {1e3 * depth:g} mm below the surface")
    figures.save_figure(drawn, folder / f"{name}.png")

# %%
# The same touch on two simulators (figure 10); force and reading of four presses (figure 11).

paths = draw_skin(device, folder)
