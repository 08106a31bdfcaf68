"""
Expected error of the position
==============================

How well the posterior locates fingertips of about 5 N, against the thickness of the skin, for regular grids
of sensors (:doc:`/design`).
"""

from collections import defaultdict
from csv import DictReader
from dataclasses import fields
from pathlib import Path
from tempfile import mkdtemp

from skin.core.files import ROOT
from skin.design.drawing import draw_sweep
from skin.design.expected import Findings, Step

# %%
# ``skin design design=sweep simulator=solid simulator.divisions=6`` computed the numbers.

found = defaultdict(list)
with (ROOT / "docs" / "results" / "design" / "design_sweep.csv").open() as lines:
    for line in DictReader(lines):
        step = float(line["thickness_m"]), int(line["rows"]), int(line["columns"]), float(line["pitch_m"])
        found[step].append(Findings(**{one.name: float(line[one.name]) for one in fields(Findings)}))
steps = [
    Step(thickness, (rows, columns), pitch, each) for (thickness, rows, columns, pitch), each in found.items()
]
figure = draw_sweep(steps, Path(mkdtemp()) / "design_sweep.png")
