"""
Which touches are misclassified
===============================

Figures 7 and 8 of the report: wrong labels by the speed of the slide, and the confusion matrix of dangerous
and safe touches. ``skin study study=table`` draws them from the trainings of the results table. This page
trains one small model instead, so its errors are not those of the table.
"""

from contextlib import chdir
from tempfile import mkdtemp

import numpy as np

import skin
from skin.__main__ import main
from skin.plot import figures

folder = mkdtemp()
with chdir(folder):
    main(
        [
            "train",
            "experiment=features",
            "simulator=naive",
            "data.gestures=400",
            "device.test_gestures=400",
            "evaluation.safe_gestures=2000",
            "evaluation.devices=0",
            "evaluation.layouts=0",
        ]
    )
    run = skin.load_run("latest")
recording = run.device.recording("test", complete=False)
true = recording.touches.labels.numpy() > 0.5
predicted = run.predict(recording.touches.readings) > 0.5

# %%
# Shares of the safe and of the dangerous touches, and their numbers.

column = run.labels.index("dangerous")
pairs = np.stack([true[:, column], predicted[:, column]])
counts = np.array([[np.sum((pairs[0] == row) & (pairs[1] == said)) for said in (0, 1)] for row in (0, 1)])
matrix = figures.confusions({"features": counts}, ("safe", "dangerous"))

# %%
# The label ``big`` by the speed of the slide; the bars are standard errors.

column = run.labels.index("big")
speeds = recording.parameters["speed"].numpy() * run.device.model_rate
edges = np.linspace(0.03, 0.20, 5)  # m/s
fractions = figures.misclassified_fractions(speeds, (true != predicted)[:, column].astype(float), edges)
course = figures.misclassified({"features": fractions}, "big", edges)
