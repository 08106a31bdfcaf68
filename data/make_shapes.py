"""Draw the shapes that touch the skin: grey-scale images, white = full pressure (report, 2.1.2).

Run as ``python data/make_shapes.py``; a picture of your own is used by naming it in ``touch.shapes``.
"""

from pathlib import Path

import numpy as np
from PIL import Image

__all__ = ["SHAPES", "draw"]

PIXELS = 96
SOFT = 1.5  # px over which a hard edge fades, so that it is not jagged

# Pixel centres, in units of half the picture: x to the right, y down.
Y, X = np.meshgrid(*[(np.arange(PIXELS) + 0.5) / PIXELS * 2 - 1] * 2, indexing="ij")


def inside(distance: np.ndarray) -> np.ndarray:
    """Return 1 where a signed distance is negative and 0 where it is positive, with a soft edge."""
    return np.clip(0.5 - distance * PIXELS / 2 / SOFT, 0, 1)


def disc() -> np.ndarray:
    """Return a flat round face."""
    return inside(np.hypot(X, Y) - 0.95)


def blurred_disc() -> np.ndarray:
    """Return a round face whose pressure falls off smoothly, as in the report's figure 2."""
    return np.where(np.hypot(X, Y) < 0.98, np.cos(np.pi / 2 * np.hypot(X, Y) / 0.98) ** 2, 0)


def square() -> np.ndarray:
    """Return a flat square face."""
    return inside(np.maximum(abs(X), abs(Y)) - 0.95)


def bar() -> np.ndarray:
    """Return a flat face three times as long as wide."""
    return inside(np.maximum(abs(X) - 0.95, abs(Y) - 0.95 / 3))


def capsule(x0: float, y0: float, x1: float, y1: float, radius: float) -> np.ndarray:
    """Return the distance to a line with round ends, signed and in units of its radius."""
    dx, dy = x1 - x0, y1 - y0
    along = np.clip(((X - x0) * dx + (Y - y0) * dy) / max(dx**2 + dy**2, 1e-12), 0, 1)
    return np.hypot(X - x0 - along * dx, Y - y0 - along * dy) / radius - 1


def dome(distance: np.ndarray) -> np.ndarray:
    """Return Hertz's pressure sqrt(1 - r^2) under a round body, for r = distance + 1."""
    return np.sqrt(np.clip(1 - (distance + 1) ** 2, 0, None))


def fist() -> np.ndarray:
    """Return four knuckles and, pressing less, the fingers' first joints below them."""
    knuckles = [
        dome(capsule(x, y, x, y + 0.28, 0.25))
        for x, y in ((-0.7, -0.30), (-0.24, -0.42), (0.22, -0.40), (0.67, -0.24))
    ]
    joints = 0.55 * dome(capsule(-0.58, 0.42, 0.55, 0.40, 0.28))
    return np.maximum.reduce([*knuckles, joints])


def hand() -> np.ndarray:
    """Return an open hand: palm, four fingers and a thumb."""
    fingers = [
        dome(capsule(x0, 0.1, x1, y1, 0.115))
        for x0, x1, y1 in (
            (-0.36, -0.50, -0.62),
            (-0.12, -0.16, -0.84),
            (0.12, 0.16, -0.80),
            (0.36, 0.46, -0.58),
        )
    ]
    thumb = dome(capsule(0.36, 0.62, 0.84, 0.12, 0.13))
    heel = 0.9 * dome(capsule(-0.14, 0.64, 0.18, 0.66, 0.30))
    ball = 0.7 * dome(capsule(-0.28, 0.30, 0.28, 0.28, 0.26))
    return np.maximum.reduce([*fingers, thumb, heel, ball])


def fingertip() -> np.ndarray:
    """Return a fingertip: Hertz's pressure under an ellipse."""
    return dome(np.hypot(X / 0.72, Y / 0.95) - 1)


SHAPES = {shape.__name__: shape for shape in (disc, blurred_disc, square, bar, fist, hand, fingertip)}


def draw(folder: Path) -> None:
    """Write every shape to ``folder`` as an 8-bit grey-scale PNG."""
    for name, shape in SHAPES.items():
        Image.fromarray(np.round(255 * shape()).astype(np.uint8)).save(folder / f"{name}.png", optimize=True)


if __name__ == "__main__":
    draw(Path(__file__).parent / "shapes")
