"""Signed features of the direction of sliding, along x and along y."""

import torch
from torch import Tensor

from skin.recording import Touches
from skin.signal.features import above_idle

_SHARES = (0.1, 0.25, 0.5)  # of the touch's own peak: a frame beyond is active
_FORCE = 0.1  # N, twice the noise; smaller readings have no weight in a centre


def direction_features(touches: Touches) -> dict[str, Tensor]:
    """Return about 60 named features, (B,) each, of touches of any layout.

    Each vector is given as it is and normalised to length 1, like the label.
    """
    x = above_idle(touches)
    at = touches.positions[..., :2].to(x.dtype).expand(*x.shape, 2)
    vectors = {"order of the sensors": _order(x, at)} | _lean(x, at)
    for power in (1, 2):
        push = (x - _FORCE).clamp(min=0) ** power
        for share in _SHARES:
            name = f"centre {power} beyond {share} of the peak"
            vectors |= {f"{way} of the {name}": vector for way, vector in _ways(push, at, x, share).items()}
    return {
        f"{name}, {axis}": column
        for name, vector in vectors.items()
        for axis, column in zip("xy", vector.T, strict=True)
    } | {
        f"{name}, cosine with {axis}": column
        for name, vector in vectors.items()
        for axis, column in zip("xy", torch.nn.functional.normalize(vector, dim=1).T, strict=True)
    }


def _ways(push: Tensor, at: Tensor, x: Tensor, share: float) -> dict[str, Tensor]:
    """Return vectors (B, 2), m or m per frame, of the motion of the centre of ``push`` (B, T, S)."""
    total = push.sum(dim=2)
    centre = torch.einsum("bts,btsi->bti", push, at) / total.clamp(min=1e-6)[..., None]
    peak = x.amax(dim=2)
    active = (peak > share * peak.amax(dim=1, keepdim=True)) & (total > 0)
    rows, last = torch.arange(len(x)), active.shape[1] - 1 - active.flip(1).int().argmax(dim=1)
    first = active.int().argmax(dim=1)
    ends = torch.where(active.any(dim=1)[:, None], centre[rows, last] - centre[rows, first], 0)
    # Least-squares line, with frames weighted by force.
    weight = total * active
    weight = weight / weight.sum(dim=1, keepdim=True).clamp(min=1e-6)
    time = torch.arange(x.shape[1], dtype=x.dtype).expand_as(weight)
    late = time - (weight * time).sum(dim=1, keepdim=True)
    spread = (weight * late**2).sum(dim=1).clamp(min=1e-6)
    slope = torch.einsum("bt,bti->bi", weight * late, centre) / spread[:, None]
    return {"way": ends, "slope": slope}


def _order(x: Tensor, at: Tensor) -> Tensor:
    """Return the slope of sensor position over time of contact, (B, 2), m per frame."""
    push = (x - _FORCE).clamp(min=0)
    total = push.sum(dim=1)
    time = torch.arange(x.shape[1], dtype=x.dtype)[None, :, None]
    when = (push * time).sum(dim=1) / total.clamp(min=1e-6)
    weight = total / total.sum(dim=1, keepdim=True).clamp(min=1e-6)
    late = when - (weight * when).sum(dim=1, keepdim=True)
    where = torch.einsum("bs,bsi->bi", weight * late, at.mean(dim=1))
    return where / (weight * late**2).sum(dim=1).clamp(min=1e-3)[:, None]


def _lean(x: Tensor, at: Tensor) -> dict[str, Tensor]:
    """Return the offset of readings below idle from the centre, (B, 2), m: friction lifts behind it."""
    push, pull = (x - _FORCE).clamp(min=0), (-x - _FORCE).clamp(min=0)
    sides = []
    for weight in (push, pull):
        total = weight.sum(dim=(1, 2))
        centre = torch.einsum("bts,btsi->bi", weight, at) / total.clamp(min=1e-6)[:, None]
        sides.append((centre, total > 0))
    both = sides[0][1] & sides[1][1]
    return {"lean": torch.where(both[:, None], sides[0][0] - sides[1][0], 0)}
