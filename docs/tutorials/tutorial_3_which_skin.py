"""
Which skin should I build?
==========================

``skin design`` computes how well the posterior locates a touch and estimates its force, before anything is
built or trained. This tutorial calls it from Python for four skins (:doc:`/design`).
"""

from pathlib import Path
from tempfile import mkdtemp

import skin
from skin.design.drawing import draw_expected
from skin.design.expected import ExpectedPosterior

# %%
# Thickness and number of sensors
# -------------------------------
# The touches have a force of about 5 N. A touch is blind if it raises no sensor above three standard
# deviations of the noise. The error of a position is that of the posterior mean along one axis.


def build(thickness: float, count: int) -> tuple[skin.Sheet, skin.Solid]:
    """Return a square skin of one layer, with count x count sensors above its base."""
    layers = [
        {"material": {"name": "EcoFlex 00-30", "young": 170e3, "poisson": 0.49}, "thickness": thickness}
    ]
    body = skin.Sheet(size=(0.12, 0.12), cells=(18, 18), layers=layers)
    sensors = skin.Grid(rows=count, columns=count, depth=thickness - 5e-4).sensors(body)
    return body, skin.Solid(body, sensors)


design = ExpectedPosterior(forces=(5.0,), touches=128, margin=0.02)
print("thickness, mm  sensors  blind, %  place, rms, mm")
for count in (3, 5):
    for thickness in (0.010, 0.025):
        body, simulator = build(thickness, count)
        (found,) = design.find(simulator, body)
        numbers = f"{100 * found.blind_share:8.0f}  {1e3 * found.place_m:14.1f}"
        print(f"{1e3 * thickness:13g}  {count**2:7}  {numbers}")

# %%
# More sensors help, and so does a thicker layer where the sensors are far apart: it spreads a touch over
# several of them.
#
# Where on the skin
# -----------------
# The map shows the expected error for a touch on each cell of the last skin. ``skin design design=place``
# chooses positions (:doc:`/design`).

sensors = skin.Grid(rows=5, columns=5, depth=0.0245).sensors(body)
(trials,) = design.trials(simulator, body).values()
maps = {5.0: design.expected_map(trials, body)}
figure = draw_expected(body, sensors, maps, Path(mkdtemp()) / "design.png")
