"""The gestures of the report: one object of any shape and size that presses, still or sliding.

This is the option ``touch=gestures``: its settings, the draws of bodies that fit on the sheet, and the
sampler, which redraws gestures until they have the wanted labels.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, NamedTuple, final

import numpy as np
import torch
from annotated_types import Ge, Le, MinLen

from skin.body.base import AbstractBody
from skin.core.settings import checked
from skin.errors import InputError
from skin.touch.labels import TOUCH
from skin.touch.movie import (
    AbstractContact,
    AbstractSampler,
    ContactProblem,
    ContactResult,
    Movie,
    add_second,
    join_movies,
    measure_gestures,
)
from skin.touch.paths import (
    Above0,
    Draws,
    From0,
    TouchSettings,
    draw_motion,
    draw_times,
    draw_until_fit,
    sample_paths,
)
from skin.touch.shapes import Shapes, cell_moments


@checked("touch")
@dataclass(frozen=True)
class GestureSettings(TouchSettings):
    """Ranges of the report's gestures; ``conf/touch/gestures.yaml`` holds the same defaults and their units.

    Attributes:
        second: fraction of touches with a second gesture at the same time
            (:func:`skin.touch.movie.add_second`).

    Raises:
        InputError: as :class:`TouchSettings`, or two gestures at a time that slide with friction.
    """

    shapes: Annotated[tuple[str, ...], MinLen(1)] = (
        "disc",
        "blurred_disc",
        "square",
        "bar",
        "fist",
        "hand",
        "fingertip",
    )
    small_area: From0 = (0.01, 0.30)
    big_area: From0 = (0.30, 0.70)
    safe_peak: Above0 = (10e3, 90.5e3)
    dangerous_peak: Above0 = (90.5e3, 180e3)
    stretch: Annotated[float, Ge(1)] = 4.0
    leak: Annotated[float, Ge(0.5), Le(1)] = 0.6
    second: Annotated[float, Ge(0), Le(1)] = 0.0

    def __post_init__(self) -> None:
        if self.second and self.shear:
            raise InputError(
                "two gestures at a time have no common direction of friction: set touch.second=0 or "
                "touch.shear=0"
            )
        if self.second and np.isfinite([self.danger.force, self.danger.tap_force]).any():
            raise InputError(
                "two gestures at a time may exceed a limit of force together, which their labels ignore: set "
                "touch.second=0 (of device.training_touch, too), or leave the forces out of limits"
            )
        # A range beyond its threshold would be redrawn forever: (lowest, highest allowed).
        allowed = {
            "small_area": (0, self.thresholds.area),
            "big_area": (self.thresholds.area, 1),
            "safe_peak": (0, self.thresholds.pressure),
            "dangerous_peak": (self.thresholds.pressure, np.inf),
        }
        for name, (low, high) in allowed.items():
            limits = getattr(self, name)
            if limits[0] < low or limits[1] > high:
                raise InputError(
                    f"touch.{name}={list(limits)} must lie between {low:g} and {high:g}: "
                    "touch.thresholds decides"
                )
        super().__post_init__()

    def sampler(
        self,
        body: AbstractBody,
        footprints: np.ndarray,
        contact: AbstractContact,
        padded: bool,
        moments: np.ndarray | None,
    ) -> "TouchSampler":
        """Return what draws gestures.

        Raises:
            InputError: two gestures at a time with a contact that solves for the pressure.
        """
        if self.second and not contact.proportional:
            raise InputError(
                "the pressures of two gestures at a time add up only with contact=prescribed: set that, or "
                "touch.second=0"
            )
        return TouchSampler(body, footprints, contact, self, padded, moments)


# Bodies that fit on the sheet.


class Fit(NamedTuple):
    """Which shapes fit on a sheet.

    Attributes:
        big: (N,), bool, shapes that fit with a big area.
        small: (N,), bool, shapes that fit with a small area.
    """

    big: np.ndarray
    small: np.ndarray

    @classmethod
    def of(
        cls, settings: GestureSettings, shapes: Shapes, probes: int = 500, rare: float = 0.01
    ) -> "Fit | None":
        """Return the fit of shapes, or None where they are redrawn until they fit.

        They are redrawn, as in the report, unless the shape alone would then predict the label ``big`` with a
        balanced accuracy above ``settings.leak``. Deterministic.

        Args:
            settings: ranges of the gestures.
            shapes: the shapes and the sheet.
            probes: bodies drawn of each shape.
            rare: fraction of probes below which a shape does not fit.

        Raises:
            InputError: no shape fits.
        """
        count = len(shapes.names)
        random = np.random.default_rng(0).random((2, probes, 4)).repeat(count, axis=0)
        big, shape = np.repeat([False, True], count * probes), np.tile(np.repeat(np.arange(count), probes), 2)

        def fitting(fitted: bool) -> np.ndarray:
            """Return the fraction of small and big bodies of each shape that fit, (2, N)."""
            drawn = _draw_whole(big, settings, shapes, random.reshape(-1, 4), shape, big if fitted else None)
            return drawn["fits"].reshape(2, count, probes).mean(axis=2)

        redrawn = fitting(False)
        totals = redrawn.sum(axis=1, keepdims=True)
        if totals.all() and (redrawn / totals).max(axis=0).sum() / 2 <= settings.leak:
            return None
        small, big = fitting(True) >= rare
        if not big.any():
            raise _explain_no_room(settings, shapes.body.size)
        return cls(big, small | big)

    def draw(self, big: np.ndarray, generator: np.random.Generator) -> np.ndarray:
        """Draw a shape (B,) per body, uniformly among those that fit with its area, big (B,) or small."""
        random = generator.random(len(big))
        options = [np.flatnonzero(which) for which in (self.small, self.big)]
        small, large = (numbers[(random * len(numbers)).astype(int)] for numbers in options)
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

    They leave it for static and sliding touches alike: every shape can slide, and only the path distinguishes
    sliding from static touches.

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

    def draw(todo: np.ndarray) -> Draws:
        random = generator.random((len(big), 3 if fit is None else 4))[todo]
        drawn = (random[:, 0] * len(shapes.names)).astype(int) if kept is None else kept[todo]
        asked = None if fit is None or kept is None else fit.big[drawn]
        return _draw_whole(big[todo], settings, shapes, random, drawn, asked)

    return draw_until_fit(len(big), draw, lambda: _explain_no_room(settings, shapes.body.size))


def _draw_whole(
    big: np.ndarray,
    settings: GestureSettings,
    shapes: Shapes,
    random: np.ndarray,
    shape: np.ndarray,
    asked_big: np.ndarray | None,
    rounding: float = 1e-9,
) -> Draws:
    """Draw angle and size of shapes (B,), from numbers (B, 4), and whether they fit.

    They are stretched to fit with the size of ``asked_big``; None: they are not stretched.
    """
    angle, stretch = 2 * np.pi * random[:, 1], np.ones(len(big))
    if asked_big is None:
        scale = shapes.scale(shape, _between(big, settings.big_area, settings.small_area, random[:, 2]))
        low, high = shapes.extent(shape, angle, scale)
        fits = (high - low + settings.spare <= shapes.body.size).all(axis=1)
    else:
        sizes = settings.big_area, settings.small_area
        asked = shapes.whole_scale(shape, _between(asked_big, *sizes, random[:, 2]))
        low, high = shapes.extent(shape, angle, asked)
        x, y = ((high - low) / np.maximum(np.array(shapes.body.size) - settings.spare, rounding)).T
        # The stretch nearest to 1 at which both sides have room.
        stretch = np.clip(1, y**2, np.maximum(x**-2, y**2))
        fits = (x * y <= 1 + rounding) & (np.maximum(stretch, 1 / stretch) <= settings.stretch)
        own = shapes.whole_scale(shape, _between(big, *sizes, random[:, 3]))
        scale = np.where(big == asked_big, asked, own)
        low, high = shapes.extent(shape, angle, scale, stretch)
    return {
        "shape": shape, "angle": angle, "stretch": stretch, "scale": scale,
        "low": low, "high": high, "fits": fits,
    }  # fmt: skip


def _between(
    holds: np.ndarray, yes: tuple[float, float], no: tuple[float, float], random: np.ndarray
) -> np.ndarray:
    """Return numbers (B,) within one range where a label holds, and within another where it does not."""
    minimum, maximum = np.where(holds[:, None], yes, no).T
    return minimum + (maximum - minimum) * random


def _explain_no_room(settings: GestureSettings, size: tuple[float, float]) -> InputError:
    minimum, maximum = settings.big_area
    return InputError(
        f"none of touch.shapes={list(settings.shapes)} covers {minimum:g} to {maximum:g} of a sheet of "
        f"{size[0]:g} x {size[1]:g} m and leaves touch.spare={settings.spare:g} m along x and y, even turned "
        f"and stretched by up to touch.stretch={settings.stretch:g}: lower touch.spare or touch.big_area, "
        "raise touch.stretch, or add a compact shape such as disc"
    )


def draw_paths(
    labels: np.ndarray,
    gestures: Draws,
    settings: GestureSettings,
    size: tuple[float, float],
    random: np.ndarray,
) -> Draws:
    """Draw the path and the peak pressure of gestures.

    Args:
        labels: (B, 4), bool, the wanted combinations.
        gestures: the draws of :func:`draw_bodies` and :func:`skin.touch.paths.draw_times`, (B, ...).
        settings: ranges of the gestures.
        size: extent (x, y) of the sheet, m.
        random: (B, 5), 0 to 1.

    Returns:
        The result of :func:`skin.touch.paths.draw_motion`, and peak (Pa).
    """
    _, dynamic, _, dangerous = labels.T
    peak = _between(dangerous, settings.dangerous_peak, settings.safe_peak, random[:, 4])
    return draw_motion(dynamic, gestures, settings, size, random[:, :4]) | {"peak": peak}


@final
class TouchSampler(AbstractSampler):
    """Draws gestures with wanted labels and renders their movies.

    Labels are computed from the movie (docs/adr/0005 for rigid objects that slide). Where they differ from
    the wanted ones, the path is drawn again (start, direction, speed, peak), up to ``redraws`` times, and
    then the whole gesture.

    Args:
        body, footprints, contact, padded, moments: as in :class:`skin.touch.movie.AbstractSampler`.
        settings: ranges of the gestures, as in ``conf/touch/gestures.yaml``.

    Attributes:
        attempts: whole gestures drawn before the labels are refused as impossible.
        attempts_with_same_shape: for how many of them a fitted shape is kept; then any other may replace it.
        paths_at_once: paths of the last few gestures, because a round has a fixed cost.

    Raises:
        InputError: settings or pictures that cannot be used.
    """

    settings: GestureSettings
    attempts, attempts_with_same_shape, paths_at_once = 50, 25, 64

    @cached_property
    def fit(self) -> Fit | None:
        """The fit of shapes to the sheet; None where shapes are redrawn until they fit."""
        return Fit.of(self.settings, self.shapes)

    @cached_property
    def kinds(self) -> Sequence[int]:
        """All combinations of labels; small in place of big where dangerous takes more than a person.

        Of 64 big bodies with 8 paths each, a tenth must be dangerous within ``limits.human_force``.
        """
        kinds, generator = np.arange(2 ** len(TOUCH)), np.random.default_rng(0)
        if self.settings.danger.human_force == np.inf:
            return kinds.tolist()
        heavy = kinds[kinds & 0b1001 == 0b1001]  # big and dangerous
        wanted = np.repeat(heavy, 16)[:, None] >> np.arange(len(TOUCH)) & 1 > 0
        fitted = self.fit and self.fit.draw(wanted[:, 0], generator)
        drawn = draw_bodies(wanted[:, 0], self.settings, self.shapes, generator, self.fit, fitted)
        drawn |= draw_times(wanted, self.settings, self.padded, generator)
        random, counts = generator.random((8, len(wanted), 5)), np.zeros((2, len(wanted)))
        able = self._round(np.arange(len(wanted)), wanted, drawn, random, *counts)[0]
        left_out = heavy[able.reshape(len(heavy), -1).mean(axis=1) < 0.1]
        if len(left_out):
            names = sorted({("tap", "press")[kind >> 2 & 1] for kind in left_out})
            warnings.warn(
                f"a big dangerous {' or '.join(names)} takes more than limits.human_force here: it is left "
                "out, and small ones are drawn in its place",
                UserWarning,
                stacklevel=3,
            )
        return np.where(np.isin(kinds, left_out), kinds - 1, kinds).tolist()

    @torch.no_grad()
    def sample(self, count: int, generator: np.random.Generator, labels: np.ndarray | None = None) -> Movie:
        """Return the movies of ``count`` gestures; see :meth:`AbstractSampler.sample`."""
        wanted = self.balanced(count, generator) if labels is None else labels
        settings, pending = self.settings, np.arange(count)
        draws, misfits, unconverged = np.zeros((3, count))
        fitted = self.fit and self.fit.draw(wanted[:, 0], generator)
        finished, movies = list[np.ndarray](), list[Movie]()
        while len(pending) and draws[pending].min() < self.attempts * settings.redraws:
            if self.fit and draws[pending].min() >= self.attempts_with_same_shape * settings.redraws:
                fitted = self.fit.draw(wanted[:, 0], generator)
            gestures = draw_bodies(wanted[:, 0], settings, self.shapes, generator, self.fit, fitted)
            gestures |= draw_times(wanted, settings, self.padded, generator)
            misfits[pending] += gestures["misfits"][pending]
            gestures["misfits"] = misfits
            tried, hopeless = 0, list[np.ndarray]()
            while tried < settings.redraws and len(pending):
                ahead = min(settings.redraws - tried, max(1, self.paths_at_once // len(pending)))
                # Drawn for the whole batch, so that redrawing one gesture does not change another.
                random = generator.random((ahead, count, 5))
                # Sorted by scale, because frames of one texture level are rendered together.
                pending = pending[np.argsort(gestures["scale"][pending], kind="stable")]
                tried += ahead
                chosen, given_up, movie = self._round(pending, wanted, gestures, random, draws, unconverged)
                movies.append(movie)
                finished.append(pending[chosen])
                hopeless.append(pending[given_up])
                pending = pending[~chosen & ~given_up]
            pending = np.concatenate([pending, *hopeless])
        if unconverged.any():
            warnings.warn(
                f"{int(unconverged.sum())} frames did not converge to contact.tolerance within "
                "contact.iterations; their gestures were drawn again: raise contact.iterations or "
                "contact.tolerance",
                RuntimeWarning,
                stacklevel=2,
            )
        if len(pending):
            raise self._explain_impossible(wanted[pending[0]])
        movie = join_movies(movies)[torch.from_numpy(np.concatenate(finished).argsort())]
        second = settings.second, settings.thresholds.contact
        return add_second(movie, *second, generator) if settings.second else movie

    def _round(
        self,
        pending: np.ndarray,
        wanted: np.ndarray,
        gestures: Draws,
        random: np.ndarray,
        draws: np.ndarray,
        unconverged: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, Movie]:
        """Try one path per row of ``random`` (A, B, 5) for each pending gesture.

        The counts of each gesture, (B,), are updated: its drawn paths, and its frames that did not converge.

        Returns:
            Which of the pending gestures have a path with the wanted labels, bool, which cannot have one,
            bool, and the movie of those paths.
        """
        ahead = len(random)
        rows, turns = np.repeat(pending, ahead), np.tile(np.arange(ahead), len(pending))
        drawn = {name: values[rows] for name, values in gestures.items()}
        drawn |= draw_paths(wanted[rows], drawn, self.settings, self.body.size, random[turns, rows])
        movie, pressed = self._press(drawn | {"draws": draws[rows] + turns + 1}, wanted[rows])
        right = (
            (movie.labels[:, : len(TOUCH)].numpy() == wanted[rows]).all(axis=1) & ~pressed.refused
        ).reshape(-1, ahead)
        chosen = right.any(axis=1)
        first = np.arange(len(pending)) * ahead + right.argmax(axis=1)
        draws[pending] += ahead
        if pressed.unconverged is not None:
            unconverged[pending] += pressed.unconverged.reshape(-1, ahead).sum(axis=1)
            movie.parameters["unconverged"] = torch.from_numpy(unconverged[rows]).float()
        given_up = pressed.hopeless.reshape(-1, ahead).any(axis=1) & ~chosen
        return chosen, given_up, movie[torch.from_numpy(first[chosen])]

    def _press(self, gestures: Draws, wanted: np.ndarray) -> tuple[Movie, ContactResult]:
        """Return the movie of gestures (B,) with its labels."""
        paths = sample_paths(gestures, wanted, self.settings, self.contact.proportional)
        pressed = self.contact.press(paths, ContactProblem(self.shapes, self.footprints, self.settings))
        index, profile, frames = paths.index, paths.profile, pressed.frames
        area = None if pressed.area is None else torch.from_numpy(pressed.area).float()
        weights = self.footprints if area is None or self.moments is None else self.moments
        measures = measure_gestures(
            frames, index, profile, weights, self.body.cell, self.settings.thresholds.contact, area
        )
        if self.moments is not None and area is None:
            down, across = (torch.from_numpy(cell_moments(count)).float() for count in self.body.shape)
            frames = down @ frames @ across.T
        if not self.contact.proportional:
            # The contact area grows with force, which moves the centre of pressure of a static touch.
            measures = measures._replace(travel=torch.from_numpy(paths.travel))
        drawn = gestures | {"peak": pressed.peak, "force": pressed.force}
        return self._movie(frames, drawn, paths, measures), pressed

    def _explain_impossible(self, labels: np.ndarray) -> InputError:
        return InputError(
            f"no gesture in {self.attempts * self.settings.redraws} draws was "
            + ", ".join(name if on else f"not {name}" for name, on in zip(TOUCH.names, labels, strict=True))
            + ": on this sheet, with these sensors, touch or limits rule it out; sensors far apart have "
            "small readings under a small dangerous touch: raise touch.small_area or touch.dangerous_peak, "
            "or add sensors"
            f"{self.contact.advice}"
        )
