"""Base class of samplers, which draw touches with given labels, and the contact that presses them."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from skin.body.base import AbstractBody
from skin.touch.labels import TOUCH, report_labels
from skin.touch.movie import Measures, Movie
from skin.touch.paths import Draws, TouchSettings, Trajectories, heading
from skin.touch.shapes import Shapes

if TYPE_CHECKING:
    from skin.touch.gestures import GestureSettings


class ContactProblem(NamedTuple):
    """The touched body and the criteria for labels.

    Attributes:
        shapes: the shapes and the body.
        footprints: (S, H * W), area weights of each sensor that sum to 1, float32.
        settings: ranges of the gestures, and the thresholds of the labels.
    """

    shapes: Shapes
    footprints: Tensor
    settings: "GestureSettings"


class ContactResult(NamedTuple):
    """The pressure of trajectories.

    Attributes:
        frames: (U, H, W), Pa, float32, each divided by its fraction of full force, so that all frames of a
            gesture have the same total force.
        force: (B,), full force, N.
        peak: (B,), peak cell pressure of the gesture, Pa.
        refused: (B,), bool, gestures whose frames are not valid, because no force gives the wanted labels or
            the contact did not converge.
        hopeless: (B,), bool, the refused gestures for which no other path can succeed.
        unconverged: (B,), number of frames that did not converge to the tolerance; None where all are exact.
        area: (U,), fraction of the sheet in contact, where the frames are moments of the pressure
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


def balanced(
    count: int, generator: np.random.Generator, kinds: Sequence[int] = range(2 ** len(TOUCH))
) -> np.ndarray:
    """Return label combinations (count, 4), bool, equally frequent, to within one, in random order.

    Args:
        count: B.
        generator: source of randomness.
        kinds: the combinations; bit n tells whether label n of ``TOUCH`` holds.
    """
    codes = generator.permutation(generator.permutation(kinds)[np.arange(count) % len(kinds)])
    return codes[:, None] >> np.arange(len(TOUCH)) & 1 > 0


class AbstractSampler(ABC):
    """Draws touches of a kind and renders their movies.

    Args:
        body: the sheet.
        footprints: (S, H * W), area weights of each sensor that sum to 1 (``AbstractBody.footprints``).
        contact: computes the pressure of touches.
        settings: of the touches.
        padded: whether touches begin at a random frame of the window instead of its first.
        moments: (S, H * W), weights of moments of the pressure in place of ``footprints``
            (:func:`skin.mechanics.geometry.footprints`). The frames of movies are then moments. None: they
            are mean pressures of cells.

    Attributes:
        labels: all labels by name: those of ``TOUCH``, then labels of one's own.
        leak: see :func:`skin.device.simulated.check_label_leakage`.

    Raises:
        InputError: settings or pictures that cannot be used.
    """

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
        self.settings, self.leak = settings, float(getattr(settings, "leak", 1.0))
        self.labels = report_labels(settings.thresholds, settings.rate, settings.limits)
        self.labels |= settings.labels
        self.footprints = torch.as_tensor(footprints, dtype=torch.float32)
        self.moments = None if moments is None else torch.as_tensor(moments, dtype=torch.float32)
        self.shapes = Shapes(settings.shapes, body, settings.thresholds.contact, moments is not None)

    @property
    def kinds(self) -> Sequence[int]:
        """The combinations of labels that touches are drawn for, as of :func:`balanced`."""
        return range(2 ** len(TOUCH))

    @property
    def chosen(self) -> list[str]:
        """The labels that touches can be drawn for; the others follow."""
        return [name for bit, name in enumerate(TOUCH.names) if any(kind >> bit & 1 for kind in self.kinds)]

    def balanced(self, count: int, generator: np.random.Generator) -> np.ndarray:
        """Return label combinations (count, 4), bool, that can be drawn, balanced, in random order."""
        return balanced(count, generator, self.kinds)

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

    def _movie(
        self,
        frames: Tensor,
        drawn: Draws,
        paths: Trajectories,
        measures: Measures,
        contacts: Tensor | None = None,
    ) -> Movie:
        """Return the movie of touches (B,), whose labels follow from its parameters and frames.

        Args:
            frames: (U, H, W), Pa, or moments.
            drawn: of the touches, (B, ...), with peak (Pa), force (N) and number of paths drawn.
            paths: of the touches.
            measures: of the movie.
            contacts: of fingertips; see :class:`skin.touch.movie.Movie`.
        """
        drawn = drawn | dict(zip(("net_x", "net_y"), paths.net.T, strict=True))
        drawn |= dict(zip("xy", paths.poses.position[paths.first].T, strict=True))
        floats = {name: torch.from_numpy(drawn[name]).float() for name in _PARAMETERS}
        floats |= {name: value.float() for name, value in measures._asdict().items()}
        friction = self.settings.shear
        if limits := self.settings.limits:
            force = floats["force"] * paths.profile.amax(1)
            press = measures.frames > self.settings.frames.duration
            excess = limits.excess(floats["pressure"].numpy(), force.numpy(), press.numpy())
            floats["excess"] = torch.from_numpy(excess).float()
        drag = torch.from_numpy(friction * heading(paths.position, paths.first)).float()
        movie = Movie(
            frames,
            paths.index,
            paths.profile,
            torch.empty(0),
            floats,
            drag if friction else None,
            contacts,
        )
        held = [label.measure(movie, self.body) > label.above for label in self.labels.values()]
        return replace(movie, labels=torch.stack(held, dim=1).float())


_PARAMETERS = (
    *("shape", "angle", "stretch", "misfits", "duration", "onset", "direction", "speed"),
    *("peak", "force", "draws", "net_x", "net_y", "x", "y"),
)
