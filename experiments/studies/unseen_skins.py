"""Accuracy of a run on drawn skins that it was not trained on, skin by skin."""

import math

import numpy as np

from experiments.studies.subject import Measurement, Subject
from experiments.studies.tables import Page
from skin.device.simulated import Simulated
from skin.device.skins import Skins
from skin.errors import InputError
from skin.evaluation.metrics import compute_metrics
from skin.rng import Stream

_OVERALL = "overall/accuracy"
_FIGURES = (
    _OVERALL,
    "big/accuracy",
    "dynamic/accuracy",
    "press/accuracy",
    "dangerous/accuracy",
    "dangerous/alarm_recall",
    "dangerous/false_alarm_rate",
)


def measure_unseen_skins(subject: Subject, gestures: int) -> Measurement:
    """Return the median and the worst accuracy over the test skins of ``device=skins``, and a table of all.

    Raises:
        InputError: a run of another device.
    """
    if not isinstance(subject.device, Skins):
        raise InputError("this study needs a run that was trained with device=skins, such as any_skin")
    lines = []
    for number, skin in enumerate(subject.device.unseen_skins):
        touches = skin.draw(Stream.SKIN, gestures, number)
        found = compute_metrics(
            subject.learner.probabilities(touches), touches.known_labels, skin.task, subject.point()
        )
        lines.append(_described(skin) | {name: 100 * found[name] for name in _FIGURES})
    lines.sort(key=lambda line: float(line[_OVERALL]))
    overall = np.array([float(line[_OVERALL]) for line in lines]) / 100
    table = [[*lines[0]], *([_text(value) for value in line.values()] for line in lines)]
    text = (
        f"{len(lines)} skins with {gestures} touches each: median {100 * np.median(overall):.1f} %, worst "
        f"{100 * overall.min():.1f} %, best {100 * overall.max():.1f} %."
    )
    found = {"same/median": float(np.median(overall)), "same/worst": float(overall.min())}
    return Measurement(
        found, Page(text, {"Skins": table}, [[*lines[0]], *([*line.values()] for line in lines)])
    )


def _described(skin: Simulated) -> dict[str, str | float]:
    """Return what tells a skin from others; lengths in mm, areas in cm2."""
    body, count = skin.body, len(skin.sensors)
    area = math.prod(body.size)
    return {
        "body": type(body).__name__.lower(),
        "layout": type(skin.layout).__name__.strip("_").lower(),
        "sensors": count,
        "width_mm": 1e3 * body.size[0],
        "height_mm": 1e3 * body.size[1],
        "cm2_per_sensor": 1e4 * area / count,
        "upper_layer_mm": 1e3 * body.layers[-1].thickness,
        "depth_mm": 1e3 * float(skin.sensors.positions[:, 2].mean()),
        "position_error_mm": 1e3 * skin.position_error,
    }


def _text(value: str | float) -> str:
    return value if isinstance(value, str) else f"{value:.4g}"
