"""Random gestures with given labels: draws, their contact, and the movies of those that have the labels."""

import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, final

import numpy as np
import torch
from torch import Tensor

from skin.body.base import AbstractBody
from skin.errors import InputError
from skin.touch import splines
from skin.touch.gesture import (
    Draws,
    GestureSettings,
    SampledPaths,
    TouchSettings,
    Trajectories,
    draw_gestures,
    draw_paths,
    heading,
    sample_paths,
)
from skin.touch.labels import TOUCH
from skin.touch.movie import Measures, Movie, join_movies, measure_gestures
from skin.touch.pairs import add_second
from skin.touch.shapes import Fit, Shapes

_ATTEMPTS = 50
_AHEAD = 64
# For how many of these attempts a fitted shape is kept; then any other may take its place.
_LOYAL = 25
_DRAWN = ("shape", "angle", "stretch", "misfits", "duration", "onset", "direction", "speed")
_FOUND = ("peak", "force", "draws", "net_x", "net_y", "x", "y")


class ContactProblem(NamedTuple):
    """The touched body and the criteria for labels.

    Attributes:
        shapes: the shapes and the body.
        footprints: (S, H * W), area weights of each sensor that sum to 1, float32.
        settings: ranges of the gestures, and the thresholds of the labels.
    """

    shapes: Shapes
    footprints: Tensor
    settings: GestureSettings


class ContactResult(NamedTuple):
    """The pressure of trajectories.

    Attributes:
        frames: (U, H, W), Pa, float32, each divided by its share of full force, so that all frames of a
            gesture have the same total force.
        force: (B,), full force, N.
        peak: (B,), peak cell pressure of the gesture, Pa.
        refused: (B,), bool, gestures whose frames are not valid, because no force gives the wanted labels or
            the contact did not converge.
        hopeless: (B,), bool, the refused gestures for which no other path can succeed.
        unconverged: (B,), number of frames that did not converge to the tolerance; None where all are exact.
        area: (U,), share of the sheet in contact, where the frames are moments of the pressure
            (:mod:`skin.touch.splines`); None: frames are mean pressures of cells.
    """

    frames: Tensor
    force: np.ndarray
    peak: np.ndarray
    refused: np.ndarray
    hopeless: np.ndarray
    unconverged: np.ndarray | None = None
    area: np.ndarray | None = None


class AbstractContact(ABC):
    """Computes the pressure of objects on the cells of the skin.

    Attributes:
        proportional: whether pressure is proportional to force. A static touch is then one frame for any time
            profile, and the centre of pressure moves with the object.
        advice: end of the error message where the wanted labels do not occur.
    """

    proportional: ClassVar[bool]
    advice: ClassVar[str] = ""

    @abstractmethod
    def press(self, trajectories: Trajectories, problem: ContactProblem) -> ContactResult:
        """Return the pressure of gestures at a force that gives the wanted labels, if there is one."""


def balanced(count: int, generator: np.random.Generator, chosen: Sequence[str] = TOUCH.names) -> np.ndarray:
    """Return label combinations (count, 4), bool: those of the chosen labels, balanced; others are false.

    They are equally frequent, to within one, in random order.
    """
    kinds = 2 ** len(chosen)
    codes = generator.permutation(generator.permutation(kinds)[np.arange(count) % kinds])
    labels = np.zeros((count, len(TOUCH)), dtype=bool)
    labels[:, [TOUCH.names.index(name) for name in chosen]] = codes[:, None] >> np.arange(len(chosen)) & 1
    return labels


def describe_touches(
    drawn: Draws, paths: SampledPaths, values: tuple[np.ndarray, np.ndarray, np.ndarray], measures: Measures
) -> dict[str, Tensor]:
    """Return the parameters of a movie, (B,) each.

    Args:
        drawn: of the touches, (B, ...).
        paths: of the touches.
        values: (B,) each, peak (Pa), force (N) and number of paths drawn.
        measures: of the movie.
    """
    begin = paths.trajectories.place[paths.first]
    parameters = {name: drawn[name] for name in _DRAWN}
    parameters |= zip(_FOUND, (*values, *paths.net.T, *begin.T), strict=True)
    floats = {name: torch.from_numpy(value).float() for name, value in parameters.items()}
    return floats | {name: value.float() for name, value in measures._asdict().items()}


def steer(paths: SampledPaths, shear: float) -> Tensor | None:
    """Return the tangential traction by pressure of each frame, (U, 2); None without friction."""
    return torch.from_numpy(shear * heading(paths.place, paths.first)).float() if shear else None


def _warn_of_unconverged(count: int) -> None:
    """Warn of frames that did not converge, if there are any."""
    if count:
        warnings.warn(
            f"{count} frames did not converge to contact.tolerance within contact.iterations; their "
            "gestures were drawn again: raise contact.iterations or contact.tolerance",
            RuntimeWarning,
            stacklevel=3,
        )


