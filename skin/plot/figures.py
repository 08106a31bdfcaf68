"""Figures 4, 7, 8, 10 and 11 of the report from our own data."""

from collections.abc import Mapping
from itertools import product
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from skin.core.files import whole

COLOURS = (
    *("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000"),
    *("#999999", "#882255", "#332288"),
)
"""Okabe and Ito's palette, which colour-blind readers can distinguish, and three of Tol's, for ten lines."""

MARKS = ("o", "s", "^", "D", "v", "P", "X")
"""Markers of lines, so that they differ without colour; with :data:`COLOURS`, no pair of 70 comes twice."""


def save_figure(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG, whole, and return its path."""
    with whole(path) as partial:
        figure.savefig(partial, dpi=120)
    return path


def images(pictures: Mapping[str, Tensor], points: np.ndarray, size: tuple[float, float]) -> Figure:
    """Draw one frame of readings in several representations side by side (report, figure 4).

    Args:
        pictures: name -> (H, W).
        points: (S, 2), m, of the sensors; drawn on every picture but ``fourier``, which has no positions.
        size: extent (x, y) of the sheet, m.
    """
    figure = Figure(figsize=(2.4 * len(pictures), 2.8), layout="constrained")
    axes = figure.subplots(1, len(pictures), squeeze=False)[0]
    for axis, (name, picture) in zip(axes, pictures.items(), strict=True):
        extent = (0, size[0] * 1e3, size[1] * 1e3, 0)
        if name == "fourier":
            axis.imshow(np.asarray(picture), cmap="magma")
        else:
            axis.imshow(np.asarray(picture), cmap="magma", extent=extent, interpolation="nearest")
            axis.plot(points[:, 0] * 1e3, points[:, 1] * 1e3, ".", color="#56B4E9", markersize=2)
        axis.set(title=name, xticks=[], yticks=[])
    return figure


def confusions(matrices: Mapping[str, np.ndarray], names: tuple[str, str]) -> Figure:
    """Draw 2 x 2 confusion matrices side by side, as fractions of each true class (report, figure 8).

    Args:
        matrices: row -> (2, 2) counts, true class down, predicted class across.
        names: of class 0 and class 1.
    """
    columns = min(4, len(matrices))
    lines = -(-len(matrices) // columns)
    figure = Figure(figsize=(2.6 * columns, 2.7 * lines), layout="constrained")
    axes = figure.subplots(lines, columns, squeeze=False).ravel()
    for axis in axes[len(matrices) :]:
        axis.set_visible(False)
    for axis, (title, counts) in zip(axes, matrices.items(), strict=False):
        fractions = counts / counts.sum(axis=1, keepdims=True).clip(min=1)
        axis.imshow(fractions, cmap="Blues", vmin=0, vmax=1)
        for (true, predicted), count in np.ndenumerate(counts):
            ink = "white" if fractions[true, predicted] > 0.5 else "black"
            axis.text(
                predicted,
                true,
                f"{fractions[true, predicted]:.1%}\n{count:.0f}",
                ha="center",
                va="center",
                color=ink,
            )
        axis.set_xticks([0, 1], names)
        axis.set_yticks([0, 1], names, rotation=90, va="center")
        axis.set(xlabel="predicted", ylabel="true", title=title)
    return figure


def misclassified_fractions(
    speeds: np.ndarray, wrong: np.ndarray, bins: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the fraction of gestures with a wrong label, and its standard error, by the speed of the slide.

    Args:
        speeds: (B,), m/s; 0 for a static touch.
        wrong: (B,), fraction of runs in which the label is wrong.
        bins: (K + 1,), ascending edges, m/s.

    Returns:
        both (K + 1,); the first is for static touches.
    """
    # Static touches go to group 0, a slide in bin k to group k.
    group = np.where(speeds == 0, 0, np.clip(np.digitize(speeds, bins), 1, len(bins) - 1))
    counts = np.maximum(np.bincount(group, minlength=len(bins)), 1)
    fractions = np.bincount(group, weights=wrong, minlength=len(bins)) / counts
    squares = np.bincount(group, weights=(wrong - fractions[group]) ** 2, minlength=len(bins))
    return fractions, np.sqrt(squares) / counts


def misclassified(
    courses: Mapping[str, tuple[np.ndarray, np.ndarray]], label: str, bins: np.ndarray
) -> Figure:
    """Draw the fraction of gestures whose label is wrong against the speed of the slide (report, figure 7).

    Bars are two standard errors.

    Args:
        courses: row -> fractions and standard errors (:func:`misclassified_fractions`).
        label: which label.
        bins: ascending edges, m/s; static touches stand at 0 on their own.
    """
    figure = Figure(figsize=(7, 4), layout="constrained")
    axis = figure.subplots()
    middles = np.concatenate([[0.0], (bins[1:] + bins[:-1]) / 2])
    # Every colour comes with one mark after the other, so that any number of rows can be distinguished.
    styles = product(MARKS, COLOURS)
    for (row, (fractions, errors)), (mark, colour) in zip(courses.items(), styles, strict=False):
        axis.errorbar(
            middles * 1e3,
            fractions,
            2 * errors,
            marker=mark,
            markersize=4,
            capsize=2,
            color=colour,
            label=row,
        )
    axis.set(xlabel="speed, mm/s (0: static)", ylabel=f"fraction with “{label}” wrong")
    axis.set_ylim(bottom=0)
    figure.legend(loc="outside right upper", fontsize=8)
    return figure


def traces(readings: Mapping[str, Tensor], rate: float) -> Figure:
    """Draw the most active sensor over time, one panel per simulator (report, figure 10).

    Args:
        readings: simulator -> (T, S), N, of the same gesture.
        rate: Hz.
    """
    figure = Figure(figsize=(4.2 * len(readings), 3), layout="constrained")
    axes = figure.subplots(1, len(readings), squeeze=False)[0]
    for axis, (name, values) in zip(axes, readings.items(), strict=True):
        sensor = int(values.amax(0).argmax())
        axis.plot(np.arange(len(values)) / rate, values[:, sensor], color=COLOURS[0], marker=".")
        axis.set(title=f"{name}, sensor {sensor}", xlabel="time, s", ylabel="reading, N")
    return figure


def force_and_reading(force: Tensor, readings: Tensor, rate: float) -> Figure:
    """Draw total applied force and the most active sensor's reading over time (report, figure 11).

    Args:
        force: (G, T), N, of a few gestures.
        readings: (G, T, S), N.
        rate: Hz.
    """
    figure = Figure(figsize=(3.6 * len(force), 3), layout="constrained")
    for axis, applied, values in zip(
        figure.subplots(1, len(force), squeeze=False)[0], force, readings, strict=True
    ):
        time = np.arange(len(applied)) / rate
        sensor = int(values.amax(0).argmax())
        axis.plot(time, applied, color=COLOURS[0])
        axis.set_ylabel("applied force, N", color=COLOURS[0])
        axis.set_xlabel("time, s")
        twin = axis.twinx()
        twin.plot(time, values[:, sensor], color=COLOURS[4], linestyle="--")
        twin.set_ylabel(f"sensor {sensor}, N (dashed)", color=COLOURS[4])
    return figure
