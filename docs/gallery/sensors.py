"""
Accuracy against the number of sensors
======================================

Overall accuracy on 4000 test touches of the default sheet, on regular grids and on layouts that
``skin design`` placed. ``any_skin`` is one network, not trained for any of these layouts
(:doc:`/pretrained`). The boosted trees (``features``) were trained for each layout, on 3230 gestures.
"""

from csv import DictReader

import matplotlib.pyplot as plt
import numpy as np

from skin.core.files import ROOT


def accuracies(study: str, column: str, name: str) -> dict[int, float]:
    """Return number of sensors -> overall accuracy in per cent, the mean over seeds."""
    found: dict[int, list[float]] = {}
    with (ROOT / "docs" / "results" / f"study_{study}.csv").open() as lines:
        for line in DictReader(lines):
            layout, _, number = line[column].rpartition(" ")
            if layout == name and line.get("condition") != "all draws":
                found.setdefault(int(number), []).append(100 * float(line["same/overall/accuracy"]))
    return {number: float(np.mean(each)) for number, each in sorted(found.items())}


# %%
# The commands that measured these values are in :doc:`/reproduce`. Two standard errors over the touches are
# 0.2 to 0.4 points.

models = {
    "any_skin, not trained for the layout": ("any_skin", "condition", "{}", "o"),
    "trees (features)": ("sensors", "variant", "{}", "^"),
}
figure, axes = plt.subplots(figsize=(8, 5), layout="constrained")
for color, (model, (study, column, name, marker)) in enumerate(models.items()):
    for layout, style in (("grid", "-"), ("placed", "--")):
        measured = accuracies(study, column, name.format(layout))
        axes.plot(
            measured.keys(),
            measured.values(),
            style,
            marker=marker,
            color=f"C{color}",
            label=f"{model}, {layout}",
        )
axes.set_xscale("log", base=2)
axes.set_xticks([4, 9, 16, 25, 36, 49, 64], labels=["4", "9", "16", "25", "36", "49", "64"])
axes.set(xlabel="number of sensors", ylabel="overall accuracy, %")
axes.grid(alpha=0.3)
axes.legend(fontsize="small")