class AbstractSampler(ABC):
    """Draws touches of a kind and renders their movies.

    Args:
        body: the sheet.
        footprints: (S, H * W), area weights of each sensor that sum to 1 (``AbstractBody.footprints``).
        contact: computes the pressure of touches.
        settings: of the touches.
        padded: whether touches begin at a random frame of the window instead of its first.
        moments: (S, H * W), weights of moments of the pressure in place of ``footprints``
            (:func:`skin.touch.splines.footprints`). The frames of movies are then moments. None: they are
            mean pressures of cells.

    Attributes:
        chosen: the labels that touches can be drawn for, names of ``TOUCH``; the others are what they are.
        leak: see :func:`skin.device.balance.check_label_leakage`.

    Raises:
        InputError: settings or pictures that cannot be used.
    """

    chosen: tuple[str, ...] = TOUCH.names
    leak: float = 1.0

    def __init__(
        self,
        body: AbstractBody,
        footprints: np.ndarray,
        contact: AbstractContact,
        settings: TouchSettings,
        padded: bool = True,
        moments: np.ndarray | None = None,
    ) -> None:
        self.body, self.contact, self.padded = body, contact, padded
        self.settings = settings
        self.footprints = torch.as_tensor(footprints, dtype=torch.float32)
        self.moments = None if moments is None else torch.as_tensor(moments, dtype=torch.float32)
        self.shapes = Shapes(settings.shapes, body, settings.thresholds.contact, moments is not None)

    def balanced(self, count: int, generator: np.random.Generator) -> np.ndarray:
        """Return label combinations (count, 4), bool, that can be drawn, balanced, in random order."""
        return balanced(count, generator, self.chosen)

    @abstractmethod
    def sample(self, count: int, generator: np.random.Generator, labels: np.ndarray | None = None) -> Movie:
        """Return the movies of ``count`` touches.

        Args:
            count: B.
            generator: source of randomness.
            labels: (B, 4), bool, the wanted combinations; None: balanced.

        Raises:
            InputError: a combination of labels that does not occur on this sheet with these settings.
        """


