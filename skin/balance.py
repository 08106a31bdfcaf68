"""Class balance of a data set: shape, area, force and position per class; what shape tells of the labels."""

import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from skin.device.base import AbstractDevice
from skin.errors import InputError
from skin.labels import OPPOSITE
from skin.recording import Recording
from skin.touch.gesture import GestureSettings
from skin.touch.stream import only_touches


def announce(device: AbstractDevice, recording: Recording | None = None, shown: bool = True) -> None:
    """Print the balance of the gestures that a simulated device is trained on, and check it.

    Args:
        device: one that is not simulated has no balance.
        recording: its gestures; None: its budget, which is drawn if it was not before.
        shown: whether to print the balance.

    Raises:
        InputError: as :func:`check`.
    """
    if device.simulation is None:
        return
    sampler = device.simulation.sampler
    found = balance(recording or device.recording(None, complete=False), sampler.shapes.names)
    if shown:
        print(*lines(found), sep="\n", file=sys.stderr)
    check(found, sampler.settings)


def balance(recording: Recording, shapes: tuple[str, ...]) -> dict[str, Any]:
    """Return what the gestures of each class are like, in SI units and shares of 1.

    Args:
        recording: simulated touches.
        shapes: the names that the parameter ``shape`` counts.

    Returns:
        shapes, stretched (share of touches that were stretched) and, for each label, told and error (how well
        the shape alone tells it, :func:`told_by`), and for its classes yes and no: touches, shapes (share of
        each), area, force (N), x and y (m; mean and standard deviation of where touches begin), rejected
        (share of drawn paths with other labels) and misfits (share of drawn bodies without room).
    """
    recording = only_touches(recording)
    known = {name: values.double().numpy() for name, values in recording.parameters.items()}
    labels = recording.touches.labels
    assert labels is not None
    report: dict[str, Any] = {
        "shapes": list(shapes),
        "stretched": float((known["stretch"] != 1).mean()),
        "labels": {},
    }
    shape = known["shape"].astype(int)
    for column, name in enumerate(recording.task.names):
        if name in OPPOSITE:
            holds = labels[:, column].numpy() > 0.5
            told, error = told_by(shape, holds)
            classes = {"yes": _class(known, holds, len(shapes)), "no": _class(known, ~holds, len(shapes))}
            report["labels"][name] = {"told": told, "error": error, **classes}
    return report


def _class(known: dict[str, np.ndarray], rows: np.ndarray, shapes: int) -> dict[str, Any]:
    count = int(rows.sum())
    if not count:
        return {"touches": 0}
    own = {name: values[rows] for name, values in known.items()}
    return {
        "touches": count,
        "shapes": (np.bincount(own["shape"].astype(int), minlength=shapes) / count).tolist(),
        "area": float(own["area"].mean()),
        "force": float(np.median(own["force"])),
        "x": [float(own["x"].mean()), float(own["x"].std())],
        "y": [float(own["y"].mean()), float(own["y"].std())],
        "rejected": 1 - count / float(own["draws"].sum()),
        "misfits": 1 - count / (count + float(own["misfits"].sum())),
    }


def told_by(shape: np.ndarray, holds: np.ndarray) -> tuple[float, float]:
    """Return the balanced accuracy with which a shape tells a label, and its standard error.

    Each touch is judged by all others: it is guessed to be of the class that has the larger share of its
    shape. Where there is a class of one touch or none, nothing can be told: 0.5.

    Args:
        shape: (B,), whole numbers from 0.
        holds: (B,), bool.
    """
    counts = np.stack(
        [np.bincount(shape[holds == side], minlength=shape.max() + 1) for side in (False, True)]
    )
    totals = counts.sum(axis=1, keepdims=True)
    if totals.min() < 2:
        return 0.5, 0.0
    rates = []
    for side in (0, 1):
        others = (counts[side] - 1) / (totals[side] - 1)
        against = counts[1 - side] / totals[1 - side]
        right = np.where(np.isclose(others, against), 0.5, others > against)
        rates.append(float((counts[side] * right).sum() / totals[side, 0]))
    error = (
        np.sqrt(sum(rate * (1 - rate) / total for rate, total in zip(rates, totals[:, 0], strict=True))) / 2
    )
    return sum(rates) / 2, float(error)


def lines(report: dict[str, Any]) -> list[str]:
    """Return a balance as a table for a person: two lines for each label."""
    names = [Path(shape).stem for shape in report["shapes"]]
    table = [["", "told", *names, "area %", "force N", "x mm", "y mm", "paths", "bodies"]]
    for name, of in report["labels"].items():
        for title, told, side in ((name, f"{of['told']:.2f}", "yes"), (OPPOSITE[name], "", "no")):
            if of[side]["touches"]:
                table.append([title, told, *_cells(of[side])])
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    rows = ["  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in table]
    return [
        f"balance: {report['stretched']:.0%} of touches were stretched to fit. Shapes are in % of a class, "
        "paths and bodies in % rejected; told: accuracy of the label from the shape alone",
        *rows,
    ]


def _cells(side: dict[str, Any]) -> list[str]:
    shares = [f"{100 * share:.0f}" for share in (*side["shapes"], side["area"])]
    places = [f"{1e3 * side[axis][0]:.0f}±{1e3 * side[axis][1]:.0f}" for axis in "xy"]
    lost = [f"{100 * side[kind]:.0f}" for kind in ("rejected", "misfits")]
    return [*shares, f"{side['force']:.0f}", *places, *lost]


def check(report: dict[str, Any], settings: GestureSettings) -> None:
    """Warn where the shape alone tells a label, or refuse it where the settings are strict.

    A label is told where its balanced accuracy is above ``settings.leak`` by more than two standard errors,
    so that a small data set is not blamed for its chance.

    Raises:
        InputError: it is, and ``settings.strict``.
    """
    told = {
        name: of["told"]
        for name, of in report["labels"].items()
        if of["told"] - 2 * of["error"] > settings.leak
    }
    if not told:
        return
    named = " and ".join(f"{name} ({score:.0%})" for name, score in told.items())
    sentence = (
        f"the shape alone tells {named} of these gestures, more than touch.leak={settings.leak:g} "
        "allows: a model may learn the shape for the label; give touch.shapes of one kind, raise "
        "touch.stretch, or give touch.leak=0.5, which fits every shape to the sheet"
    )
    if settings.strict:
        raise InputError(sentence + "; touch.strict=false only warns")
    warnings.warn(sentence, RuntimeWarning, stacklevel=3)
