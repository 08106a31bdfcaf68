"""Candidate sites of sensors on a skin."""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.path import Path as Polygon
from PIL import Image

from skin.body.base import AbstractBody, overlaps
from skin.errors import InputError
from skin.layout.base import place
from skin.paths import candidates
from skin.sensors import Sensors

Zones = Sequence[Sequence[tuple[float, float]]]
"""Polygons, each of at least three corners (x, y), m."""

_COVERED = 0.02  # share of a footprint that a zone may cover, because pixels approximate its outline
_PIXELS = 512
_ASPECT = 0.03
_DARK = 128
_ROUNDING = 1e-9  # m


def candidate_sites(
    body: AbstractBody,
    footprint: tuple[float, float],
    depth: float,
    raster: float | tuple[float, float] | None = None,
    forbidden: np.ndarray | None = None,
) -> Sensors:
    """Return sensors at all sites, row by row, whose footprint lies on the surface and in no keep-out zone.

    Args:
        body: the body.
        footprint: extent (x, y) of a sensor, m.
        depth: of the sensors, m.
        raster: pitch of the sites, or pitches along x and y, m. The raster is centred on the surface. None:
            the cells of the body.
        forbidden: as of :func:`keep_out`, (h, w), bool.

    Raises:
        InputError: no site is left.
    """
    pitches = body.cell if raster is None else raster if isinstance(raster, Sequence) else (raster, raster)
    x, y = (_along(*one) for one in zip(body.size, pitches, footprint, strict=True))
    free = np.ones((len(y), len(x)), dtype=bool)
    if forbidden is not None:
        free = _covered(forbidden, body.size, (x, y), footprint) <= _COVERED
    rows, columns = np.nonzero(free)
    if not len(rows):
        raise InputError(
            f"no site is left for a sensor of {footprint[0]:g} x {footprint[1]:g} m on {body.size[0]:g} x "
            f"{body.size[1]:g} m: shrink the zones of design.keep_out, or lower design.raster or "
            "layout.footprint"
        )
    return place(body, x[columns], y[rows], depth, footprint)


def keep_out(zones: Zones | str | None, size: tuple[float, float]) -> np.ndarray | None:
    """Return where no sensor may be, (h, w), bool, over the whole surface, row by row from the upper left.

    Args:
        zones: polygons; or the path of a picture of the whole surface, in which dark pixels are forbidden; or
            None.
        size: extent (x, y) of the surface, m.

    Raises:
        InputError: a polygon with fewer than three corners, or a picture that cannot be read or has another
            aspect ratio than the surface.
    """
    if isinstance(zones, str):
        return _picture(zones, size)
    if not zones:
        return None
    scale = max(size) / _PIXELS
    width, height = (max(1, round(extent / scale)) for extent in size)
    x, y = (
        (np.arange(count) + 0.5) / count * extent for count, extent in ((width, size[0]), (height, size[1]))
    )
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    inside = np.zeros(len(points), dtype=bool)
    for number, zone in enumerate(zones):
        if len(zone) < 3:
            raise InputError(
                f"polygon {number + 1} of design.keep_out has {len(zone)} corners and needs three: as in "
                "design.keep_out=[[[0,0],[0.04,0],[0.04,0.02]]]"
            )
        inside |= Polygon(zone).contains_points(points)
    return inside.reshape(height, width)


def _picture(given: str, size: tuple[float, float]) -> np.ndarray:
    """Return the dark pixels of a picture; transparent ones are not dark."""
    path = next((one for one in candidates(given) if one.is_file()), None)
    if path is None:
        raise InputError(f"no picture {given}: give design.keep_out=FILE.png, or polygons")
    try:
        with Image.open(path) as file:
            cover = file.convert("RGBA")
        pixels = np.asarray(Image.alpha_composite(Image.new("RGBA", cover.size, "white"), cover).convert("L"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(
            f"cannot read design.keep_out={given}: {error}; give a PNG of the whole surface, dark where no "
            "sensor may be"
        ) from error
    height, width = pixels.shape
    if abs(math.log(width / height * size[1] / size[0])) > _ASPECT:
        raise InputError(
            f"design.keep_out={given} has {width} x {height} pixels, but the surface has {size[0]:g} x "
            f"{size[1]:g} m: give a picture of the whole surface with its aspect ratio"
        )
    return pixels < _DARK


def _along(extent: float, pitch: float, footprint: float) -> np.ndarray:
    """Return the sites along one side, m: centres of equal tiles about its middle."""
    count = int(extent / pitch + 1e-6)
    centres = extent / 2 + pitch * (np.arange(count) - (count - 1) / 2)
    return centres[np.minimum(centres, extent - centres) >= footprint / 2 - _ROUNDING]


def _covered(
    forbidden: np.ndarray,
    size: tuple[float, float],
    sites: tuple[np.ndarray, np.ndarray],
    footprint: tuple[float, float],
) -> np.ndarray:
    """Return the share of the footprint that is forbidden, at each y and x of the sites, (n_y, n_x)."""
    shares = [
        overlaps(np.linspace(0, extent, count + 1), centres, length) / length
        for extent, count, centres, length in zip(size, forbidden.shape[::-1], sites, footprint, strict=True)
    ]
    return shares[1] @ forbidden @ shares[0].T
