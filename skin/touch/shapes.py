"""Shapes that press, as images of any size, angle and stretch, and the moments of their pressure."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Sequence
from copy import copy
from functools import cache, cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from PIL import Image
from scipy.interpolate import BSpline
from scipy.ndimage import distance_transform_edt
from scipy.spatial import ConvexHull
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, avg_pool2d, grid_sample

from skin.body.base import AbstractBody
from skin.body.sheet import Sheet
from skin.core.files import BUNDLED, candidates
from skin.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

# Grey-scale images of objects.


_FOLDER = BUNDLED / "data" / "shapes"


def load_image(name: str) -> np.ndarray:
    """Return a shape's image (h, w), float64, 0 to 1: its brightest pixel is 1.

    Args:
        name: the stem of a file in ``data/shapes``, or the path of any picture; a relative path is looked
            for in the current folder, then beside the package.

    Raises:
        InputError: no such picture, or it is unreadable, empty or black, or has a pixel that is not finite.
    """
    path = _find(name)
    try:
        with Image.open(path) as file:
            image: Image.Image = file
            # Transparent means no force; deep and floating-point pictures keep their own range.
            if "A" in image.getbands() or "transparency" in image.info:
                cover = image.convert("RGBA")
                image = Image.alpha_composite(Image.new("RGBA", cover.size, "black"), cover).convert("L")
            elif image.mode not in ("F", "I") and not image.mode.startswith("I;16"):
                image = image.convert("L")
            pixels = np.asarray(image, dtype=float)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(
            f"cannot read the shape {name} ({path}): {error}; touch.shapes takes grey-scale pictures, "
            "such as a PNG, white = full pressure"
        ) from error
    if pixels.ndim != 2 or not np.isfinite(pixels).all() or pixels.min(initial=0) < 0 or not pixels.any():
        span = f" from {pixels.min():g} to {pixels.max():g}" if pixels.size else ""
        raise InputError(
            f"the shape {name} must be a grey-scale picture (h, w) of finite values from 0 up, not all "
            f"0, got {pixels.shape} pixels{span}: white = full pressure"
        )
    return pixels / pixels.max()


def _find(name: str) -> Path:
    path = Path(name).expanduser()
    for candidate in candidates(path) if path.suffix else [_FOLDER / f"{name}.png", path]:
        if candidate.is_file():
            return candidate.resolve()
    names = ", ".join(sorted(file.stem for file in _FOLDER.glob("*.png")))
    raise InputError(
        f"no shape {name}: touch.shapes takes {names}, or the path of a picture, as in "
        "touch.shapes=[disc,my.png]"
    )


def pyramid(images: Sequence[np.ndarray], pixels: int) -> list[Tensor]:
    """Return the images at halving resolutions, each centred in a square of ``pixels``, a power of two.

    A larger image is averaged down to the square; a smaller one keeps its pixels. A border of one black
    pixel remains around it, so that sampling does not extend its edge.

    Returns:
        levels (N, 1, p, p), float32, p = pixels, pixels / 2, ... 1.
    """
    base = torch.zeros(len(images), 1, pixels, pixels, dtype=torch.float64)
    for square, image in zip(base[:, 0], images, strict=True):
        shrink = min(1.0, (pixels - 2) / max(image.shape))
        height, width = (max(1, round(side * shrink)) for side in image.shape)
        small = adaptive_avg_pool2d(torch.from_numpy(image)[None], (height, width))[0]
        top, left = (pixels - height) // 2, (pixels - width) // 2
        square[top : top + height, left : left + width] = small / small.max()
    return [level.float() for level in halve(base)]


def halve(base: Tensor) -> list[Tensor]:
    """Return images (N, C, p, p), p a power of two, at resolutions p, p / 2, ... 1."""
    levels = [base]
    while levels[-1].shape[-1] > 1:
        levels.append(avg_pool2d(levels[-1], 2))
    return levels


def hulls(images: np.ndarray, contact: float) -> np.ndarray:
    """Return the corners (N, K, 2) of the convex outlines of images (N, p, p), in scales."""
    pixels = images.shape[-1]
    outlines = []
    for image in images:
        rows, columns = np.nonzero(image > contact)
        corners = np.concatenate([np.stack([columns + dx, rows + dy], 1) for dx in (0, 1) for dy in (0, 1)])
        outlines.append(corners[ConvexHull(corners).vertices] / pixels * 2 - 1)
    maximum = max(map(len, outlines))
    return np.stack([np.pad(hull, ((0, maximum - len(hull)), (0, 0)), mode="edge") for hull in outlines])


# Moments of a pressure with cubic B-splines, one centred at each cell.
#
# The moment of a cell is the integral of the pressure times the spline, divided by the cell's area, Pa. Sums
# of the splines represent a smooth influence far better than constants on the cells do, so that moments tell
# where within a cell a small contact presses. At an edge of the sheet a spline beyond it is folded back. The
# splines then add up to 1 everywhere: an even pressure is its own moment, and moments conserve force.


REACH = 2
"""How far a spline reaches from the middle of its cell, in cells."""

_PIECE = BSpline.basis_element(np.arange(-REACH, REACH + 1.0), extrapolate=False)
_GAUSS, _WEIGHTS = np.polynomial.legendre.leggauss(4)  # exact for products of two cubics
_PIECES = 4  # in which a cell is integrated


def spline_values(points: np.ndarray, count: int) -> np.ndarray:
    """Return the splines of ``count`` cells at points (P,), in cells, (P, count)."""
    middles = np.arange(-REACH, count + REACH) + 0.5
    return fold_back(torch.from_numpy(np.nan_to_num(_PIECE(points[:, None] - middles)))).numpy()


def sampled_splines(
    begin: np.ndarray, count: int, samples: int, minimum: np.ndarray, maximum: np.ndarray
) -> torch.Tensor:
    """Return the splines of cells -2 to ``count`` + 2 at even samples of ``count`` cells' lengths.

    Args:
        begin: (F,), of the first length, in cells, 0 to 1 unless it begins beyond an edge.
        count: of lengths.
        samples: of each length.
        minimum, maximum: (F,), the edges of the sheet, in cells; samples beyond them weigh 0.

    Returns:
        (F, count * samples, count + 5), float32, divided by ``samples``.
    """
    start, low, high = (torch.from_numpy(ends)[:, None].float() for ends in (begin, minimum, maximum))
    points = start + (torch.arange(count * samples) + 0.5) / samples
    inside = (points >= low) & (points <= high)
    middles = torch.arange(-REACH, count + 1 + REACH) + 0.5
    away = (points[:, :, None] - middles).abs()
    # The spline at a distance d is ((2 - d)+^3 - 4 (1 - d)+^3) / 6.
    wide, narrow = (2 - away).clamp_(min=0), (1 - away).clamp_(min=0)
    cubes = wide.square().mul_(wide).sub_(narrow.square().mul_(narrow), alpha=4)
    return cubes.mul_(inside[:, :, None] / (6 * samples))


def fold_back(wide: torch.Tensor) -> torch.Tensor:
    """Return values (B, H + 4, ...) of splines with those beyond the edges folded back, (B, H, ...)."""
    inner = wide[:, REACH:-REACH].clone()
    for beyond in range(REACH):
        inner[:, beyond] += wide[:, REACH - 1 - beyond]
        inner[:, inner.shape[1] - 1 - beyond] += wide[:, inner.shape[1] + REACH + beyond]
    return inner


def gauss_points(low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    """Return Gauss points and weights between two points, in cells, by pieces of a quarter of a cell."""
    cuts = np.unique([low, *(np.arange(np.ceil(low * _PIECES), high * _PIECES) / _PIECES), high])
    middle, half = (cuts[1:] + cuts[:-1]) / 2, np.diff(cuts) / 2
    return (middle[:, None] + np.outer(half, _GAUSS)).ravel(), np.outer(half, _WEIGHTS).ravel()


@lru_cache
def cell_moments(count: int) -> np.ndarray:
    """Return the moments (count, count) of 1 Pa on each cell (columns) along one axis."""
    points, weights = gauss_points(0, count)
    return (weights[:, None] * spline_values(points, count)).reshape(count, -1, count).sum(1).T


# Cells rendered at once: their sampling grid, 8 bytes for each of 4 points, stays in the cache (4 MiB).
_CELLS_AT_ONCE = 128 * 1024


class Pose(NamedTuple):
    """Shapes (F,) as :meth:`Shapes.render` takes them.

    Attributes:
        shape: index of the shape.
        angle: rotation from x towards y, rad.
        scale: half the side of the texture, m.
        position: (F, 2), position of its centre, m.
        stretch: along x after the rotation.
    """

    shape: np.ndarray
    angle: np.ndarray
    scale: np.ndarray
    position: np.ndarray
    stretch: np.ndarray

    def rows(self, rows: np.ndarray | slice) -> Pose:
        """Return some of the shapes."""
        return Pose(*(values[rows] for values in self))


_FINE_AREAS: dict[tuple[Any, ...], tuple[np.ndarray, np.ndarray]] = {}  # of the shapes used so far


class Shapes:
    """Grey-scale images that can be pressed on a sheet at any position, angle and size.

    The *scale* of a shape is half the side of its texture, m; its position is the centre of its texture. The
    *stretch* is its extent along x over that along y, relative to the original, at constant area; None is 1.

    Args:
        names: stems in ``data/shapes`` or paths of pictures.
        body: the sheet.
        contact: fraction of a gesture's peak cell above which a cell is in contact.
        fine: whether areas are those of a fine picture, which hardly depend on the cells, for shapes that
            are on the sheet as a whole (:meth:`press`).

    Attributes:
        names: one per shape.
        hulls: (N, K, 2), corners of each shape's convex outline (pixels above ``contact``), in scales.

    Raises:
        InputError: no shape, or a picture that cannot be used (:func:`skin.touch.shapes.load_image`).
    """

    def __init__(
        self, names: Sequence[str], body: AbstractBody, contact: float = 0.02, fine: bool = False
    ) -> None:
        self.names = tuple(names)
        self.body: AbstractBody = body
        self.contact, self.fine = contact, fine
        # Cells are sampled at 2 x 2 points, a spacing apart.
        self.spacing = float(np.sqrt(np.prod(body.cell))) / 2
        finest = max(64, max(body.size) / self.spacing) * (2 if fine else 1)
        self.levels = pyramid([load_image(name) for name in names], 2 ** int(np.ceil(np.log2(finest))))
        self.hulls, self._outlines = (hulls(self.levels[0][:, 0].numpy(), edge) for edge in (contact, 0.0))

    def extent(
        self,
        shape: np.ndarray,
        angle: np.ndarray,
        scale: np.ndarray,
        stretch: np.ndarray | None = None,
        outlines: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the bounding box of the outline around its position: lowest and highest (x, y), (B, 2), m.

        Args:
            shape, angle, scale, stretch: (B,), as in :class:`Pose`.
            outlines: (N, K, 2), in scales; None: :attr:`hulls`.
        """
        cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
        x, y = (self.hulls if outlines is None else outlines)[shape].transpose(2, 0, 1)
        wide = np.sqrt(np.ones(len(shape)) if stretch is None else stretch)
        corners = np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1) * scale[:, None, None]
        corners *= np.stack([wide, 1 / wide], axis=-1)[:, None]
        return corners.min(axis=1), corners.max(axis=1)

    def scale(self, shape: np.ndarray, area: np.ndarray) -> np.ndarray:
        """Return the scale (B,), m, at which shapes cover a fraction of the sheet, on average over positions.

        Parts beyond the sheet do not count.
        """
        return _interpolate(shape, np.sqrt(area), *self._calibration[::-1])

    def area(self, shape: np.ndarray, scale: np.ndarray) -> np.ndarray:
        """Return the fraction of the sheet (B,) that shapes cover at a scale, m: the inverse of scale."""
        return _interpolate(shape, scale, *self._calibration) ** 2

    def whole_scale(self, shape: np.ndarray, area: np.ndarray) -> np.ndarray:
        """Return the scale (B,), m, at which whole shapes cover as much as a fraction of the sheet."""
        if self.fine:
            return self.scale(shape, area)
        return self._large.scale(shape, area * (np.prod(self.body.cells) / np.prod(self._large.body.cells)))

    @cached_property
    def _large(self) -> Shapes:
        """The same shapes on a square of the same cells, of four times the area, which holds a long shape."""
        count = int(np.ceil(2 * np.sqrt(np.prod(self.body.cells))))
        # The same images, because scales refer to them, but without values computed for this sheet.
        large = copy(self)
        for name in ("_calibration", "_points"):
            vars(large).pop(name, None)
        large.body = Sheet(
            (count * self.body.cell[0], count * self.body.cell[1]), (count, count), self.body.layers
        )
        return large

    @cached_property
    def _calibration(self) -> tuple[np.ndarray, np.ndarray]:
        """Scales and the square roots of the fractions of the sheet that they cover, each (N, sizes).

        Cells at the rim count as whole although the shape covers them in part. The area of a shape of a given
        size therefore depends on the mesh, and is computed once. Its root is nearly linear in the scale.
        """
        if not self.fine:
            return self._measure(24, 6, self._count_cells)
        images = hashlib.sha256(self.levels[0].numpy().tobytes()).hexdigest()
        key = images, self.body.size, self.body.cells, self.contact
        if key not in _FINE_AREAS:
            _FINE_AREAS[key] = self._measure(12, 2, self._count_fine)
        return _FINE_AREAS[key]

    def _measure(
        self, sizes: int, poses: int, count: Callable[[Pose], Iterator[tuple[np.ndarray, Tensor]]]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return scales, from a small part of the sheet to more than the whole, and the roots of areas."""
        angle, *offset = np.tile(np.random.default_rng(0).random((poses, 3)), (len(self.names) * sizes, 1)).T
        width = np.ptp(self.hulls, axis=1).min(axis=1)
        scales = (1.5 * max(self.body.size) / width)[:, None] * np.geomspace(1 / 128, 1, sizes)
        number = np.repeat(np.arange(len(scales)), sizes * poses)
        position = np.array(self.body.size) / 2 + (np.stack(offset, axis=1) - 0.5) * self.body.cell
        fractions = torch.empty(len(number), dtype=torch.float64)
        drawn = Pose(
            number, 2 * np.pi * angle, np.repeat(scales.ravel(), poses), position, np.ones(len(number))
        )
        for part, covered in count(drawn):
            fractions[torch.from_numpy(part)] = covered
        means = fractions.view(len(scales), sizes, poses).mean(2).numpy()
        return scales, np.sqrt(np.maximum.accumulate(means, axis=1))

    def _count_cells(self, drawn: Pose) -> Iterator[tuple[np.ndarray, Tensor]]:
        """Yield rows of shapes and the fraction of the sheet's cells in contact."""
        for part in np.split(np.arange(len(drawn.shape)), len(self.names)):
            frames = self.render(*drawn.rows(part)).flatten(1)
            yield part, (frames > self.contact * frames.amax(1, keepdim=True)).double().mean(1)

    def _count_fine(self, drawn: Pose, finer: int = 4) -> Iterator[tuple[np.ndarray, Tensor]]:
        """Yield the same for fine pictures of whole shapes, of cells ``finer`` times as short."""
        for part, _, _, pictures in self._pictures(drawn, 2 * finer):
            pixels = avg_pool2d(pictures, 2).flatten(1)
            touched = (pixels > self.contact * pixels.amax(1, keepdim=True)).sum(1)
            yield part, touched.double() / (finer**2 * math.prod(self.body.cells))

    def press(
        self,
        shape: np.ndarray,
        angle: np.ndarray,
        scale: np.ndarray,
        position: np.ndarray,
        stretch: np.ndarray | None = None,
        frames_at_once: int = 128,
    ) -> tuple[Tensor, Tensor, np.ndarray]:
        """Press shapes, as :meth:`render` takes them, by pictures of the boxes that they cover.

        Returns:
            Moments (F, H, W), float32, of the pressure with the splines of the cells, of sum 1; the highest
            pressure as a fraction of the force by the area of a cell, (F,), float32; and the fraction of the
            sheet in contact, (F,).
        """
        drawn = Pose(shape, angle, scale, position, np.ones(len(shape)) if stretch is None else stretch)
        # Adjacent frames that differ in their position alone, as those of a path, share a picture.
        same = [np.diff(values) == 0 for values in drawn if values.ndim == 1]
        first = np.flatnonzero(np.append(True, ~np.logical_and.reduce(same)))
        last = np.append(first[1:], len(shape))
        moments, peak = torch.empty(len(shape), *self.body.shape), torch.empty(len(shape))
        for part, corner, count, pictures in self._pictures(drawn.rows(first)):
            frames = np.concatenate([np.arange(first[row], last[row]) for row in part])
            number = np.repeat(np.arange(len(part)), (last - first)[part])
            at = position[frames] / self.body.cell + corner[number]
            highest = pictures.amax((1, 2))
            for rows in np.split(
                np.arange(len(frames)), np.arange(frames_at_once, len(frames), frames_at_once)
            ):
                chosen = torch.from_numpy(number[rows])
                pressed = self._moments(pictures[chosen], at[rows], count)
                total = pressed.sum((1, 2))
                moments[frames[rows]] = pressed.div_(total[:, None, None])
                peak[frames[rows]] = highest[chosen] / total
        return moments, peak, self.area(shape, scale)

    def _pictures(
        self, drawn: Pose, samples: int | None = None, limits: tuple[int, int] = (2, 8), box: int = 48
    ) -> Iterator[tuple[np.ndarray, np.ndarray, int, Tensor]]:
        """Yield pictures of shapes that are sampled alike: their rows, corners, samples and values.

        Args:
            drawn: the shapes.
            samples: along each side of a cell; None: as many as give ``box`` samples along a shape.
            limits: fewest and most samples along each side of a cell.
            box: largest number of samples along a shape, within these limits.

        Yields:
            rows (f,); upper left corner of each picture from its position, in cells, (f, 2); samples along a
            cell; (f, y, x), float32.
        """
        scale = self.visible(drawn)
        bounds = self.extent(drawn.shape, drawn.angle, scale, drawn.stretch, self._outlines)
        corner, end = (side / self.body.cell for side in bounds)
        extent = np.maximum(np.ceil(end - corner), 1).astype(int)
        fitting = 2 ** np.floor(np.log2(box / extent.max(axis=1))) if samples is None else samples
        counts = np.broadcast_to(fitting, len(extent)).clip(*limits).astype(int)
        texel = 2 * scale / self.levels[0].shape[-1]
        steps = np.sqrt(np.prod(self.body.cell)) / counts / texel
        level = np.clip(np.floor(np.log2(steps)), 0, len(self.levels) - 1).astype(int)
        order = np.lexsort((*extent.T, level, counts))
        changes = np.flatnonzero(np.diff(level[order]) | np.diff(counts[order])) + 1
        for run in np.split(order, changes):
            count = int(counts[run[0]])
            step = max(1, 2 * _CELLS_AT_ONCE // int(np.prod(extent[run].max(axis=0)) * count**2))
            for rows in np.split(run, np.arange(step, len(run), step)):
                texture = self.levels[level[run[0]]][torch.from_numpy(drawn.shape[rows])]
                picture = self._picture(
                    texture, drawn.rows(rows), corner[rows], extent[rows].max(axis=0), count
                )
                yield rows, corner[rows], count, picture

    def _picture(
        self, texture: Tensor, drawn: Pose, corner: np.ndarray, box: np.ndarray, count: int
    ) -> Tensor:
        """Return samples (f, y, x) of textures (f, 1, p, p), ``count`` along each side of a box's cells."""
        points = (
            torch.from_numpy((np.arange(cells * count) + 0.5) * (size / count))
            for cells, size in zip(box, self.body.cell, strict=True)
        )
        return self._seen(texture, drawn, corner * self.body.cell, *points)[:, 0]

    def _seen(self, texture: Tensor, drawn: Pose, begin: np.ndarray, x: Tensor, y: Tensor) -> Tensor:
        """Return samples (f, C, Y, X) of textures (f, C, p, p) at points (X,), (Y,), m, behind ``begin``.

        Args:
            texture: of each shape.
            drawn: the shapes.
            begin: (f, 2), position of the origin of the points from that of each shape, m.
            x, y: along the axes of the sheet.
        """
        wide = np.sqrt(drawn.stretch)
        # A rotation is a product of complex numbers; grid_sample takes real and imaginary parts.
        turn = np.exp(-1j * drawn.angle) / self.visible(drawn)
        shift = turn * (begin[:, 0] / wide + 1j * (begin[:, 1] * wide))
        turn_x, turn_y, shifts = (
            torch.from_numpy(part)[:, None, None] for part in (turn / wide, 1j * turn * wide, shift)
        )
        across, down = (turn_x * x + shifts).to(torch.complex64), (turn_y * y[:, None]).to(torch.complex64)
        grid = torch.view_as_real(across + down)
        return grid_sample(texture, grid, mode="bilinear", padding_mode="zeros", align_corners=False)

    def _moments(self, pictures: Tensor, corner: np.ndarray, count: int) -> Tensor:
        """Return the moments (f, H, W) of pictures (f, y, x) with corners at positions (f, 2), in cells."""
        tables, cells = [], []
        for axis, side in enumerate(self.body.cells):
            size = pictures.shape[2 - axis] // count
            first = np.clip(np.floor(corner[:, axis]), 0, max(side - size - 1, 0))
            tables.append(sampled_splines(corner[:, axis] - first, size, count, -first, side - first))
            cells.append(torch.from_numpy(first.astype(int)))
        box = tables[1].mT @ pictures @ tables[0]
        wide = [side + 2 * REACH for side in self.body.shape]
        height, width = (max(side, part) for side, part in zip(wide, box.shape[1:], strict=True))
        row, column = (torch.arange(part) for part in box.shape[1:])
        position = (cells[1][:, None, None] + row[:, None]) * width + cells[0][:, None, None] + column
        sheet = torch.zeros(len(box), height * width)
        sheet.scatter_(1, position.flatten(1), box.flatten(1))
        sheet = fold_back(sheet.view(-1, height, width)[:, : wide[0], : wide[1]])
        return fold_back(sheet.mT).mT

    def render(
        self,
        shape: np.ndarray,
        angle: np.ndarray,
        scale: np.ndarray,
        position: np.ndarray,
        stretch: np.ndarray | None = None,
    ) -> Tensor:
        """Return frames (F, H, W), float32, each of sum 1 (report, equation 1).

        Each cell is the mean of 2 x 2 bilinear samples of the texture level whose pixels are about as far
        apart as the samples, so that coarse cells get the average of the image instead of single pixels.
        Frames that are sorted by scale are rendered in fewer runs.

        Args:
            shape: (F,), index of the shape.
            angle: (F,), rotation from x towards y, rad.
            scale: (F,), m.
            position: (F, 2), m.
            stretch: (F,), along x after the rotation.
        """
        drawn = Pose(shape, angle, scale, position, np.ones(len(shape)) if stretch is None else stretch)
        frames = torch.empty(len(shape), *self.body.shape)
        for part, cells in self.cells(self.levels, drawn):
            frames[part] = cells[:, 0].div_(cells.sum((2, 3)).unsqueeze(2))
        return frames

    @cached_property
    def objects(self) -> list[Tensor]:
        """Levels (N, 3, p, p): inside or not, and inside, grey and distance from the rim in scales."""
        finest = self.levels[0][:, 0]
        inside = finest > self.contact
        # Distance to the outline between pixels instead of the centre of the next pixel outside.
        rim = np.stack([distance_transform_edt(mask) for mask in inside.numpy()]) - 0.5
        scales = torch.from_numpy(rim).float() * (2 / finest.shape[-1])
        return halve(torch.stack([inside.float(), finest * inside, scales * inside], dim=1))

    def visible(self, drawn: Pose) -> np.ndarray:
        """Return the scales (F,), m, of shapes, at least the spacing of the samples."""
        narrow = np.sqrt(np.maximum(drawn.stretch, 1 / drawn.stretch))
        return np.maximum(drawn.scale, max(self.body.cell) / 4 * narrow)

    def cells(self, levels: list[Tensor], drawn: Pose) -> Iterator[tuple[slice, Tensor]]:
        """Yield parts of shapes and the sums (f, C, H, W) of 2 x 2 samples a cell of levels (N, C, p, p)."""
        texel = 2 * self.visible(drawn) / levels[0].shape[-1]
        level = np.clip(np.floor(np.log2(self.spacing / texel)), 0, len(levels) - 1).astype(int)
        step = max(1, _CELLS_AT_ONCE // int(np.prod(self.body.shape)))
        for run in np.split(np.arange(len(level)), np.flatnonzero(np.diff(level)) + 1):
            for start in range(0, len(run), step):
                part = slice(run[start], run[min(start + step, len(run)) - 1] + 1)
                one = drawn.rows(part)
                texture = levels[level[run[0]]][torch.from_numpy(one.shape)]
                upper, lower = self._seen(texture, one, -one.position, *self._points).chunk(2, dim=2)
                left, right = (upper + lower).chunk(2, dim=3)
                yield part, left + right

    @cached_property
    def _points(self) -> list[Tensor]:
        """Sample points along x (2 W,) and along y (2 H,), m.

        The first halves of all cells, then the second ones, so that a mean over cells reads whole rows.
        """
        return [
            torch.cat([torch.arange(count) + 0.25, torch.arange(count) + 0.75]).double() * size
            for count, size in zip(self.body.cells, self.body.cell, strict=True)
        ]


def _interpolate(shape: np.ndarray, at: np.ndarray, nodes: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the values (B,) at arguments (B,), between the nodes (N, K) of each shape."""
    result = np.empty(len(shape))
    for number in np.unique(shape):
        mine = shape == number
        result[mine] = np.interp(at[mine], nodes[number], values[number])
    return result


# Presses at known forces.


def half_extents(shapes: Shapes) -> np.ndarray:
    """Return half the larger extent of each shape, (N,), in scales: a picture has a black border."""
    return np.array([np.ptp(hull, axis=0).max() / 2 for hull in shapes.hulls])


def peak_per_newton(shapes: Shapes, shape: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Return the highest pressure of shapes under 1 N, Pa; of the whole pictures, whatever the cells.

    Args:
        shapes: the pictures.
        shape: indices.
        radius: half the larger extent of each, m.
    """
    return 1 / (np.array([_cover(name, shapes.contact) for name in shapes.names])[shape] * radius**2)


@cache
def _cover(name: str, contact: float) -> float:
    """Return the force of a picture of 1 Pa by the square of its radius: pi for a disc."""
    picture = load_image(name)
    extents = [np.ptp(pixels) + 1 for pixels in np.nonzero(picture > contact)]
    return picture.sum() / (max(extents) / 2) ** 2


def pressed_images(body: AbstractBody, presses: pd.DataFrame) -> Iterator[Tensor]:
    """Yield the pressure of each press under 1 N, (1, H, W), Pa.

    Args:
        body: that is pressed.
        presses: a row per press, as of :class:`skin.calibration.bench.Gauge`.
    """
    shapes, kind = _indenters(body, presses)
    scale = presses["radius_m"].to_numpy() / half_extents(shapes)[kind]
    for pose in zip(kind, presses["angle"], scale, presses[["x_m", "y_m"]].to_numpy(), strict=True):
        yield shapes.render(*(np.array([value]) for value in pose)) / float(np.prod(body.cell))


def pressed_peaks(body: AbstractBody, presses: pd.DataFrame) -> np.ndarray:
    """Return the highest pressure of each press under 1 N, (P,), Pa, by the picture of its indenter."""
    return peak_per_newton(*_indenters(body, presses), presses["radius_m"].to_numpy())


def _indenters(body: AbstractBody, presses: pd.DataFrame) -> tuple[Shapes, np.ndarray]:
    """Return the shapes that press, and the index of the shape of each press."""
    names, kind = np.unique(presses["indenter"], return_inverse=True)
    return Shapes(names.tolist(), body), kind
