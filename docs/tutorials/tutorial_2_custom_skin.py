"""
Describe a skin of your own
===========================

A skin is described by its layers and by a CSV file with the positions of its sensors. This tutorial builds
one in Python and looks at what its sensors respond to. :doc:`/your-skin` describes the same in YAML, for
the command line.
"""

from pathlib import Path
from tempfile import mkdtemp

import matplotlib.pyplot as plt
import torch

import skin

folder = Path(mkdtemp())

# %%
# Sensors
# -------
# One line per sensor, in the order of the hardware's channels: x to the right and y downwards from the upper
# left corner, and the depth below the surface, in metres.

(folder / "sensors.csv").write_text(
    """x_m,y_m,depth_m
0.020,0.020,0.006
0.060,0.025,0.006
0.100,0.018,0.006
0.040,0.055,0.006
0.085,0.060,0.003
"""
)

# %%
# Layers
# ------
# From the bottom up. A predefined material has a name; any other one has Young's modulus, Pa, and Poisson's
# ratio.

gel = {"name": "my gel", "young": 40e3, "poisson": 0.49}
layers = [{"material": gel, "thickness": 0.008}, {"material": "EcoFlex 00-30", "thickness": 0.004}]
body = skin.Sheet(size=(0.12, 0.08), cells=(24, 16), layers=layers)
sensors = skin.LayoutFile(folder / "sensors.csv", footprint=(0.008, 0.008)).sensors(body)
simulator = skin.Solid(body, sensors)
print(len(sensors), "sensors,", len(body.layers), "layers,", f"{1e3 * body.thickness:g} mm")

# %%
# What each sensor responds to
# ----------------------------
# The readings are linear in the pressure, so the derivative of a reading is its sensitivity to pressure on
# each cell. A shallow sensor responds to a smaller area.

figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained", sharey=True)
for axis, number in zip(axes, (3, 4), strict=True):
    pressure = torch.zeros(body.shape, requires_grad=True)
    simulator(pressure).readings[number].backward()
    x, y, depth = 1e3 * sensors.positions[number]
    shown = axis.imshow(1e3 * pressure.grad, cmap="viridis", extent=(0, 120, 80, 0))
    axis.plot(x, y, "wo", markeredgecolor="black")
    axis.set(title=f"sensor {number}, {depth:g} mm deep", xlabel="x, mm")
    figure.colorbar(shown, ax=axis, label="mN per Pa on a cell", shrink=0.8)
axes[0].set_ylabel("y, mm")

# %%
# Mistakes are refused
# --------------------
# Bad input raises ``skin.InputError``, with one sentence that says what to change. On the command line it
# ends with exit code 2.

try:
    skin.Sheet(size=(0.12, 0.08), cells=(24, 16), layers=[{"material": "EcoFlex 00-35", "thickness": 0.004}])
except skin.InputError as error:
    print(error)
