"""Shapes that press, as images of any size, angle and stretch; bodies drawn so that they fit on the sheet."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Sequence
from copy import copy
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

from skin.body.base import AbstractBody, Sheet
from skin.errors import InputError
from skin.touch import splines
from skin.touch.images import hulls, load_image, pyramid

if TYPE_CHECKING:
    from skin.touch.gesture import Draws, GestureSettings

# Frames rendered at once: their sampling grid (32 KiB a frame on 32 x 32 cells) then stays in the cache.
_CELLS_AT_ONCE = 128 * 1024
_POINTS = 4
_LARGE = 2
_CALIBRATION_SIZES, _CALIBRATION_POSES = 24, 6
# A fine picture of a shape has as many samples along a cell, and at most so many along its box.
_SAMPLES, _BOX = (2, 8), 48
_FRAMES = 128  # whose moments are computed at once
# The area of fine pictures is that of cells so many times as short.
_FINER = 4
_FINE_SIZES, _FINE_POSES = 12, 2
_TRIES = 2000
_PROBES = 500
_RARE = 0.01
# Tolerance for rounding in shapes that fit exactly.
_SLACK = 1e-9


class Solids(NamedTuple):
    """Shapes as objects with an outline, sampled on the cells.

    Attributes:
        inside: (F, H, W), bool, cells that the object covers by at least half; if there are none, those with
            the largest cover.
        grey: (F, H, W), mean grey of the covered part, 1 = white; 0 outside.
        rim: (F, H, W), its mean distance from the outline, m; 0 outside.
    """

    inside: Tensor
    grey: Tensor
    rim: Tensor


class Pressed(NamedTuple):
    """What shapes press.

    Attributes:
        moments: (F, H, W), float32, of the pressure with the splines of the cells, of sum 1.
        peak: (F,), float32, highest pressure, as a share of the force by the area of a cell.
        area: (F,), share of the sheet in contact.
    """

    moments: Tensor
    peak: Tensor
    area: np.ndarray


class _Drawn(NamedTuple):
    """Shapes as :meth:`Shapes.render` takes them."""

    shape: np.ndarray
    angle: np.ndarray
    scale: np.ndarray
    place: np.ndarray
    stretch: np.ndarray

    def rows(self, rows: np.ndarray) -> _Drawn:
        """Return some of the shapes."""
        return _Drawn(*(values[rows] for values in self))


_FINE_AREAS: dict[tuple[Any, ...], tuple[np.ndarray, np.ndarray]] = {}  # of the shapes used so far


class Shapes:
    """Grey-scale images that can be pressed on a sheet at any place, angle and size.

    The *scale* of a shape is half the side of its texture, m; its place is the centre of its texture. The
    *stretch* is its extent along x over that along y, relative to the original, at constant area; None is 1.

    Args:
        names: stems in ``data/shapes`` or paths of pictures.
        body: the sheet.
        contact: share of a gesture's peak cell above which a cell is in contact.
        fine: whether areas are those of a fine picture, which hardly depend on the cells, for shapes that
            are on the sheet as a whole (:meth:`press`).

    Attributes:
        names: one per shape.
        hulls: (N, K, 2), corners of each shape's convex outline (pixels above ``contact``), in scales.

    Raises:
        InputError: no shape, or a picture that cannot be used (:func:`skin.touch.images.load_image`).
    """

    def __init__(
        self, names: Sequence[str], body: AbstractBody, contact: float = 0.02, fine: bool = False
    ) -> None:
        self.names = tuple(names)
        self.body: AbstractBody = body
        self.contact, self.fine = contact, fine
        # Cells are sampled at _POINTS = 2 x 2 points, a spacing apart.
        self.spacing = float(np.sqrt(np.prod(body.cell))) / 2
        finest = max(64, max(body.size) / self.spacing) * (2 if fine else 1)
        self.levels = pyramid([load_image(name) for name in names], 2 ** int(np.ceil(np.log2(finest))))
        self.hulls, self._outlines = (hulls(self.levels[0][:, 0].numpy(), edge) for edge in (contact, 0.0))

    def extent(
        self, shape: np.ndarray, angle: np.ndarray, scale: np.ndarray, stretch: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the bounding box of the outline around its place: lowest and highest (x, y), (B, 2), m."""
        return _bounds(self.hulls, shape, angle, scale, stretch)

    def scale(self, shape: np.ndarray, area: np.ndarray) -> np.ndarray:
        """Return the scale (B,), m, at which shapes cover a share of the sheet, on average over places.

        Parts beyond the sheet do not count.
        """
        return _interpolate(shape, np.sqrt(area), *self._calibration[::-1])

    def area(self, shape: np.ndarray, scale: np.ndarray) -> np.ndarray:
        """Return the share of the sheet (B,) that shapes cover at a scale, m (inverse of :meth:`scale`)."""
        return _interpolate(shape, scale, *self._calibration) ** 2

    def whole_scale(self, shape: np.ndarray, area: np.ndarray) -> np.ndarray:
        """Return the scale (B,), m, at which whole shapes cover as much as a share of the sheet."""
        if self.fine:
            return self.scale(shape, area)
        large = self._large
        return large.scale(shape, area * (np.prod(self.body.cells) / np.prod(large.body.cells)))

    @cached_property
    def _large(self) -> Shapes:
        """The same shapes on a square of the same cells that is large enough for a long shape."""
        count = int(np.ceil(_LARGE * np.sqrt(np.prod(self.body.cells))))
        size = (count * self.body.cell[0], count * self.body.cell[1])
        # The same images, because scales refer to them, but without values computed for this sheet.
        large = copy(self)
        for name in ("_calibration", "_points"):
            vars(large).pop(name, None)
        large.body = Sheet(size, (count, count), self.body.layers)
        return large

    @cached_property
    def _calibration(self) -> tuple[np.ndarray, np.ndarray]:
        """Scales and the square roots of the area shares at them, each (N, sizes).

        Cells at the rim count as whole although the shape covers them in part. The area of a shape of a given
        size therefore depends on the mesh, and is computed once. Its root is nearly linear in the scale.
        """
        if not self.fine:
            return self._measure(_CALIBRATION_SIZES, _CALIBRATION_POSES, self._count_cells)
        images = hashlib.sha256(self.levels[0].numpy().tobytes()).hexdigest()
        key = images, self.body.size, self.body.cells, self.contact
        if key not in _FINE_AREAS:
            _FINE_AREAS[key] = self._measure(_FINE_SIZES, _FINE_POSES, self._count_fine)
        return _FINE_AREAS[key]

    def _measure(
        self, sizes: int, poses: int, count: Callable[[_Drawn], Iterator[tuple[np.ndarray, Tensor]]]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return scales, from a small part of the sheet to more than the whole, and the roots of areas."""
        angle, *offset = np.tile(np.random.default_rng(0).random((poses, 3)), (len(self.names) * sizes, 1)).T
        width = np.ptp(self.hulls, axis=1).min(axis=1)
        scales = (1.5 * max(self.body.size) / width)[:, None] * np.geomspace(1 / 128, 1, sizes)
        number = np.repeat(np.arange(len(scales)), sizes * poses)
        place = np.array(self.body.size) / 2 + (np.stack(offset, axis=1) - 0.5) * self.body.cell
        shares = torch.empty(len(number), dtype=torch.float64)
        drawn = _Drawn(
            number, 2 * np.pi * angle, np.repeat(scales.ravel(), poses), place, np.ones(len(number))
        )
        for part, share in count(drawn):
            shares[torch.from_numpy(part)] = share
        means = shares.view(len(scales), sizes, poses).mean(2).numpy()
        return scales, np.sqrt(np.maximum.accumulate(means, axis=1))

    def _count_cells(self, drawn: _Drawn) -> Iterator[tuple[np.ndarray, Tensor]]:
        """Yield rows of shapes and the share of the sheet's cells in contact."""
        for part in np.split(np.arange(len(drawn.shape)), len(self.names)):
            frames = self.render(*drawn.rows(part)).flatten(1)
            yield part, (frames > self.contact * frames.amax(1, keepdim=True)).double().mean(1)

    def _count_fine(self, drawn: _Drawn) -> Iterator[tuple[np.ndarray, Tensor]]:
        """Yield the same for fine pictures, of cells _FINER times as short, of whole shapes."""
        for part, _, _, pictures in self._pictures(drawn, 2 * _FINER):
            pixels = avg_pool2d(pictures, 2).flatten(1)
            touched = (pixels > self.contact * pixels.amax(1, keepdim=True)).sum(1)
            yield part, touched.double() / (_FINER**2 * math.prod(self.body.cells))

    def press(
        self,
        shape: np.ndarray,
        angle: np.ndarray,
        scale: np.ndarray,
        place: np.ndarray,
        stretch: np.ndarray | None = None,
    ) -> Pressed:
        """Return what shapes press, as :meth:`render` takes them, from pictures of the boxes they cover."""
        drawn = _Drawn(shape, angle, scale, place, np.ones(len(shape)) if stretch is None else stretch)
        # Adjacent frames that differ in their place alone, as those of a path, share a picture.
        same = [np.diff(values) == 0 for values in drawn if values.ndim == 1]
        first = np.flatnonzero(np.append(True, ~np.logical_and.reduce(same)))
        last = np.append(first[1:], len(shape))
        moments, peak = torch.empty(len(shape), *self.body.shape), torch.empty(len(shape))
        for part, corner, count, pictures in self._pictures(drawn.rows(first)):
            frames = np.concatenate([np.arange(first[row], last[row]) for row in part])
            number = np.repeat(np.arange(len(part)), (last - first)[part])
            at = place[frames] / self.body.cell + corner[number]
            highest = pictures.amax((1, 2))
            for rows in np.split(np.arange(len(frames)), np.arange(_FRAMES, len(frames), _FRAMES)):
                chosen = torch.from_numpy(number[rows])
                pressed = self._moments(pictures[chosen], at[rows], count)
                total = pressed.sum((1, 2))
                moments[frames[rows]] = pressed.div_(total[:, None, None])
                peak[frames[rows]] = highest[chosen] / total
        return Pressed(moments, peak, self.area(shape, scale))

    def _box(self, drawn: _Drawn) -> tuple[np.ndarray, np.ndarray]:
        """Return the upper left corners of boxes from their places, and their extents, (F, 2), in cells."""
        scale = self._visible(drawn.scale, drawn.stretch)
        bounds = _bounds(self._outlines, drawn.shape, drawn.angle, scale, drawn.stretch)
        low, high = (side / self.body.cell for side in bounds)
        return low, np.maximum(np.ceil(high - low), 1).astype(int)

    def _pictures(
        self, drawn: _Drawn, samples: int | None = None
    ) -> Iterator[tuple[np.ndarray, np.ndarray, int, Tensor]]:
        """Yield pictures of shapes that are sampled alike: their rows, corners, samples and values.

        Args:
            drawn: the shapes.
            samples: along each side of a cell; None: as many as the size of a shape asks for.

        Yields:
            rows (f,); upper left corner of each picture from its place, in cells, (f, 2); samples along a
            cell; (f, y, x), float32.
        """
        corner, extent = self._box(drawn)
        fitting = 2 ** np.floor(np.log2(_BOX / extent.max(axis=1))) if samples is None else samples
        counts = np.broadcast_to(fitting, len(extent)).clip(*_SAMPLES).astype(int)
        texel = 2 * self._visible(drawn.scale, drawn.stretch) / self.levels[0].shape[-1]
        level = np.floor(np.log2(np.sqrt(np.prod(self.body.cell)) / counts / texel))
        level = np.clip(level, 0, len(self.levels) - 1).astype(int)
        order = np.lexsort((*extent.T, level, counts))
        changes = np.flatnonzero(np.diff(level[order]) | np.diff(counts[order])) + 1
        for run in np.split(order, changes):
            count = int(counts[run[0]])
            step = max(1, 2 * _CELLS_AT_ONCE // int(np.prod(extent[run].max(axis=0)) * count**2))
            for rows in np.split(run, np.arange(step, len(run), step)):
                texture = self.levels[level[run[0]]][torch.from_numpy(drawn.shape[rows])]
                box = extent[rows].max(axis=0)
                yield (
                    rows,
                    corner[rows],
                    count,
                    self._picture(texture, drawn.rows(rows), corner[rows], box, count),
                )

    def _picture(
        self, texture: Tensor, drawn: _Drawn, corner: np.ndarray, box: np.ndarray, count: int
    ) -> Tensor:
        """Return samples (f, y, x) of textures (f, 1, p, p), ``count`` along each side of a box's cells."""
        wide = np.sqrt(drawn.stretch)
        turn = np.exp(-1j * drawn.angle) / self._visible(drawn.scale, drawn.stretch)
        begin = (corner * self.body.cell).T
        shift = turn * (begin[0] / wide + 1j * (begin[1] * wide))
        x, y = (
            torch.from_numpy((np.arange(cells * count) + 0.5) * (size / count))
            for cells, size in zip(box, self.body.cell, strict=True)
        )
        turn_x, turn_y, shifts = (
            torch.from_numpy(part)[:, None, None] for part in (turn / wide, 1j * turn * wide, shift)
        )
        across, down = (turn_x * x + shifts).to(torch.complex64), (turn_y * y[:, None]).to(torch.complex64)
        grid = torch.view_as_real(across + down)
        return grid_sample(texture, grid, padding_mode="zeros", align_corners=False)[:, 0]

    def _moments(self, pictures: Tensor, corner: np.ndarray, count: int) -> Tensor:
        """Return the moments (f, H, W) of pictures (f, y, x) whose corners are at places (f, 2), in cells."""
        tables, cells = [], []
        for axis, side in enumerate(self.body.cells):
            size = pictures.shape[2 - axis] // count
            first = np.clip(np.floor(corner[:, axis]), 0, max(side - size - 1, 0))
            tables.append(splines.sampled(corner[:, axis] - first, size, count, -first, side - first))
            cells.append(torch.from_numpy(first.astype(int)))
        box = tables[1].mT @ pictures @ tables[0]
        wide = [side + 2 * splines.REACH for side in self.body.shape]
        height, width = (max(side, part) for side, part in zip(wide, box.shape[1:], strict=True))
        row, column = (torch.arange(part) for part in box.shape[1:])
        place = (cells[1][:, None, None] + row[:, None]) * width + cells[0][:, None, None] + column
        sheet = torch.zeros(len(box), height * width)
        sheet.scatter_(1, place.flatten(1), box.flatten(1))
        sheet = splines.fold_back(sheet.view(-1, height, width)[:, : wide[0], : wide[1]])
        return splines.fold_back(sheet.mT).mT

    def render(
        self,
        shape: np.ndarray,
        angle: np.ndarray,
        scale: np.ndarray,
        place: np.ndarray,
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
            place: (F, 2), m.
            stretch: (F,), along x after the rotation.
        """
        frames = torch.empty(len(shape), *self.body.shape)
        for part, cells in self._render_parts(self.levels, shape, angle, scale, place, stretch):
            frames[part] = cells[:, 0].div_(cells.sum((2, 3)).unsqueeze(2))
        return frames

    def solids(
        self,
        shape: np.ndarray,
        angle: np.ndarray,
        scale: np.ndarray,
        place: np.ndarray,
        stretch: np.ndarray | None = None,
    ) -> Solids:
        """Return shapes as objects on the cells; the arguments are those of :meth:`render`.

        The object is where the image is brighter than ``contact``. Stretching does not change ``rim``.
        """
        cells = torch.empty(len(shape), 3, *self.body.shape)
        for part, values in self._render_parts(self._objects, shape, angle, scale, place, stretch):
            cells[part] = values
        cover, grey, rim = cells.unbind(1)
        most = cover.amax((1, 2), keepdim=True)
        inside = cover >= torch.minimum(most, torch.tensor(_POINTS / 2))
        size = torch.from_numpy(self._visible(scale, stretch)).float()[:, None, None]
        return Solids(inside, *((value / cover).where(inside, 0) for value in (grey, rim * size)))

    @cached_property
    def _objects(self) -> list[Tensor]:
        """Levels (N, 3, p, p): inside or not, and inside, grey and distance from the rim in scales."""
        finest = self.levels[0][:, 0]
        inside = finest > self.contact
        # Distance to the outline between pixels instead of the centre of the next pixel outside.
        rim = np.stack([distance_transform_edt(mask) for mask in inside.numpy()]) - 0.5
        scales = torch.from_numpy(rim).float() * (2 / finest.shape[-1])
        levels = [torch.stack([inside.float(), finest * inside, scales * inside], dim=1)]
        while levels[-1].shape[-1] > 1:
            levels.append(avg_pool2d(levels[-1], 2))
        return levels

    def _visible(self, scale: np.ndarray, stretch: np.ndarray | None) -> np.ndarray:
        """Return scales (F,), m, of at least the spacing of the samples."""
        narrow = 1.0 if stretch is None else np.sqrt(np.maximum(stretch, 1 / stretch))
        return np.maximum(scale, max(self.body.cell) / 4 * narrow)

    def _render_parts(
        self,
        levels: list[Tensor],
        shape: np.ndarray,
        angle: np.ndarray,
        scale: np.ndarray,
        place: np.ndarray,
        stretch: np.ndarray | None,
    ) -> Iterator[tuple[slice, Tensor]]:
        """Yield parts of the frames and sums (f, C, H, W) of their cells' samples of levels (N, C, p, p)."""
        scale = self._visible(scale, stretch)
        wide = np.sqrt(np.ones(len(scale)) if stretch is None else stretch)
        texel = 2 * scale / levels[0].shape[-1]
        level = np.clip(np.floor(np.log2(self.spacing / texel)), 0, len(levels) - 1).astype(int)
        turn = np.exp(-1j * angle) / scale
        turns = np.stack([turn / wide, turn * wide])
        shift = turn * (place[:, 0] / wide + 1j * (place[:, 1] * wide))
        step = max(1, _CELLS_AT_ONCE // int(np.prod(self.body.shape)))
        runs = np.split(np.arange(len(level)), np.flatnonzero(np.diff(level)) + 1)
        for run in runs:
            for start in range(0, len(run), step):
                part = slice(run[start], run[min(start + step, len(run)) - 1] + 1)
                texture = levels[level[run[0]]][torch.from_numpy(shape[part])]
                yield part, self._sample(texture, turns[:, part], shift[part])

    @cached_property
    def _points(self) -> tuple[Tensor, Tensor]:
        """Sample points along x (2 W,) and, times i, along y (2 H, 1), m.

        The first halves of all cells, then the second ones, so that a mean over cells reads whole rows.
        """
        x, y = (
            torch.cat([torch.arange(count) + 0.25, torch.arange(count) + 0.75]).double() * size
            for count, size in zip(self.body.cells, self.body.cell, strict=True)
        )
        return x, 1j * y[:, None]

    def _sample(self, texture: Tensor, turns: np.ndarray, shift: np.ndarray) -> Tensor:
        """Return sums (f, C, H, W) of textures (f, C, p, p) seen at turns * (x, i y) - shift, in scales."""
        x, y = self._points
        turn_x, turn_y, shifts = (torch.from_numpy(values)[:, None, None] for values in (*turns, shift))
        # A rotation is a product of complex numbers; grid_sample takes real and imaginary parts.
        across, down = (turn_x * x - shifts).to(torch.complex64), (turn_y * y).to(torch.complex64)
        grid = torch.view_as_real(across + down)
        samples = grid_sample(texture, grid, mode="bilinear", padding_mode="zeros", align_corners=False)
        upper, lower = samples.chunk(2, dim=2)
        left, right = (upper + lower).chunk(2, dim=3)
        return left + right


def _bounds(
    outlines: np.ndarray, shape: np.ndarray, angle: np.ndarray, scale: np.ndarray, stretch: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return lowest and highest (x, y), (B, 2), m, of turned outlines (N, K, 2), which are in scales."""
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    x, y = outlines[shape].transpose(2, 0, 1)
    wide = np.sqrt(np.ones(len(shape)) if stretch is None else stretch)
    corners = np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1) * scale[:, None, None]
    corners *= np.stack([wide, 1 / wide], axis=-1)[:, None]
    return corners.min(axis=1), corners.max(axis=1)


def _interpolate(shape: np.ndarray, at: np.ndarray, nodes: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the values (B,) at places (B,), between the known ones (N, K) of each shape."""
    result = np.empty(len(shape))
    for number in np.unique(shape):
        mine = shape == number
        result[mine] = np.interp(at[mine], nodes[number], values[number])
    return result


class Fit(NamedTuple):
    """The fit of shapes to a sheet.

    Attributes:
        big: (N,), bool, shapes that fit with a big area.
        small: (N,), bool, shapes that fit with a small area.
    """

    big: np.ndarray
    small: np.ndarray

    @classmethod
    def of(cls, settings: GestureSettings, shapes: Shapes) -> Fit | None:
        """Return the fit of shapes, or None where they are redrawn until they fit.

        They are redrawn, as in the report, unless the shape alone would then predict the label ``big`` with a
        balanced accuracy above ``settings.leak``. Deterministic.

        Raises:
            InputError: no shape fits.
        """
        chance = np.random.default_rng(0).random((2, _PROBES, 4))

        def fits(fitted: bool) -> np.ndarray:
            """Return the share of small and big bodies of each shape that fit, (2, N)."""
            portions = np.empty((2, len(shapes.names)))
            for row, shape in np.ndindex(portions.shape):
                same, number = np.full(_PROBES, bool(row)), np.full(_PROBES, shape)
                arguments = settings, shapes, chance[row], number
                drawn = _draw_fitted(same, *arguments, same) if fitted else _draw_unfitted(same, *arguments)
                portions[row, shape] = drawn["fits"].mean()
            return portions

        redrawn = fits(fitted=False)
        totals = redrawn.sum(axis=1, keepdims=True)
        if totals.all() and (redrawn / totals).max(axis=0).sum() / 2 <= settings.leak:
            return None
        small, big = fits(fitted=True) >= _RARE
        if not big.any():
            raise _explain_no_room(settings, shapes.body.size)
        return cls(big, small | big)

    def draw(self, big: np.ndarray, generator: np.random.Generator) -> np.ndarray:
        """Draw a shape (B,) per body, uniformly among those that fit with its area, big (B,) or small."""
        chance = generator.random(len(big))
        options = [np.flatnonzero(which) for which in (self.small, self.big)]
        small, large = (numbers[(chance * len(numbers)).astype(int)] for numbers in options)
        return np.where(big, large, small)


def draw_bodies(
    big: np.ndarray,
    settings: GestureSettings,
    shapes: Shapes,
    generator: np.random.Generator,
    fit: Fit | None = None,
    kept: np.ndarray | None = None,
) -> Draws:
    """Draw shape, angle, stretch and size of bodies that leave ``spare`` along both axes of the sheet.

    Args:
        big: (B,), bool, which are to be big.
        settings: ranges of the gestures.
        shapes: the shapes and the sheet.
        generator: source of randomness; it draws for all bodies in every round.
        fit: None: shape, angle and size are redrawn until they fit, without stretching. Otherwise each body
            is stretched along the sheet's axes by as little as necessary, up to ``settings.stretch``, and
            gets another angle where that is not enough. The fit is tested with a big area for big and small
            touches, so that shape, angle and stretch are independent of the size; only shapes that do not
            fit with a big area are tested with their own.
        kept: (B,), the shapes to fit, from :meth:`Fit.draw`.

    Returns:
        shape, angle (rad), stretch (``Shapes.render``), scale (m), low and high (B, 2) (m), and misfits:
        number of bodies drawn before that did not fit.

    Raises:
        InputError: none fits.
    """
    drawn: Draws = {"misfits": np.zeros(len(big))}
    todo = np.arange(len(big))
    for _ in range(_TRIES):
        chance = generator.random((len(big), 3 if fit is None else 4))[todo]
        if fit is None or kept is None:
            shape = (chance[:, 0] * len(shapes.names)).astype(int)
            bodies = _draw_unfitted(big[todo], settings, shapes, chance, shape)
        else:
            shape = kept[todo]
            bodies = _draw_fitted(big[todo], settings, shapes, chance, shape, fit.big[shape])
        fits = bodies.pop("fits")
        for name, value in bodies.items():
            drawn.setdefault(name, np.empty((len(big), *value.shape[1:]), value.dtype))[todo] = value
        todo = todo[~fits]
        drawn["misfits"][todo] += 1
        if not len(todo):
            return drawn
    raise _explain_no_room(settings, shapes.body.size)


def _draw_unfitted(
    big: np.ndarray, settings: GestureSettings, shapes: Shapes, chance: np.ndarray, shape: np.ndarray
) -> Draws:
    angle = 2 * np.pi * chance[:, 1]
    scale = shapes.scale(shape, _area(big, settings, chance[:, 2]))
    low, high = shapes.extent(shape, angle, scale)
    fits = (high - low + settings.spare <= shapes.body.size).all(axis=1)
    return {
        "shape": shape, "angle": angle, "stretch": np.ones(len(big)), "scale": scale,
        "low": low, "high": high, "fits": fits,
    }  # fmt: skip


def _draw_fitted(
    big: np.ndarray,
    settings: GestureSettings,
    shapes: Shapes,
    chance: np.ndarray,
    shape: np.ndarray,
    asked_big: np.ndarray,
) -> Draws:
    angle = 2 * np.pi * chance[:, 1]
    scale_asked = shapes.whole_scale(shape, _area(asked_big, settings, chance[:, 2]))
    low, high = shapes.extent(shape, angle, scale_asked)
    room = np.array(shapes.body.size) - settings.spare
    x, y = ((high - low) / np.maximum(room, _SLACK)).T
    # The stretch nearest to 1 at which both sides have room.
    stretch = np.clip(1, y**2, np.maximum(x**-2, y**2))
    fits = (x * y <= 1 + _SLACK) & (np.maximum(stretch, 1 / stretch) <= settings.stretch)
    scale_own = shapes.whole_scale(shape, _area(big, settings, chance[:, 3]))
    scale = np.where(big == asked_big, scale_asked, scale_own)
    low, high = shapes.extent(shape, angle, scale, stretch)
    return {
        "shape": shape, "angle": angle, "stretch": stretch, "scale": scale,
        "low": low, "high": high, "fits": fits,
    }  # fmt: skip


def _area(big: np.ndarray, settings: GestureSettings, chance: np.ndarray) -> np.ndarray:
    least, most = np.where(big[:, None], settings.big_area, settings.small_area).T
    return least + (most - least) * chance


def _explain_no_room(settings: GestureSettings, size: tuple[float, float]) -> InputError:
    least, most = settings.big_area
    return InputError(
        f"none of touch.shapes={list(settings.shapes)} covers {least:g} to {most:g} of a sheet of "
        f"{size[0]:g} x {size[1]:g} m and leaves touch.spare={settings.spare:g} m along x and y, even turned "
        f"and stretched by up to touch.stretch={settings.stretch:g}: lower touch.spare or touch.big_area, "
        "raise touch.stretch, or add a compact shape such as disc"
    )
