"""Representations: how readings are shown to a network."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal, NamedTuple

import numpy as np
import torch
from pydantic import Field, PositiveFloat, PositiveInt
from scipy.interpolate import CloughTocher2DInterpolator, LinearNDInterpolator, NearestNDInterpolator
from scipy.spatial import QhullError
from torch import Tensor, nn
from torch.nn.functional import pad

from skin.body.base import GEOMETRY
from skin.core.settings import checked
from skin.device.touches import Touches
from skin.errors import InputError
from skin.learning.features import engineered_features, feature_blocks


class Frames(NamedTuple):
    """The input of a network.

    Attributes:
        x: images (B, T, C, H, W), graphs (B, T, S, F), plain readings (B, T, F).
        adjacency: (S, S) or (B, T, S, S), dense, normalised; None without a graph.
        summary: (B, D), features of the whole window for the dense layers; None if there are none.
    """

    x: Tensor
    adjacency: Tensor | None
    summary: Tensor | None = None


class AbstractRepresentation(nn.Module, ABC):
    """Maps readings (B, T, S) in N with their validity to :class:`Frames`.

    Built for one layout: ``cls(positions, size, **options)`` with positions (S, 3), m, and the sheet's size
    (x, y), m. Readings are divided by ``scale``, N; invalid ones become 0.

    Attributes:
        kind: kind of input that a model must accept: images, graphs or plain readings.
        windowed: whether a frame depends on the other frames of its window.
        layout_free: whether one representation applies to touches of any layout.
    """

    kind: ClassVar[Literal["image", "graph", "readings"]]
    windowed: ClassVar[bool] = False
    layout_free: ClassVar[bool] = False

    @abstractmethod
    def forward(self, readings: Tensor, valid: Tensor) -> Frames:
        """Return the frames of readings (B, T, S), N, and valid (B, T, S), bool."""

    def show(self, touches: Touches) -> Frames:
        """Return the frames of touches; by default of their readings only."""
        return self(touches.readings, touches.valid)


def count_axes(positions: Tensor) -> int:
    """Return the channels of each site: 3 where the sensors (S, 3), m, are three at each position, else 1."""
    return 3 if torch.equal(positions[::3], positions[2::3]) else 1


def channels(readings: Tensor, valid: Tensor, scale: float, mask: bool, axes: int = 1) -> Tensor:
    """Return scaled readings and, optionally, a mask: the common input of all representations.

    Args:
        readings: (B, T, S), N.
        valid: (B, T, S), bool; a reading that is not valid becomes 0, also if it is NaN.
        scale: N; readings are divided by it.
        mask: append a channel that is 1 where the reading is not valid. It is 0 for valid readings, because
            a constant channel of ones is large beside small readings (docs/results/study_dead.csv).
        axes: channels of each site.

    Returns:
        (B, T, S / axes, C axes), with C = 2 under ``mask`` and else 1: first the readings along all axes.
    """
    values = torch.where(valid, readings / scale, readings.new_zeros(()))
    stacked = torch.stack([values, (~valid).to(values.dtype)] if mask else [values], dim=-1)
    return stacked if axes == 1 else stacked.unflatten(2, (-1, axes)).transpose(3, 4).flatten(3)


# Plain readings, one feature per sensor.


class Readings(AbstractRepresentation):
    """Returns the readings as a vector with one feature per sensor, without positions.

    It is the most accurate representation for one fixed layout, and does not apply to another layout.

    Args:
        positions: (S, 3), m; only their number matters.
        size: extent (x, y) of the sheet, m; not used.
        scale: N; readings are divided by it (the clip of the report's sensors is 10 N).
        mask: append one feature per sensor that is 1 where its reading is not valid.
    """

    kind: ClassVar[Literal["image", "graph", "readings"]] = "readings"

    def __init__(
        self, positions: Tensor, size: tuple[float, float], scale: float = 10.0, mask: bool = False
    ) -> None:
        super().__init__()
        self.scale, self.mask = scale, mask

    def forward(self, readings: Tensor, valid: Tensor) -> Frames:
        """Return frames (B, T, S), or (B, T, 2 S) with the mask, of readings (B, T, S), N."""
        return Frames(channels(readings, valid, self.scale, self.mask).mT.flatten(2), None)


# Readings above their idle level, with engineered features of the window.


def idle_level(raw: Tensor, frames: int = 8) -> Tensor:
    """Return the mean of each sensor's lowest frames, (B, 1, S), N, of readings (B, T, S)."""
    return raw.topk(min(frames, raw.shape[1]), dim=1, largest=False).values.mean(dim=1, keepdim=True)


class Features(AbstractRepresentation):
    """Gives readings above their idle level on two scales, and engineered features as a summary.

    A network then sees the readings and the features that boosted trees are trained on. The idle level of a
    sensor is the mean of its eight lowest frames. It is subtracted, so that a network cannot learn the
    constant offsets of one device. The second scale is logarithmic, which resolves weak touches.

    Args:
        positions: (S, 3), m; the features depend on them.
        size: extent (x, y) of the sheet, m; not used.
        scale: N; readings on the linear scale are divided by it.
        finest: N; the logarithmic scale asinh(x / finest) is linear below it.
        mask: append one feature per sensor that is 1 where its reading is not valid.
    """

    kind: ClassVar[Literal["image", "graph", "readings"]] = "readings"
    windowed: ClassVar[bool] = True

    def __init__(
        self,
        positions: Tensor,
        size: tuple[float, float],
        scale: float = 3.0,
        finest: float = 0.2,
        mask: bool = False,
    ) -> None:
        super().__init__()
        self.scale, self.finest, self.mask = scale, finest, mask
        self.positions = nn.Buffer(positions)

    def forward(self, readings: Tensor, valid: Tensor) -> Frames:
        """Return frames (B, T, 2 S), or (B, T, 3 S) with the mask, and the summary (B, D), as asinh.

        The window should hold at least eight frames without touch.
        """
        values = channels(readings, valid, 1.0, self.mask)
        raw = values[..., 0]
        excess = (raw - idle_level(raw)) * valid
        views = [excess / self.scale, torch.asinh(excess / self.finest) / 2, *values.unbind(-1)[1:]]
        touches = Touches(readings, valid, self.positions, None, 1.0)
        summary = torch.cat([values.to(raw) for _, values in feature_blocks(touches)], dim=1)
        return Frames(torch.cat(views, dim=-1), None, summary.asinh())


# The pixel grid that covers the sheet, shared by the image representations.


Pixels = Annotated[int, Field(ge=8)]
"""Edge length of a square image."""


def pixel_of(positions: np.ndarray, size: tuple[float, float], pixels: int) -> np.ndarray:
    """Return the flat index (S,) of the pixel in which each position (S, 3), m, falls; rows run along y."""
    # a sensor on the line between two pixels must not fall here or there by rounding to float32
    scaled = np.floor(positions[:, :2] / np.asarray(size) * pixels + 1e-4).astype(int)
    column, row = np.clip(scaled, 0, pixels - 1).T
    return row * pixels + column


def centres(size: tuple[float, float], pixels: int) -> np.ndarray:
    """Return the centres (pixels * pixels, 2) of all pixels as x, y in m, row by row."""
    middle = (np.arange(pixels) + 0.5) / pixels
    y, x = np.meshgrid(middle * size[1], middle * size[0], indexing="ij")
    return np.stack([x.ravel(), y.ravel()], axis=1)


@checked("representation")
class Image(AbstractRepresentation):
    """Writes each reading to the pixel of its sensor; all other pixels are 0 (report, section 2.2).

    It needs positions only and applies to any layout. Sensors that share a pixel are averaged, because a sum
    would depend on the density of sensors. Sites with three axes give three channels.

    Args:
        positions: (S, 3), m.
        size: extent (x, y) of the sheet, m; the square image covers all of it.
        pixels: edge length of the image; the report tries 48, 64 and 128.
        scale: N; readings are divided by it.
        mask: append a channel that is 1 at the pixels of invalid readings.

    Raises:
        InputError: ``pixels`` is below 8.
    """

    kind: ClassVar[Literal["image", "graph", "readings"]] = "image"

    def __init__(
        self,
        positions: Tensor,
        size: tuple[float, float],
        pixels: Pixels = 64,
        scale: float = 10.0,
        mask: bool = False,
    ) -> None:
        super().__init__()
        self.pixels, self.scale, self.mask, self.axes = pixels, scale, mask, count_axes(positions)
        sites = positions[:: self.axes].cpu().numpy()
        used, numbers = np.unique(pixel_of(sites, size, pixels), return_inverse=True)
        members = np.eye(len(used))[numbers]
        self.pixels_used = nn.Buffer(torch.from_numpy(used))
        self.average = nn.Buffer(torch.from_numpy(members / members.sum(axis=0)).to(torch.float32))

    def forward(self, readings: Tensor, valid: Tensor) -> Frames:
        """Return frames (B, T, C, pixels, pixels) of readings (B, T, S), N."""
        values = channels(readings, valid, self.scale, self.mask, self.axes).mT @ self.average
        blank = values.new_zeros((*values.shape[:-1], self.pixels**2))
        image = blank.scatter(-1, self.pixels_used.expand_as(values), values)
        return Frames(image.unflatten(-1, (self.pixels, self.pixels)), None)


# Weights of the interpolation between sensors, without torch.


Method = Literal["nearest", "linear", "cubic"]


def weights(points: np.ndarray, targets: np.ndarray, method: Method) -> np.ndarray:
    """Return the matrix (P, S) that interpolates values at ``points`` (S, 2) to ``targets`` (P, 2).

    Methods: nearest; linear on the Delaunay triangles; cubic after Clough and Tocher. All are linear in the
    values, so the columns of the matrix are the images of unit readings. Outside the convex hull the nearest
    value is used.

    Raises:
        InputError: the points do not form a triangle.
    """
    unit = np.eye(len(points))
    matrix = NearestNDInterpolator(points, unit)(targets)
    if method == "nearest":
        return matrix
    try:
        if method == "linear":
            inner = LinearNDInterpolator(points, unit)(targets)
        else:
            # the gradients come from an iteration: only a converged one is linear in the values
            inner = CloughTocher2DInterpolator(points, unit, tol=1e-12, maxiter=5000)(targets)
    except QhullError:
        raise InputError(
            f"representation.method={method} needs at least three sensors that are not in one line, "
            f"got {len(points)}: set representation.method=nearest"
        ) from None
    return np.where(np.isnan(inner), matrix, inner)


@checked("representation")
class Interpolation(AbstractRepresentation):
    """Fills the image between the sensors (report, section 2.2 and figure 4).

    One precomputed matrix (pixels * pixels, S) per method is applied to whole batches. The results table
    shows whether interpolated values help a network.

    Args:
        positions: (S, 3), m.
        size: extent (x, y) of the sheet, m; the square image covers all of it.
        method: nearest, linear or cubic (:func:`skin.learning.representation.weights`); or several of
            them, each giving one channel.
        pixels: edge length of the image.
        scale: N; readings are divided by it.
        mask: append the interpolated mask of invalid readings, one channel per method.

    Raises:
        InputError: an unknown method, none at all, too few sensors for it, or ``pixels`` below 8.
    """

    kind: ClassVar[Literal["image", "graph", "readings"]] = "image"

    def __init__(
        self,
        positions: Tensor,
        size: tuple[float, float],
        method: Method | Annotated[Sequence[Method], Field(min_length=1)] = "linear",
        pixels: Pixels = 64,
        scale: float = 10.0,
        mask: bool = False,
    ) -> None:
        super().__init__()
        self.pixels, self.scale, self.mask, self.axes = pixels, scale, mask, count_axes(positions)
        methods: Sequence = method if isinstance(method, list | tuple) else [method]
        points, targets = positions[:: self.axes, :2].cpu().numpy(), centres(size, pixels)
        matrix = np.concatenate([weights(points, targets, method) for method in methods])
        self.matrix = nn.Buffer(torch.from_numpy(matrix).to(torch.float32))

    def forward(self, readings: Tensor, valid: Tensor) -> Frames:
        """Return frames (B, T, C, pixels, pixels) of readings (B, T, S), N."""
        values = channels(readings, valid, self.scale, self.mask, self.axes).mT @ self.matrix.mT
        # Images (B, T, readings or mask, methods, H, W), whose methods become channels.
        return Frames(values.unflatten(-1, (-1, self.pixels, self.pixels)).flatten(2, 3), None)


# The spectrum of the sensor image.


@checked("representation")
class Fourier(AbstractRepresentation):
    """Returns ``log(1 + |FFT|)`` of the sensor image, zero frequency in the middle (report, section 2.2).

    It shows regular patterns of active sensors. Absolute positions are lost with the phase.

    Args:
        positions: (S, 3), m.
        size: extent (x, y) of the sheet, m.
        pixels: edge length of the image and of its spectrum.
        scale: N; readings are divided by it.
        mask: append a channel that is 1 at the pixels (not frequencies) of invalid readings.

    Raises:
        InputError: ``pixels`` is below 8.
    """

    kind: ClassVar[Literal["image", "graph", "readings"]] = "image"

    def __init__(
        self,
        positions: Tensor,
        size: tuple[float, float],
        pixels: Pixels = 64,
        scale: float = 10.0,
        mask: bool = False,
    ) -> None:
        super().__init__()
        self.image = Image(positions, size, pixels=pixels, scale=scale, mask=mask)

    def forward(self, readings: Tensor, valid: Tensor) -> Frames:
        """Return frames (B, T, C, pixels, pixels) of readings (B, T, S), N."""
        image, axes = self.image(readings, valid).x, self.image.axes
        spectrum = torch.fft.fftshift(torch.fft.fft2(image[:, :, :axes]).abs(), dim=(-2, -1))
        return Frames(torch.cat([torch.log1p(spectrum), image[:, :, axes:]], dim=2), None)


# Readings averaged onto virtual sites: the same input for any number and order of sensors.


@checked("representation")
class Sites(AbstractRepresentation):
    """Averages readings onto a grid of virtual sites and gives the largest ones in order.

    The input of a network does not depend on the number and the order of the sensors, and a sensor that is
    not valid has no effect. The weights of an average depend on the distance from sensor to site, relative
    to the extent of the surface. Readings are above their idle level (the mean of the eight lowest frames),
    and on three scales: linear, logarithmic, and logarithmic relative to the sensor's own response to a
    fingertip. Each skin is described by the geometry of its touches (:data:`skin.device.touches.GEOMETRY`),
    so the representation applies to any layout and body.

    Args:
        positions: not used.
        size: not used.
        sites: rows and columns of the grid.
        spreads: standard deviations of the Gaussian weights, as fractions of width and height.
        strongest: number of the largest readings.
        scale: N; readings on the linear scale are divided by it.
        finest: N; the logarithmic scales are linear below it.
    """

    kind: ClassVar[Literal["image", "graph", "readings"]] = "readings"
    windowed: ClassVar[bool] = True
    layout_free: ClassVar[bool] = True

    def __init__(
        self,
        positions: Tensor,
        size: tuple[float, float],
        sites: tuple[PositiveInt, PositiveInt] = (6, 6),
        spreads: Annotated[Sequence[PositiveFloat], Field(min_length=1)] = (0.08, 0.16, 0.32),
        strongest: PositiveInt = 10,
        scale: PositiveFloat = 3.0,
        finest: PositiveFloat = 0.2,
    ) -> None:
        super().__init__()
        y, x = ((torch.arange(count) + 0.5) / count for count in sites)
        self.centres = nn.Buffer(torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).flatten(0, 1))
        self.spreads, self.strongest = tuple(spreads), strongest
        self.scale, self.finest = scale, finest

    def forward(self, readings: Tensor, valid: Tensor) -> Frames:
        """Refuse readings without geometry.

        Raises:
            InputError: always.
        """
        return self.show(Touches(readings, valid, torch.zeros(readings.shape[2], 3), None, 1.0))

    def show(self, touches: Touches) -> Frames:
        """Return frames (B, T, F) and a summary of the skin (B, D).

        Raises:
            InputError: the geometry of the sensors is not known.
        """
        if touches.geometry is None:
            raise InputError(
                "representation=sites needs to know what each sensor responds to, and this device has no "
                "mechanics: use device=simulated, device=serial, a recording with positions: layout, or "
                "another representation"
            )
        batch, _, sensors = touches.readings.shape
        geometry = touches.geometry.expand(batch, sensors, len(GEOMETRY))
        values = self._scaled(touches, geometry)
        weights = self._weights(geometry)
        working = touches.valid.to(values)
        coverage = torch.einsum("bvs,bts->btv", weights, working)
        means = torch.einsum("bvs,btsc->btvc", weights, values) / (coverage + 1e-6)[..., None]
        sums = values[..., 0].sum(2, keepdim=True)
        largest = [self._largest(values[..., channel], touches.valid) for channel in (1, 2)]
        x = torch.cat([means.flatten(2), *largest, sums, sums.asinh()], dim=-1)
        summary = torch.cat([self._summary(geometry, working, coverage), _engineered(touches)], dim=1)
        return Frames(x, None, summary)

    def _scaled(self, touches: Touches, geometry: Tensor) -> Tensor:
        """Return readings above idle on three scales, and whether they are at their limit, (B, T, S, 4)."""
        raw = torch.where(touches.valid, touches.readings, touches.readings.new_zeros(()))
        excess = (raw - idle_level(raw)) * touches.valid
        # of a fingertip of 1 N; a sensor that responds to nothing must not divide by 0
        response = geometry[..., GEOMETRY.index("response_0mm")].clamp(min=1e-3)[:, None]
        saturated = torch.zeros_like(touches.valid) if touches.saturated is None else touches.saturated
        scales = [
            excess / self.scale,
            torch.asinh(excess / self.finest) / 2,
            torch.asinh(excess / response) / 2,
            (touches.valid & saturated).to(excess),
        ]
        return torch.stack(scales, dim=-1)

    def _weights(self, geometry: Tensor) -> Tensor:
        """Return the weight of each sensor at each site for each spread, (B, V, S)."""
        x, y, width, height = (geometry[..., GEOMETRY.index(name)] for name in ("x", "y", "width", "height"))
        # sensors that fill up a small skin have no extent
        extent = torch.stack([width, height], dim=-1).clamp(min=1e-3)
        positions = torch.stack([x, y], dim=-1) / extent
        squares = (self.centres[:, None] - positions[:, None]).square().sum(-1)
        return torch.cat([(-squares / (2 * spread**2)).exp() for spread in self.spreads], dim=1)

    def _largest(self, values: Tensor, valid: Tensor) -> Tensor:
        """Return the largest values of working sensors, (B, T, strongest), 0 where there are fewer."""
        working = values.masked_fill(~valid, -torch.inf)
        strongest = working.topk(min(self.strongest, values.shape[2]), dim=2).values
        return pad(strongest.masked_fill(strongest.isinf(), 0), (0, self.strongest - strongest.shape[2]))

    def _summary(self, geometry: Tensor, working: Tensor, coverage: Tensor) -> Tensor:
        """Return number and mean, minimum and maximum geometry of working sensors, and coverage, (B, D)."""
        alive = (working > 0).any(dim=1)[..., None]
        count = alive.sum(1).clamp(min=1)
        mean = (geometry * alive).sum(1) / count
        minimum = geometry.masked_fill(~alive, torch.inf).amin(1)
        maximum = geometry.masked_fill(~alive, -torch.inf).amax(1)
        finite = [torch.where(column.isfinite(), column, 0) for column in (mean, minimum, maximum)]
        return torch.cat([count.to(mean).log(), *finite, (coverage.amax(1) + 1e-3).log()], dim=1)


def _engineered(touches: Touches) -> Tensor:
    """Return the engineered features that a dead sensor does not change, (B, D), as asinh."""
    changed = ("raw sensor maximum", "sensor sum", "longest run of the sum")
    features = engineered_features(touches)
    selected = [value for name, value in features.items() if not name.startswith(changed)]
    return torch.stack([value.to(touches.readings) for value in selected], dim=1).asinh()
