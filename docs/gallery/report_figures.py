"""
The skin of the report
======================

An overview of one touch, and figures 2, 3, 4, 10 and 11 of the report, drawn from simulated gestures.
"""

from pathlib import Path
from tempfile import mkdtemp

from hydra import compose, initialize_config_dir

from experiments.studies.report_figures import draw_skin
from skin.build import build_device
from skin.paths import CONF

with initialize_config_dir(str(CONF), version_base="1.3"):
    config = compose("train", ["simulator=fem", "device.test_gestures=160"])
device = build_device(config).simulated("the figures of the report are of a simulated skin")

# %%
# In order: the pressure of a hand with the readings of the sensors; the displacement of the surface (figure
# 2) and of the interface below the top layer (figure 3); the frame with the largest readings in each
# representation (figure 4); the same touch on two simulators (figure 10); force and reading of four presses
# (figure 11).

paths = draw_skin(device, Path(mkdtemp()))
