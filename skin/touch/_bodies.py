"""Draw the pressing object: shape, angle, stretch and size, so that it fits on the sheet."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from skin.errors import InputError
from skin.touch.shapes import Shapes

if TYPE_CHECKING:
    from skin.touch.gesture import Draws, GestureSettings

_TRIES = 2000
_PROBES = 500
_RARE = 0.01
# Tolerance for rounding in shapes that fit exactly.
_SLACK = 1e-9


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
            found = np.empty((2, len(shapes.names)))
            for row, shape in np.ndindex(found.shape):
                same, number = np.full(_PROBES, bool(row)), np.full(_PROBES, shape)
                given = settings, shapes, chance[row], number
                drawn = _fitted(same, *given, same) if fitted else _as_they_are(same, *given)
                found[row, shape] = drawn["fits"].mean()
            return found

        redrawn = fits(fitted=False)
        totals = redrawn.sum(axis=1, keepdims=True)
        if totals.all() and (redrawn / totals).max(axis=0).sum() / 2 <= settings.leak:
            return None
        small, big = fits(fitted=True) >= _RARE
        if not big.any():
            raise _no_room(settings, shapes.body.size)
        return cls(big, small | big)

    def draw(self, big: np.ndarray, generator: np.random.Generator) -> np.ndarray:
        """Draw a shape (B,) per body, uniformly among those that fit with its area, big (B,) or small."""
        chance = generator.random(len(big))
        options = [np.flatnonzero(which) for which in (self.small, self.big)]
        small, large = (one[(chance * len(one)).astype(int)] for one in options)
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
            found = _as_they_are(big[todo], settings, shapes, chance, shape)
        else:
            shape = kept[todo]
            found = _fitted(big[todo], settings, shapes, chance, shape, fit.big[shape])
        fits = found.pop("fits")
        for name, value in found.items():
            drawn.setdefault(name, np.empty((len(big), *value.shape[1:]), value.dtype))[todo] = value
        todo = todo[~fits]
        drawn["misfits"][todo] += 1
        if not len(todo):
            return drawn
    raise _no_room(settings, shapes.body.size)


def _as_they_are(
    big: np.ndarray, settings: GestureSettings, shapes: Shapes, chance: np.ndarray, shape: np.ndarray
) -> Draws:
    angle = 2 * np.pi * chance[:, 1]
    scale = shapes.scale(shape, _area(big, settings, chance[:, 2]))
    low, high = shapes.extent(shape, angle, scale)
    fits = (high - low + settings.spare <= shapes.body.size).all(axis=1)
    found = {"shape": shape, "angle": angle, "stretch": np.ones(len(big)), "scale": scale}
    return found | {"low": low, "high": high, "fits": fits}


def _fitted(
    big: np.ndarray,
    settings: GestureSettings,
    shapes: Shapes,
    chance: np.ndarray,
    shape: np.ndarray,
    asked_big: np.ndarray,
) -> Draws:
    angle = 2 * np.pi * chance[:, 1]
    asked = shapes.whole_scale(shape, _area(asked_big, settings, chance[:, 2]))
    low, high = shapes.extent(shape, angle, asked)
    room = np.array(shapes.body.size) - settings.spare
    x, y = ((high - low) / np.maximum(room, _SLACK)).T
    # The stretch nearest to 1 at which both sides have room.
    stretch = np.clip(1, y**2, np.maximum(x**-2, y**2))
    fits = (x * y <= 1 + _SLACK) & (np.maximum(stretch, 1 / stretch) <= settings.stretch)
    own = shapes.whole_scale(shape, _area(big, settings, chance[:, 3]))
    scale = np.where(big == asked_big, asked, own)
    low, high = shapes.extent(shape, angle, scale, stretch)
    found = {"shape": shape, "angle": angle, "stretch": stretch, "scale": scale}
    return found | {"low": low, "high": high, "fits": fits}


def _area(big: np.ndarray, settings: GestureSettings, chance: np.ndarray) -> np.ndarray:
    least, most = np.where(big[:, None], settings.big_area, settings.small_area).T
    return least + (most - least) * chance


def _no_room(settings: GestureSettings, size: tuple[float, float]) -> InputError:
    least, most = settings.big_area
    return InputError(
        f"none of touch.shapes={list(settings.shapes)} covers {least:g} to {most:g} of a sheet of "
        f"{size[0]:g} x {size[1]:g} m and leaves touch.spare={settings.spare:g} m along x and y, even turned "
        f"and stretched by up to touch.stretch={settings.stretch:g}: lower touch.spare or touch.big_area, "
        "raise touch.stretch, or add a compact shape such as disc"
    )
