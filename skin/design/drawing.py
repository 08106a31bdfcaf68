"""Tables and pictures of the expected posterior of a skin, and of placements."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from skin.body.base import AbstractBody, Sensors
from skin.body.layout import tile_centres
from skin.design.expected import Findings, Step
from skin.plot.figures import COLOURS, MARKS, save_figure

_NOTE = (
    "Errors of the posterior mean; of the place: rms per axis, median, 90 %, rms where a sensor is raised.\n"
    "Local precision tells a touch from its neighbours alone and is no limit (docs/design.md)."
)
_WIDE = ("raised\nmm", "radius\nmm", "reach\nmm", "local precision\nmm")  # no room in the table of a sweep


def print_expected(expected: Sequence[Findings], normal: Sequence[Findings] = ()) -> None:
    """Print a line per force; of three axes, those of the normal ones alone follow."""
    axes = ["three"] * len(expected) + ["normal"] * len(normal)
    rows = [
        {"axes": name} | _cells(finding) for name, finding in zip(axes, [*expected, *normal], strict=True)
    ]
    _print([{key: row[key] for key in row if key not in (_WIDE[2:] if normal else "axes")} for row in rows])


_LONGER = 20  # cells of the map along its longer side: it fits on a screen


def print_blind_places(
    body: AbstractBody,
    sensors: Sensors,
    forces: Sequence[float],
    count_unfelt: Callable[[np.ndarray], np.ndarray],
) -> None:
    """Print a map of the force from which a fingertip is felt, and where a medium force is not.

    Args:
        body: the skin.
        sensors: in it.
        forces: to choose from, N.
        count_unfelt: from places (N, 2), m, to the number of the forces that no sensor feels there, (N,).
    """
    size, positions = np.array(body.size), sensors.positions[:, :2]
    shape = np.maximum(1, np.round(_LONGER * size[::-1] / size.max())).astype(int)  # rows, columns
    places = tile_centres(*shape) * size
    nearest = np.linalg.norm(places[:, None] - positions, axis=2).argsort(axis=1)[:, :4]
    low, high = positions[nearest].min(axis=1), positions[nearest].max(axis=1)
    inside = ((low[:, None] <= positions) & (positions <= high[:, None])).all(axis=2).sum(axis=1)
    between = ((low < places) & (places < high)).all(axis=1) & (inside == 4)
    groups = np.unique(np.sort(nearest[between], axis=1), axis=0)
    unfelt = count_unfelt(np.concatenate([places, positions[groups].mean(axis=1)]))
    texts = np.array([*(f"{force:g}" for force in sorted(forces)), "##"], dtype="U6")
    cells = texts[unfelt[: len(places)]].reshape(shape)
    numbers = [f"s{number}" for number in range(len(positions))]
    cells[tuple(np.minimum(positions[:, ::-1] / size[::-1] * shape, shape - 1).astype(int).T)] = numbers
    print(
        f"\nLeast of {', '.join(texts[:-1])} N from which a fingertip is felt (##: none; s0, ...: sensors):",
        *("".join(f"{text:>3}" for text in row) for row in cells),
        sep="\n",
    )
    blind = [", ".join(map(str, group)) for group in groups[unfelt[len(places) :] > len(forces) // 2]]
    if blind:
        print(f"A fingertip of {texts[len(forces) // 2]} N is not felt between sensors {'; '.join(blind)}.")


def draw_expected(body: AbstractBody, sensors: Sensors, maps: Mapping[float, np.ndarray], path: Path) -> Path:
    """Draw the expected error of the position for each force, with the sensors, and return the path.

    Args:
        body: the skin.
        sensors: in it.
        maps: force, N -> error on each cell, (H, W), m; NaN where there is none.
        path: x.png.
    """
    wide = body.size[0] > 2 * body.size[1]
    panel = np.array(body.size) * (5.5 if wide else 2.8) / max(body.size)  # inches
    counts = np.array([1, len(maps)] if wide else [len(maps), 1])  # across, down
    size = counts * (panel + np.array([0.2, 0.4])) + np.array([1.4, 0.5])
    figure = Figure(figsize=tuple(size), layout="constrained")
    axes = figure.subplots(counts[1], counts[0], squeeze=False, sharex=True, sharey=True)
    errors = 1e3 * np.array(list(maps.values()))
    lowest, highest = np.nanmin(errors), np.nanmax(errors)
    extent = (0, 1e3 * body.size[0], 1e3 * body.size[1], 0)
    for axis, force, error in zip(axes.flat, maps, errors, strict=True):
        picture = axis.imshow(error, cmap="viridis_r", norm=LogNorm(lowest, highest), extent=extent)
        axis.plot(
            *(1e3 * sensors.positions[:, :2].T), "o", color="white", markeredgecolor="black", markersize=4
        )
        axis.set(title=f"{force:g} N", xlabel="x, mm", ylabel="y, mm")
        axis.label_outer()
    figure.colorbar(
        picture,
        ax=axes,
        label="expected error of the place, mm",
        format="%g",
        ticks=LogLocator(subs=(1, 2, 5) if highest > 5 * lowest else range(1, 10)),
    ).minorticks_off()
    return save_figure(figure, path)


def print_sweep(steps: Sequence[Step]) -> None:
    """Print one line per step and force."""
    rows = [
        {
            "thickness\nmm": f"{1e3 * step.thickness:g}",
            "sensors": f"{step.grid[0]} x {step.grid[1]}",
            "pitch\nmm": f"{1e3 * step.pitch:.0f}",
            **_cells(finding),
        }
        for step in steps
        for finding in step.findings
    ]
    _print([{name: text for name, text in row.items() if name not in _WIDE} for row in rows])


def draw_sweep(steps: Sequence[Step], path: Path) -> Path:
    """Draw the error of the position against thickness, and return the path.

    There is a line per number of sensors.

    Args:
        steps: with the same forces.
        path: x.png.
    """
    forces = [finding.force_N for finding in steps[0].findings]
    figure = Figure(figsize=(2.3 + 4.2 * len(forces), 3.6), layout="constrained")
    axes = figure.subplots(1, len(forces), squeeze=False, sharey=True)[0]
    for number, (axis, force) in enumerate(zip(axes, forces, strict=True)):
        for line, grid in enumerate(dict.fromkeys(step.grid for step in steps)):
            mine = [step for step in steps if step.grid == grid]
            axis.plot(
                [1e3 * step.thickness for step in mine],
                [1e3 * step.findings[number].place_m for step in mine],
                marker=MARKS[line % len(MARKS)],
                color=COLOURS[line % len(COLOURS)],
                label=f"{grid[0]} x {grid[1]} sensors",
            )
        axis.set(title=f"{force:g} N", xlabel="thickness, mm", yscale="log")
        axis.yaxis.set_major_formatter("{x:g}")
        axis.grid(which="both", alpha=0.3)
    axes[0].set_ylabel("error of the place, rms, mm")
    axes[-1].legend(loc="center left", bbox_to_anchor=(1, 0.5))
    return save_figure(figure, path)


def _cells(finding: Findings) -> dict[str, str]:
    """Return name and text of each column of a table."""
    return {
        "force\nN": f"{finding.force_N:g}",
        "blind\n%": f"{100 * finding.blind_share:.1f}",
        "place\nmm": f"{1e3 * finding.place_m:.2f}",
        "median\nmm": f"{1e3 * finding.place_median_m:.2f}",
        "90 %\nmm": f"{1e3 * finding.place_90_m:.2f}",
        "raised\nmm": f"{1e3 * finding.place_raised_m:.2f}",
        "radius\nmm": f"{1e3 * finding.radius_m:.2f}",
        "force\n%": f"{100 * finding.force_relative:.1f}",
        "reach\nmm": f"{1e3 * finding.receptive_radius_m:.1f}",
        "local precision\nmm": f"{1e3 * finding.local_precision_m:.1f}",
    }


def _print(rows: Sequence[dict[str, str]]) -> None:
    # All columns fit into 80 characters.
    table = Table(
        *rows[0],
        title="Expected posterior of a fingertip",
        box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        pad_edge=False,
    )
    for row in rows:
        table.add_row(*row.values())
    Console().print(table)
    print(_NOTE)


# Pictures of sensor placements.


_SHADE = "#BBBBBB"


def placement(
    chosen: np.ndarray,
    before: np.ndarray,
    sites: np.ndarray,
    size: tuple[float, float],
    forbidden: np.ndarray | None,
    title: str,
) -> Figure:
    """Draw the surface with its keep-out zones, the candidate sites, and the sensors before and after.

    Args:
        chosen: (k, 2), m, the placed sensors.
        before: (S, 2), m, those of the configured layout.
        sites: (C, 2), m.
        size: extent (x, y) of the surface, m.
        forbidden: (h, w), bool, the keep-out zones, row by row from the upper left; or None.
        title: of the figure.
    """
    # A margin for labels and the legend is added to a sheet whose longer side is 5 inches.
    scale = 5 / max(size)
    figure = Figure(figsize=(scale * size[0] + 2.8, max(scale * size[1], 1.8) + 0.9), layout="constrained")
    axis = figure.add_subplot()
    extent = (0, 1e3 * size[0], 1e3 * size[1], 0)
    marks: list[Artist] = []
    if forbidden is not None:
        axis.imshow(
            np.ma.masked_equal(forbidden, False),
            extent=extent,
            cmap=ListedColormap([_SHADE]),
            interpolation="nearest",
        )
        marks.append(Patch(color=_SHADE, label="keep-out zone"))
    marks += axis.plot(*(1e3 * sites.T), ".", color=_SHADE, markersize=2, label=f"{len(sites)} sites")
    marks += axis.plot(
        *(1e3 * before.T),
        "s",
        color=COLOURS[1],
        markersize=9,
        markerfacecolor="none",
        label=f"configured layout, {len(before)}",
    )
    marks += axis.plot(*(1e3 * chosen.T), "o", color=COLOURS[0], markersize=6, label=f"placed, {len(chosen)}")
    axis.set(xlabel="x, mm", ylabel="y, mm", xlim=extent[:2], ylim=extent[2:], aspect="equal", title=title)
    axis.legend(handles=marks, loc="upper left", bbox_to_anchor=(1.01, 1), frameon=False)
    return figure
