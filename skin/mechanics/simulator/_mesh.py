"""The elements of a body: as few rows as readings under a fingertip need."""

import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise

import numpy as np

from skin.body.base import AbstractBody, Sensors
from skin.body.material import MATERIALS
from skin.errors import InputError
from skin.mechanics.simulator._hexahedra import Hexahedra

POISSON = {"Dragon Skin 10 Medium": 0.49}
"""In place of the measured 0.54 (report, table 2), which is impossible: an isotropic solid needs nu < 0.5."""

_FINEST = 2.5e-3  # m; under discs of 5 mm radius and more, rows for narrower elements improve nothing
_SLIVER = 0.4  # of an element's width: a piece this thin is one row
_SAME = 1e-7  # m, between depths that are the same

Pieces = list[tuple[float, tuple[int, int]]]
"""Parts of a layer from its top down: thickness, m, and rows of elements in the fine and the coarse mesh."""


def build_meshes(
    body: AbstractBody,
    sensors: Sensors,
    divisions: int | None,
    poisson: Mapping[str, float],
    refinement: int,
) -> list[tuple[float, Hexahedra, int]]:
    """Return meshes, their weights in a solution, and the elements along a side of a cell in each.

    Errors fall with the square of the elements' size. A mesh with half the rows and half the elements a side
    therefore gives most of the error of the fine one: (4 fine - coarse) / 3. An odd ``refinement`` cannot be
    halved, and leaves the fine mesh alone.

    Against endless layers (``make physics``), with cells of 5 mm and two elements a cell: at most 1.5 % of
    the reading over the sensor, there and up to 16 mm beside, under discs of 5 mm radius and more, with
    layers from 3 to 40 mm, sensors from 5 mm below the surface to 0.5 mm above the base, moduli in ratios up
    to 20 and nu from .45 to .499. Less deep sensors err by up to 5 % (2 mm), because the moments of cells do
    not know the edge of a disc; under a disc of 2.5 mm by 15 % (2 mm), 5 % (5 mm), 2 % (6 mm and more).

    Args:
        body: sheet or arm.
        sensors: whose depths get planes of nodes.
        divisions: rows of elements in each layer of the fine mesh; None: as few as the above needs.
        poisson: name of a material -> nu in place of its own.
        refinement: elements along each side of a cell in the fine mesh.

    Raises:
        InputError: as of :class:`skin.mechanics.simulator.solid.Solid`.
    """
    _check_layers(body)
    width = max(_FINEST, float(np.sqrt(np.prod(body.cell))) / refinement)
    layers = list(_pieces(body, sensors, width))
    if divisions is not None:
        _warn_of_rows(body, sensors, divisions, sum(rows[0] for layer in layers for _, rows in layer))
        coarse = divisions if divisions % 2 else divisions // 2
        layers = [[(sum(height for height, _ in layer), (divisions, coarse))] for layer in layers]
    meshes = []
    parts = ((1.0, refinement),) if refinement % 2 else ((4 / 3, refinement), (-1 / 3, refinement // 2))
    for part, (weight, elements) in enumerate(parts):
        heights = [
            np.concatenate([np.full(rows[part], height / rows[part]) for height, rows in layer])
            for layer in layers
        ]
        meshes.append((weight, build_mesh(body, heights, poisson, elements), elements))
    return meshes


def build_mesh(
    body: AbstractBody,
    divisions: int | Sequence[np.ndarray],
    poisson: Mapping[str, float],
    refinement: int = 1,
) -> Hexahedra:
    """Return a body's elements: its cells cut in equal parts, and rows of elements in each layer.

    Args:
        body: sheet or arm.
        divisions: rows of each layer, or their heights in each layer from the surface down, m.
        poisson: name of a material -> nu in place of its own.
        refinement: elements along each side of a cell.

    Raises:
        InputError: as of :class:`skin.mechanics.simulator.solid.Solid`.
    """
    ratios = _ratios(body, poisson)
    rows, young, ratio = [], [], []
    for above, number in enumerate(reversed(range(len(body.layers)))):
        layer = body.layers[number]
        rows.append(
            np.full(divisions, layer.thickness / divisions)
            if isinstance(divisions, int)
            else divisions[above]
        )
        young += [layer.material.young] * len(rows[-1])
        ratio += [ratios[number]] * len(rows[-1])
    x, y = (np.linspace(0, body.size[axis], refinement * body.cells[axis] + 1) for axis in (0, 1))
    depths = np.concatenate([[0.0], *rows]).cumsum()
    return Hexahedra((x, y, depths), np.array(young), np.array(ratio), body.locate, body.frame)


def _pieces(body: AbstractBody, sensors: Sensors, width: float) -> Iterator[Pieces]:
    """Yield the pieces of each layer from the surface down, cut at the depths of sensors.

    Above the deepest sensor, and where a layer bends over a softer one, the coarse mesh has a row more than
    one for three elements' widths, and three at least; a piece thinner than two needs fewer. Below, a row is
    up to four high.

    Args:
        body: with the layers.
        sensors: a tilted one needs all layers.
        width: of the elements, m.
    """
    flat = np.unique(sensors.positions[~sensors.tilted, 2].round(9))
    planes = flat if len(flat) <= 4 else flat[:0]  # for more depths, the planes are even
    # Close to the base of a body thicker than this, interpolation errs by less than 1 %.
    if body.thickness > 7.5 * width:
        planes = planes[planes < body.thickness - _SLIVER * width - _SAME]
    deepest = body.thickness if sensors.tilted.any() else flat.max(initial=0)
    top, moduli = 0.0, [layer.material.young for layer in body.layers]
    for number in reversed(range(len(body.layers))):
        bottom, pieces = body.thickness - sum(layer.thickness for layer in body.layers[:number]), []
        cuts = planes[(planes > top + _SAME) & (planes < bottom - _SAME)]
        bends = any(
            moduli[upper] > 1.5 * moduli[upper - 1]
            for upper in (number, number + 1)
            if 0 < upper < len(moduli)
        )
        for start, end in pairwise([top, *cuts, bottom]):
            height = (end - start) / width
            if start < deepest - _SAME or bends:
                rows = max(3, math.ceil(1 + height / 3 - _SAME))
            else:
                rows = max(1 + (len(cuts) > 0), math.ceil(height / 4 - _SAME))
            if height <= 2 + _SAME:
                rows = 1 + bends
            kept = height <= 1 + _SAME  # of a thin piece both meshes have the same rows
            if kept:
                rows = 1 if height <= _SLIVER + _SAME else 2
            pieces.append((end - start, (rows if kept else 2 * rows, rows)))
        yield pieces
        top = bottom


def _check_layers(body: AbstractBody) -> None:
    thinnest, widest = 1e-3, min(body.size)  # elements of a usual width are flat in thinner layers
    for number, layer in enumerate(body.layers, start=1):
        if not thinnest <= layer.thickness <= widest:
            raise InputError(
                f"layer {number} of the body is {layer.thickness:g} m thick; simulator=solid takes layers "
                f"from {thinnest:g} m to the width of the skin, {widest:g} m: change its thickness, or take "
                "simulator=fem"
            )


def _warn_of_rows(body: AbstractBody, sensors: Sensors, divisions: int, needed: int) -> None:
    """Warn where a given number of rows is too small for the layers above the deepest sensor."""
    tops = np.cumsum([0.0, *(layer.thickness for layer in reversed(body.layers))])
    deepest = body.thickness if sensors.tilted.any() else sensors.positions[:, 2].max()
    tallest = max(np.diff(tops)[tops[:-1] <= deepest - _SAME], default=0.0) / divisions
    # Measured on layers of 5 to 30 mm with 2 to 10 rows, within a factor of 1.5.
    error = min(1.0, (tallest / 12e-3) ** 3)
    if error > 0.02:
        warnings.warn(
            f"simulator.divisions={divisions} makes rows of elements {1e3 * tallest:.3g} mm high above the "
            f"sensors: readings under a fingertip may err by {100 * error:.0f} %; simulator.divisions=null "
            f"takes {needed} rows and errs by 2 %",
            UserWarning,
            stacklevel=4,
        )


def _ratios(body: AbstractBody, poisson: Mapping[str, float]) -> list[float]:
    names = {layer.material.name for layer in body.layers}
    if unknown := sorted(set(poisson) - names - {material.name for material in MATERIALS}):
        raise InputError(
            f"poisson (simulator.poisson) names {unknown[0]}, but the body is made of "
            f"{', '.join(sorted(names))}"
        )
    ratios = []
    for layer in body.layers:
        measured = layer.material.poisson
        possible = measured if measured < 0.5 else POISSON.get(layer.material.name, measured)
        ratios.append(float(poisson.get(layer.material.name, possible)))
    for layer, ratio in zip(body.layers, ratios, strict=True):
        if not -1 < ratio < 0.5:
            name = layer.material.name
            raise InputError(
                f"{name} has Poisson's ratio {ratio:g}, but no isotropic solid is beyond -1 < nu < 0.5: "
                f"in Python give poisson={{{name!r}: 0.49}} to Solid or use PlatesAndBeams; "
                f"on the command line give 'simulator.poisson={{{name}: 0.49}}' or simulator=fem"
            )
    return ratios