@final
class TouchSampler(AbstractSampler):
    """Draws gestures with wanted labels and renders their movies.

    Labels are computed from the movie (docs/adr/0005 for rigid objects that slide). Where they differ from
    the wanted ones, the path is drawn again (start, direction, speed, peak), up to ``redraws`` times, and
    then the whole gesture.

    Args:
        body, footprints, contact, padded: as of :class:`AbstractSampler`.
        settings: ranges of the gestures, as in ``conf/touch/gestures.yaml``.

    Raises:
        InputError: settings or pictures that cannot be used.
    """

    settings: GestureSettings

    def __init__(
        self,
        body: AbstractBody,
        footprints: np.ndarray,
        contact: AbstractContact,
        settings: Mapping[str, Any] | GestureSettings | None = None,
        padded: bool = True,
        moments: np.ndarray | None = None,
    ) -> None:
        super().__init__(body, footprints, contact, GestureSettings.of(settings), padded, moments)
        self.leak = self.settings.leak
        if self.settings.second and not contact.proportional:
            raise InputError(
                "the pressures of two gestures at a time add up only with contact=prescribed: set that, or "
                "touch.second=0"
            )

    @cached_property
    def fit(self) -> Fit | None:
        """The fit of shapes to the sheet; None where shapes are redrawn until they fit."""
        return Fit.of(self.settings, self.shapes)

    @torch.no_grad()
    def sample(self, count: int, generator: np.random.Generator, labels: np.ndarray | None = None) -> Movie:
        """Return the movies of ``count`` gestures; see :meth:`AbstractSampler.sample`."""
        targets = balanced(count, generator) if labels is None else labels
        redraws = self.settings.redraws
        pending = np.arange(count)
        draws, misfits, unconverged = np.zeros((3, count))
        fitted = self.fit and self.fit.draw(targets[:, 0], generator)
        finished: list[np.ndarray] = []
        movies: list[Movie] = []
        while len(pending):
            if draws[pending].min() >= _ATTEMPTS * redraws:
                _warn_of_unconverged(int(unconverged.sum()))
                raise self._explain_impossible(targets[pending[0]])
            if self.fit and draws[pending].min() >= _LOYAL * redraws:
                fitted = self.fit.draw(targets[:, 0], generator)
            gestures = draw_gestures(
                targets, self.settings, self.shapes, self.padded, generator, self.fit, fitted
            )
            misfits[pending] += gestures["misfits"][pending]
            gestures["misfits"] = misfits
            tried, hopeless = 0, []
            while tried < redraws and len(pending):
                # The last few gestures try several paths at once, because a round has a fixed cost.
                ahead = min(redraws - tried, max(1, _AHEAD // len(pending)))
                # Drawn for the whole batch, so that redrawing one gesture does not change another.
                chance = generator.random((ahead, count, 5))
                # Sorted by scale, because frames of one texture level are rendered together.
                pending = pending[np.argsort(gestures["scale"][pending], kind="stable")]
                tried += ahead
                chosen, given_up, movie = self._round(pending, targets, gestures, chance, draws, unconverged)
                movies.append(movie)
                finished.append(pending[chosen])
                hopeless.append(pending[given_up])
                pending = pending[~chosen & ~given_up]
            pending = np.concatenate([pending, *hopeless])
        _warn_of_unconverged(int(unconverged.sum()))
        movie = join_movies(movies)[torch.from_numpy(np.concatenate(finished).argsort())]
        share, contact = self.settings.second, self.settings.thresholds.contact
        return add_second(movie, share, contact, generator) if share else movie

    def _round(
        self,
        pending: np.ndarray,
        wanted: np.ndarray,
        gestures: Draws,
        chance: np.ndarray,
        draws: np.ndarray,
        unconverged: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, Movie]:
        """Try one path per row of ``chance`` (A, B, 5) for each pending gesture.

        The counts of each gesture, (B,), are updated: its drawn paths, and its frames that did not converge.

        Returns:
            Which of the pending gestures have a path with the wanted labels, bool, which cannot have one,
            bool, and the movie of those paths.
        """
        ahead = len(chance)
        rows = np.repeat(pending, ahead)
        turns = np.tile(np.arange(ahead), len(pending))
        body = {name: values[rows] for name, values in gestures.items()}
        path = draw_paths(wanted[rows], body, self.settings, self.body.size, chance[turns, rows])
        drawn = draws[rows] + turns + 1
        movie, pressed = self._press(body | path | {"draws": drawn}, wanted[rows])
        right = ((movie.labels.numpy() == wanted[rows]).all(axis=1) & ~pressed.refused).reshape(-1, ahead)
        chosen = right.any(axis=1)
        first = np.arange(len(pending)) * ahead + right.argmax(axis=1)
        draws[pending] += ahead
        if pressed.unconverged is not None:
            unconverged[pending] += pressed.unconverged.reshape(-1, ahead).sum(axis=1)
            movie.parameters["unconverged"] = torch.from_numpy(unconverged[rows]).float()
        given_up = pressed.hopeless.reshape(-1, ahead).any(axis=1) & ~chosen
        return chosen, given_up, movie[torch.from_numpy(first[chosen])]

    @torch.no_grad()
    def render(self, gestures: Draws, wanted: np.ndarray) -> Movie:
        """Return the movie of drawn gestures with the labels that it has, which may not be the wanted ones.

        Args:
            gestures: the draws of ``draw_gestures`` and ``draw_paths``, (B, ...), faster if sorted by scale.
            wanted: (B, 4), bool, the labels they were drawn for.
        """
        return self._press(gestures | {"draws": np.ones(len(wanted))}, wanted)[0]

    def _press(self, gestures: Draws, wanted: np.ndarray) -> tuple[Movie, ContactResult]:
        """Return the movie of gestures (B,) with its labels."""
        settings = self.settings
        paths = sample_paths(gestures, wanted, settings, self.contact.proportional)
        pressed = self.contact.press(
            paths.trajectories, ContactProblem(self.shapes, self.footprints, settings)
        )
        index, shares = paths.trajectories.index, paths.trajectories.profile
        area = None if pressed.area is None else torch.from_numpy(pressed.area).float()
        weights = self.footprints if area is None or self.moments is None else self.moments
        measures = measure_gestures(
            pressed.frames, index, shares, weights, self.body.cell, settings.thresholds.contact, area
        )
        frames = pressed.frames
        if self.moments is not None and area is None:
            down, across = (torch.from_numpy(splines.of_cells(count)).float() for count in self.body.shape)
            frames = down @ frames @ across.T
        if not self.contact.proportional:
            # The contact area grows with force, which moves the centre of pressure of a static touch.
            measures = measures._replace(travel=torch.from_numpy(paths.travel))
        values = pressed.peak, pressed.force, gestures["draws"]
        drawn = describe_touches(gestures, paths, values, measures)
        shear = steer(paths, settings.shear)
        labels = measures.labels(settings.thresholds, settings.rate)
        return Movie(frames, index, shares, labels, drawn, shear), pressed

    def _explain_impossible(self, labels: np.ndarray) -> InputError:
        names = (name if on else f"not {name}" for name, on in zip(TOUCH.names, labels, strict=True))
        return InputError(
            f"no gesture in {_ATTEMPTS * self.settings.redraws} draws was {', '.join(names)}: on this sheet, "
            "with these sensors, the ranges under touch rule it out; sensors far apart have small readings "
            "under a small dangerous touch: raise touch.small_area or touch.dangerous_peak, or add sensors"
            f"{self.contact.advice}"
        )
