"""Shapes pressed on a sheet: outline, contact area, frames on the cells."""

from collections.abc import Iterator, Sequence
from copy import copy
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

from skin.body.base import AbstractBody
from skin.body.sheet import Sheet
from skin.touch.images import hulls, load_image, pyramid

# Frames rendered at once: their sampling grid (32 KiB a frame on 32 x 32 cells) then stays in the cache.
_CELLS_AT_ONCE = 128 * 1024
_POINTS = 4
_LARGE = 2
_CALIBRATION_SIZES, _CALIBRATION_POSES = 24, 6


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


class Shapes:
    """Grey-scale images that can be pressed on a sheet at any place, angle and size.

    The *scale* of a shape is half the side of its texture, m; its place is the centre of its texture. The
    *stretch* is its extent along x over that along y, relative to the original, at constant area; None is 1.

    Args:
        names: stems in ``data/shapes`` or paths of pictures.
        body: the sheet.
        contact: share of a gesture's peak cell above which a cell is in contact.

    Attributes:
        names: one per shape.
        hulls: (N, K, 2), corners of each shape's convex outline (pixels above ``contact``), in scales.

    Raises:
        InputError: no shape, or a picture that cannot be used (:func:`skin.touch.images.load_image`).
    """

    def __init__(self, names: Sequence[str], body: AbstractBody, contact: float = 0.02) -> None:
        self.names = tuple(names)
        self.body: AbstractBody = body
        self.contact = contact
        # Cells are sampled at _POINTS = 2 x 2 points, a spacing apart.
        self.spacing = float(np.sqrt(np.prod(body.cell))) / 2
        finest = max(64, max(body.size) / self.spacing)
        self.levels = pyramid([load_image(name) for name in names], 2 ** int(np.ceil(np.log2(finest))))
        self.hulls = hulls(self.levels[0][:, 0].numpy(), contact)

    def extent(
        self, shape: np.ndarray, angle: np.ndarray, scale: np.ndarray, stretch: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the bounding box of the outline around its place: lowest and highest (x, y), (B, 2), m."""
        cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
        x, y = self.hulls[shape, :, 0], self.hulls[shape, :, 1]
        corners = np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1) * scale[:, None, None]
        if stretch is not None:
            wide = np.sqrt(stretch)
            corners *= np.stack([wide, 1 / wide], axis=-1)[:, None]
        return corners.min(axis=1), corners.max(axis=1)

    def scale(self, shape: np.ndarray, area: np.ndarray) -> np.ndarray:
        """Return the scale (B,), m, at which shapes cover a share of the sheet, on average over places.

        Parts beyond the sheet do not count.
        """
        scales, roots = self._calibration
        return _interpolated(shape, np.sqrt(area), roots, scales)

    def area(self, shape: np.ndarray, scale: np.ndarray) -> np.ndarray:
        """Return the share of the sheet (B,) that shapes cover at a scale, m (inverse of :meth:`scale`)."""
        scales, roots = self._calibration
        return _interpolated(shape, scale, scales, roots) ** 2

    def whole_scale(self, shape: np.ndarray, area: np.ndarray) -> np.ndarray:
        """Return the scale (B,), m, at which whole shapes cover as much as a share of the sheet."""
        large = self._large
        return large.scale(shape, area * (np.prod(self.body.cells) / np.prod(large.body.cells)))

    @cached_property
    def _large(self) -> "Shapes":
        """The same shapes on a square of the same cells that is large enough for a long shape."""
        count = int(np.ceil(_LARGE * np.sqrt(np.prod(self.body.cells))))
        size = (count * self.body.cell[0], count * self.body.cell[1])
        # The same images, because scales refer to them, but without values computed for this sheet.
        large = copy(self)
        for known in ("_calibration", "_points"):
            vars(large).pop(known, None)
        large.body = Sheet(size, (count, count), self.body.layers)
        return large

    @cached_property
    def _calibration(self) -> tuple[np.ndarray, np.ndarray]:
        """Scales and the square roots of the area shares at them, each (N, sizes).

        Cells at the rim count as whole although the shape covers them in part. The area of a shape of a given
        size therefore depends on the mesh, and is computed once. Its root is nearly linear in the scale.
        """
        poses = np.random.default_rng(0).random((_CALIBRATION_POSES, 3))
        width = np.ptp(self.hulls, axis=1).min(axis=1)
        largest = 1.5 * max(self.body.size) / width
        scales = largest[:, None] * np.geomspace(1 / 128, 1, _CALIBRATION_SIZES)
        angle = np.tile(2 * np.pi * poses[:, 0], _CALIBRATION_SIZES)
        places = np.array(self.body.size) / 2 + (poses[:, 1:] - 0.5) * self.body.cell
        places = np.tile(places, (_CALIBRATION_SIZES, 1))
        roots = []
        for number, sizes in enumerate(scales):
            size = np.repeat(sizes, _CALIBRATION_POSES)
            frames = self.render(np.full(len(size), number), angle, size, places).flatten(1)
            share = (frames > self.contact * frames.amax(1, keepdim=True)).double().mean(1)
            means = share.view(_CALIBRATION_SIZES, _CALIBRATION_POSES).mean(1).numpy()
            roots.append(np.sqrt(np.maximum.accumulate(means)))
        return scales, np.stack(roots)

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
        for part, cells in self._rendered(self.levels, shape, angle, scale, place, stretch):
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
        for part, values in self._rendered(self._objects, shape, angle, scale, place, stretch):
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

    def _rendered(
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
        turn_x, turn_y, shifts = (torch.from_numpy(one)[:, None, None] for one in (*turns, shift))
        # A rotation is a product of complex numbers; grid_sample takes real and imaginary parts.
        across, down = (turn_x * x - shifts).to(torch.complex64), (turn_y * y).to(torch.complex64)
        grid = torch.view_as_real(across + down)
        samples = grid_sample(texture, grid, mode="bilinear", padding_mode="zeros", align_corners=False)
        upper, lower = samples.chunk(2, dim=2)
        left, right = (upper + lower).chunk(2, dim=3)
        return left + right


def _interpolated(shape: np.ndarray, at: np.ndarray, known: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the values (B,) at places (B,), between the known ones (N, K) of each shape."""
    result = np.empty(len(shape))
    for number in np.unique(shape):
        mine = shape == number
        result[mine] = np.interp(at[mine], known[number], values[number])
    return result
