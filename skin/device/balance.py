"""Class balance of a data set: shape, area, force and position per class, and leakage of labels by shape."""

import logging
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from skin.body.base import AbstractBody
from skin.device.base import AbstractDevice
from skin.device.touches import Recording, only_touches
from skin.touch.labels import ALARM
from skin.touch.sampler import AbstractSampler

if TYPE_CHECKING:
    import pandas as pd

_log = logging.getLogger(__name__)


def report_balance(device: AbstractDevice, recording: Recording | None = None, shown: bool = True) -> None:
    """Log the class balance of the gestures that a simulated device is trained on, and check its labels.

    Args:
        device: the device; nothing is done unless it is simulated.
        recording: its gestures; None: its training budget.
        shown: whether to log the balance.
    """
    if device.simulation is None:
        return
    sampler = device.simulation.sampler
    recording = only_touches(recording or device.recording(None, complete=False))
    balance = class_balance(recording, sampler)
    if shown:
        _log.info(balance_text(balance))
    check_label_leakage(balance, sampler.leak)


def class_balance(recording: Recording, sampler: AbstractSampler) -> "pd.DataFrame":
    """Return a table with two rows per label, the class and its opposite, without those that do not occur.

    Args:
        recording: simulated touches.
        sampler: that drew them; the parameter ``shape`` is an index into its shapes.

    Returns:
        accuracy of the label from the shape alone and its standard error (:func:`accuracy_from_shape`); the
        fraction of each shape, %; means of area, %, and of the first position, mm; the median force, N; and
        the fractions of paths with other labels and of bodies that do not fit, of all that were drawn, %.
    """
    import pandas as pd  # not needed by skin live

    touches = pd.DataFrame({name: values.double().numpy() for name, values in recording.parameters.items()})
    shapes, rows = [Path(name).stem for name in sampler.shapes.names], dict[str, dict[str, float]]()
    labels = recording.touches.known_labels.numpy() > 0.5
    for name, holds in zip(recording.task.names, labels.T, strict=True):
        if name not in sampler.labels:
            continue
        scores = accuracy_from_shape(touches["shape"].to_numpy(int), holds)
        for title, part in ((name, touches[holds]), (sampler.labels[name].opposite, touches[~holds])):
            if count := len(part):
                rows[title] = dict(zip(("accuracy", "error"), scores, strict=True)) if title == name else {}
                rows[title] |= {shape: 100 * (part["shape"] == n).mean() for n, shape in enumerate(shapes)}
                rows[title] |= {"area %": 100 * part["area"].mean(), "force N": part["force"].median()}
                rows[title] |= {"x mm": 1e3 * part["x"].mean(), "y mm": 1e3 * part["y"].mean()}
                rows[title]["paths"] = 100 * (1 - count / part["draws"].sum())
                rows[title]["bodies"] = 100 * (1 - count / (count + part["misfits"].sum()))
    return pd.DataFrame.from_dict(rows, orient="index")


def accuracy_from_shape(shape: np.ndarray, holds: np.ndarray) -> tuple[float, float]:
    """Return the balanced accuracy of predicting a label from the shape, and its standard error.

    The prediction is leave-one-out: each touch is assigned to the class in which its shape is more frequent
    among all other touches. The accuracy is 0.5 if a class has fewer than two touches.

    Args:
        shape: (B,), whole numbers from 0.
        holds: (B,), bool; the label.
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


def balance_text(balance: "pd.DataFrame") -> str:
    """Return a class balance as lines."""
    formats = dict.fromkeys(("accuracy", "error"), "{:.2f}".format)
    table = balance.to_string(formatters=formats, float_format="{:.0f}".format, na_rep="", line_width=None)
    return (
        "balance: shapes are in % of a class, paths and bodies in % rejected; accuracy: balanced accuracy of "
        f"the label from the shape alone\n{table}"
    )


def check_label_leakage(balance: "pd.DataFrame", leak: float) -> None:
    """Warn if the shape alone predicts a label.

    A label leaks if its balanced accuracy is above ``leak`` by more than two standard errors; the margin
    keeps small data sets from warnings by chance.
    """
    scores = balance["accuracy"][balance["accuracy"] - 2 * balance["error"] > leak]
    if len(scores):
        named = " and ".join(f"{name} ({score:.0%})" for name, score in scores.items())
        warnings.warn(
            f"the shape alone predicts {named} of these gestures, more than touch.leak={leak:g} allows: a "
            "model may learn the shape instead of the label; give touch.shapes of one kind, raise "
            "touch.stretch, or give touch.leak=0.5, which fits every shape to the sheet",
            RuntimeWarning,
            stacklevel=3,
        )


# Summary of a data set in one line: forces, strains, clipped readings, accepted draws.


def summarise(recording: Recording, body: AbstractBody) -> dict[str, Any]:
    """Return what a simulated data set is like, as fractions of 1 and SI units.

    The strain is the largest of the top layer by the linear solution or, where a recording has none, its
    highest pressure by its modulus. Linear theory is good to about 0.3; beyond 1 a linear layer would be
    squeezed to nothing. The report's thresholds are kept all the same.

    Returns:
        gestures; acceptance (fraction of draws kept); force (N: quantiles .05, .5, .95 and the largest);
        strain_over_30_percent and strain_over_100_percent; strain_solved (else pressure by modulus);
        clipped and clipped_dangerous (gestures in which a sensor passes the clip, of all and of the dangerous
        ones); unconverged (frames whose pressure was not found, so that their gestures were drawn again),
        where it had to be.
    """
    parameters, labels = recording.parameters, recording.touches.labels
    assert labels is not None
    strain = parameters.get("strain", parameters["peak"] / body.layers[-1].material.young)
    force = torch.quantile(parameters["force"], torch.tensor([0.05, 0.5, 0.95, 1.0]))
    dangerous = labels[:, recording.task.names.index(ALARM)] > 0.5
    summary = {
        "gestures": len(recording),
        "acceptance": len(recording) / float(parameters["draws"].sum()),
        "force": dict(zip(("q05", "q50", "q95", "largest"), force.tolist(), strict=True)),
        "strain_over_30_percent": float((strain > 0.3).float().mean()),
        "strain_over_100_percent": float((strain > 1).float().mean()),
        "strain_solved": "strain" in parameters,
        "clipped": float(parameters["clipped"].mean()),
        "clipped_dangerous": float(parameters["clipped"][dangerous].mean()) if dangerous.any() else 0.0,
    }
    if "unconverged" in parameters:
        summary["unconverged"] = int(parameters["unconverged"].sum())
    return summary


def summary_line(summary: dict[str, Any]) -> str:
    """Return a summary in one line."""
    force = summary["force"]
    strain = "strain" if summary.get("strain_solved") else "pressure by modulus"
    solved = f"; {summary['unconverged']} frames not solved" if "unconverged" in summary else ""
    return (
        f"{summary['gestures']} gestures, {summary['acceptance']:.0%} of draws kept; force median "
        f"{force['q50']:.0f} N (5 to 95 %: {force['q05']:.0f} to {force['q95']:.0f} N, largest "
        f"{force['largest']:.0f} N); {strain} over 30 % in {summary['strain_over_30_percent']:.0%}, "
        f"over 100 % in {summary['strain_over_100_percent']:.0%}; clipped {summary['clipped']:.0%} "
        f"({summary['clipped_dangerous']:.0%} of dangerous){solved}"
    )
