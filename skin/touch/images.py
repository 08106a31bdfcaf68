"""Find, check and prepare grey-scale images of objects."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scipy.spatial import ConvexHull
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, avg_pool2d

from skin.core.files import BUNDLED, candidates
from skin.errors import InputError

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
