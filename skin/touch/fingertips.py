"""Fingertips: one to three discs that press a skin at known positions, still or sliding together."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Any, final

import numpy as np
import torch
from annotated_types import MinLen
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt
from torch import Tensor

from skin.body.base import AbstractBody
from skin.core.settings import RISING, checked
from skin.errors import InputError
from skin.touch.gestures import GestureSettings
from skin.touch.labels import CONTACT, TOUCH
from skin.touch.movie import AbstractContact, AbstractSampler, Movie, join_movies, measure_gestures
from skin.touch.paths import (
    Draws,
    TouchSettings,
    Trajectories,
    draw_motion,
    draw_times,
    draw_until_fit,
    sample_paths,
)
from skin.touch.shapes import half_extents, peak_per_newton


@checked("touch")
@dataclass(frozen=True)
class FingertipSettings(TouchSettings):
    """Ranges of fingertips; ``conf/touch/fingertips.yaml`` holds the same defaults and their units.

    Attributes:
        shapes: pictures of the pressure of a fingertip; each has any of them.
        contacts: fingertips at a time.
        radius: half the larger extent of the shape, m.
        force: the least of a fingertip, N; the logarithm of the force is uniform up to that at ``pressure``.
        pressure: the largest force of a fingertip by the area of a circle of its radius, Pa.
        apart: smallest distance between the outlines of two fingertips, m.

    Raises:
        InputError: as :class:`TouchSettings`, or the least force gives more than the largest pressure.
    """

    shapes: Annotated[tuple[str, ...], MinLen(1)] = ("disc",)
    contacts: Annotated[tuple[PositiveInt, PositiveInt], RISING] = (1, 3)
    radius: Annotated[tuple[PositiveFloat, PositiveFloat], RISING] = (0.004, 0.012)
    force: PositiveFloat = 0.5
    pressure: PositiveFloat = 130e3
    apart: NonNegativeFloat = 0.005

    def __post_init__(self) -> None:
        maximum = self.pressure * np.pi * self.radius[0] ** 2
        if self.force > maximum:
            raise InputError(
                f"touch.force={self.force:g} N is more than the {maximum:.3g} N that touch.pressure="
                f"{self.pressure:g} Pa gives a fingertip of the least touch.radius={self.radius[0]:g} m: "
                "lower touch.force, or raise touch.radius"
            )
        super().__post_init__()

    def sampler(
        self,
        body: AbstractBody,
        footprints: np.ndarray,
        contact: AbstractContact,
        padded: bool,
        moments: np.ndarray | None,
    ) -> "FingertipSampler":
        """Return what draws fingertips.

        Raises:
            InputError: a contact that solves for the pressure.
        """
        if not contact.proportional:
            raise InputError(
                "fingertips are softer than the skin and press as their picture: set contact=prescribed, or "
                "touch=gestures for rigid objects"
            )
        return FingertipSampler(body, footprints, contact, self, padded, moments)


_SPECIAL = {entry.name for entry in fields(FingertipSettings)} - {
    entry.name for entry in fields(GestureSettings)
}


def read_touch(settings: Mapping[str, Any] | TouchSettings | None) -> TouchSettings:
    """Return the settings of touches: fingertips where they have settings of fingertips, else gestures.

    Args:
        settings: the group ``touch`` of a configuration, which may lack settings, or the settings
            themselves; None: the gestures of the report.

    Raises:
        InputError: an invalid setting.
    """
    if isinstance(settings, TouchSettings):
        return settings
    fingertips = isinstance(settings, Mapping) and not _SPECIAL.isdisjoint(settings)
    return FingertipSettings.of(settings) if fingertips else GestureSettings.of(settings)


def draw_groups(
    count: int,
    settings: FingertipSettings,
    shapes: int,
    size: tuple[float, float],
    generator: np.random.Generator,
    tries: int = 1000,
) -> Draws:
    """Draw fingertips that leave ``spare`` along both axes of the sheet, and ``apart`` between them.

    Args:
        count: B.
        settings: ranges of the fingertips.
        shapes: number of shapes.
        size: extent (x, y) of the sheet, m.
        generator: source of randomness; it draws for all touches in every round.
        tries: largest number of rounds.

    Returns:
        number (B,) of fingertips, up to K; of each (B, K): index ``tips`` of its shape, radius (m), forces
        (N, at full force), offset (B, K, 2) (m, from the centre of the first fingertip to its own); low and
        high (B, 2) (m), bounding box of all around the centre of the first; misfits (B,), groups drawn before
        that had no room.

    Raises:
        InputError: the sheet has no room for them.
    """
    minimum, maximum = settings.contacts
    number = generator.integers(minimum, maximum, count, endpoint=True)
    shape = generator.integers(0, shapes, (count, maximum))
    small, large = settings.radius
    radius = small + (large - small) * generator.random((count, maximum))
    highest = settings.pressure * np.pi * radius**2
    force = settings.force * (highest / settings.force) ** generator.random((count, maximum))
    absent = np.arange(maximum) >= number[:, None]

    def draw(todo: np.ndarray) -> Draws:
        reach = radius[todo][..., None]
        centre = reach + generator.random((count, maximum, 2))[todo] * (np.array(size) - 2 * reach)
        hidden = absent[todo][..., None]
        low = np.where(hidden, np.inf, centre - reach).min(axis=1) - centre[:, 0]
        high = np.where(hidden, -np.inf, centre + reach).max(axis=1) - centre[:, 0]
        fits = (high - low + settings.spare <= size).all(axis=1)
        first, second = np.triu_indices(maximum, 1)
        near, far = radius[todo][:, first], radius[todo][:, second]
        distance = np.linalg.norm(centre[:, first] - centre[:, second], axis=2)
        missing = absent[todo][:, first] | absent[todo][:, second]
        fits &= (missing | (distance >= near + far + settings.apart)).all(axis=1)
        return {"offset": centre - centre[:, :1], "low": low, "high": high, "fits": fits}

    def refuse() -> InputError:
        return InputError(
            f"a sheet of {size[0]:g} x {size[1]:g} m has no room for {number.max()} fingertips of "
            f"touch.radius={list(settings.radius)} m with touch.spare={settings.spare:g} m: lower "
            "touch.contacts, touch.radius, touch.apart or touch.spare"
        )

    placed = draw_until_fit(count, draw, refuse, tries)
    return placed | {"number": number, "tips": shape, "radius": radius, "forces": force}


@final
class FingertipSampler(AbstractSampler):
    """Draws fingertips with wanted labels ``dynamic`` and ``press``, and renders their movies.

    All fingertips of a touch rise and fall together and slide along the same path, each with its own force.
    The other labels are what the movie gives: a touch is hardly ever big or dangerous.

    Args:
        body, footprints, contact, padded, moments: as of :class:`skin.touch.movie.AbstractSampler`.
        settings: ranges of the fingertips.

    Raises:
        InputError: settings or pictures that cannot be used.
    """

    settings: FingertipSettings

    @property
    def kinds(self) -> Sequence[int]:
        """Neither dynamic nor press, one of them, or both."""
        return 0b000, 0b010, 0b100, 0b110

    @torch.no_grad()
    def sample(self, count: int, generator: np.random.Generator, labels: np.ndarray | None = None) -> Movie:
        """Return the movies of ``count`` touches.

        Args:
            count: B.
            generator: source of randomness; it draws for all touches in every round.
            labels: (B, 4), bool, the wanted combinations of ``dynamic`` and ``press``; None: balanced.

        Raises:
            InputError: other labels are wanted, or the sheet has no room.
        """
        wanted = self.balanced(count, generator) if labels is None else np.asarray(labels, bool)
        drawn = [TOUCH.names.index(name) for name in self.chosen]
        if refused := [
            name
            for name, column in zip(TOUCH.names, wanted.T, strict=True)
            if column.any() and name not in self.chosen
        ]:
            raise InputError(
                f"fingertips cannot be drawn to be {' or '.join(refused)}, only dynamic, press or neither: "
                "set touch=gestures"
            )
        pending, movies, finished = np.arange(count), list[Movie](), list[np.ndarray]()
        for attempt in range(1, self.settings.redraws + 1):
            movie = self._draw(wanted, generator, pending, attempt)
            right = (movie.labels[:, drawn].numpy() == wanted[pending][:, drawn]).all(axis=1)
            right &= (movie.parameters["force"] <= self.settings.danger.human_force).numpy()
            movies.append(movie[torch.from_numpy(np.flatnonzero(right))])
            finished.append(pending[right])
            pending = pending[~right]
            if not len(pending):
                return join_movies(movies)[torch.from_numpy(np.concatenate(finished).argsort())]
        raise InputError(
            f"no touch of fingertips in {self.settings.redraws} draws was "
            + ", ".join(f"{'' if wanted[pending[0], n] else 'not '}{TOUCH.names[n]}" for n in drawn)
            + ": touch.thresholds and the ranges under touch rule it out"
        )

    def _draw(
        self, wanted: np.ndarray, generator: np.random.Generator, rows: np.ndarray, attempt: int
    ) -> Movie:
        """Draw all touches and return the movie of some rows, (b,)."""
        settings, size, count = self.settings, self.body.size, len(wanted)
        drawn = draw_groups(count, settings, len(self.shapes.names), size, generator) | {
            "angle": np.zeros(count),
            "stretch": np.ones(count),
            "peak": np.zeros(count),  # of sample_paths, which only passes it on
            "draws": np.full(count, float(attempt)),
        }
        drawn |= {"shape": drawn["tips"][:, 0], "scale": drawn["radius"][:, 0]}
        drawn |= draw_times(wanted, settings, self.padded, generator)
        random = generator.random((count, 4))
        drawn |= draw_motion(wanted.T[TOUCH.names.index("dynamic")], drawn, settings, size, random)
        return self._render({name: values[rows] for name, values in drawn.items()}, wanted[rows])

    def _render(self, drawn: Draws, wanted: np.ndarray) -> Movie:
        """Return the movie of drawn touches (B,) with its labels."""
        settings = self.settings
        paths = sample_paths(drawn, wanted, settings, proportional=True)
        index, profile = paths.index, paths.profile
        frames, highest, area = self._pressure(paths, drawn)
        weights = self.footprints if self.moments is None else self.moments
        measures = measure_gestures(
            frames, index, profile, weights, self.body.cell, settings.thresholds.contact, area
        )
        present = np.arange(drawn["radius"].shape[1]) < drawn["number"][:, None]
        full = {
            "peak": (highest[index] * profile).amax(1).double().numpy(),
            "force": (drawn["forces"] * present).sum(axis=1),
        }
        pressures = drawn["forces"] * peak_per_newton(self.shapes, drawn["tips"], drawn["radius"])
        contacts = _contacts(paths, drawn, pressures, present)
        movie = self._movie(frames, drawn | full, paths, measures, contacts)
        movie.parameters["contacts"] = torch.from_numpy(drawn["number"]).float()
        return movie

    def _pressure(self, paths: Trajectories, drawn: Draws) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return what all fingertips press at full force.

        Returns:
            The sum of their pressures, (U, H, W), Pa, the highest one, (U,), Pa, and the fraction of the
            sheet in contact, (U,), or None where cells are counted.
        """
        owner, position = paths.owner, paths.poses.position
        shape, scale = drawn["tips"], drawn["radius"] / half_extents(self.shapes)[drawn["tips"]]
        frames = torch.zeros(len(owner), *self.body.shape)
        highest, areas = torch.zeros(2, len(owner))
        for k in range(scale.shape[1]):
            rows = np.flatnonzero(drawn["number"][owner] > k)
            # Sorted by scale, because frames of one texture level are rendered together.
            rows = rows[np.argsort(scale[owner[rows], k], kind="stable")]
            mine, todo = owner[rows], torch.from_numpy(rows)
            centres = position[rows] + drawn["offset"][mine, k]
            pose = shape[mine, k], np.zeros(len(rows)), scale[mine, k], centres
            full = torch.from_numpy(drawn["forces"][mine, k] / float(np.prod(self.body.cell))).float()
            if self.shapes.fine:
                spread, peak, area = self.shapes.press(*pose)
                areas[todo] += torch.from_numpy(area).float()
                highest[todo] = torch.maximum(highest[todo], full * peak)
            else:
                spread = self.shapes.render(*pose)
            frames[todo] += spread * full[:, None, None]
        if self.shapes.fine:
            return frames, highest, areas
        return frames, frames.flatten(1).amax(1), None


def _contacts(paths: Trajectories, drawn: Draws, highest: np.ndarray, present: np.ndarray) -> Tensor:
    """Return the contacts at each time, (B, T, K, 5), float32, columns :data:`CONTACT`; NaN without contact.

    Args:
        paths: of the touches.
        drawn: their fingertips.
        highest: (B, K), highest pressure at full force, Pa.
        present: (B, K), bool.
    """
    profile = paths.profile.double().numpy()[..., None]
    positions = paths.poses.position[paths.index.numpy()]
    centre = positions[:, :, None] + drawn["offset"][:, None]
    values = np.empty((*centre.shape[:3], len(CONTACT)))
    values[..., :2], values[..., 2] = centre, drawn["radius"][:, None]
    values[..., 3], values[..., 4] = drawn["forces"][:, None] * profile, highest[:, None] * profile
    values[~present[:, None] | (profile == 0)] = np.nan
    return torch.from_numpy(values).float()
