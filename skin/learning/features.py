"""Hand-made features of a touch that do not depend on the number or order of sensors."""

from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize, one_hot, pad

from skin.device.touches import Touches
from skin.touch.labels import Task
from skin.touch.movie import longest_run

LEVELS = (0.15, 0.3, 0.6, 1.0, 2.0, 3.0)
"""N above idle, where the noise is ``NOISE``: from three times that noise to a firm press."""
NOISE = 0.05
"""N, of the report's sensors."""
FRACTIONS = (0.05, 0.1, 0.2, 0.3, 0.5, 0.7)
"""Levels as fractions of the touch's own peak."""
SINGULAR_VALUES = 4
"""Number of singular values that are used."""
Block = tuple[list[str], Tensor]
"""Names of K features, and their values (B, K)."""


def engineered_features(touches: Touches) -> dict[str, Tensor]:
    """Return about 130 named features, (B,) each, of touches of any layout.

    Nearly all are of what exceeds a sensor's idle level; readings that are not valid count as idle. Levels in
    newtons rise with the noise of the touch: by three times what exceeds ``NOISE``, so that noise alone does
    not pass them. Their names give the levels of a device with that noise.
    """
    return {
        name: column
        for names, values in feature_blocks(touches)
        for name, column in zip(names, values.unbind(dim=1), strict=True)
    }


def feature_blocks(touches: Touches) -> list[Block]:
    """Return the features of :func:`engineered_features`, in the same order, as matrices."""
    raw, noise = _valid(touches), estimate_noise(touches)
    x = above_idle(touches, noise)
    positions = touches.positions[..., :2].to(x.dtype)
    frame, peak = x.sum(dim=2), x.amax(dim=2)
    rise = 3 * (noise - NOISE).clamp(min=0)
    return [
        (["noise"], noise[:, None]),
        *_levels(x, peak, frame, noise),
        *_sorted(raw, x, peak, frame),
        *_changes(x, peak, frame),
        _sharing(x, peak, frame),
        *_path(x, peak, positions, rise),
        *_spread(x, positions, rise),
    ]


def estimate_noise(touches: Touches) -> Tensor:
    """Return the standard deviation of the noise in each touch, (B,), N; 0 where no reading is valid.

    It is estimated from the median distance between consecutive readings of all sensors, so that the frames
    and sensors of the touch itself hardly count.
    """
    steps = _valid(touches).diff(dim=1).abs()
    valid = touches.valid[:, 1:] & touches.valid[:, :-1]
    known = torch.where(valid, steps, torch.nan).flatten(1)
    # 1.0484: standard deviation of normal noise per median distance between two frames
    return 1.0484 * known.nanmedian(dim=1).values.nan_to_num(0)


def above_idle(touches: Touches, noise: Tensor | None = None, rest: float = 0.2) -> Tensor:
    """Return by how much each reading exceeds its sensor's idle level, (B, T, S), N; 0 where it is not valid.

    That level is a low quantile over the window, so that constant offsets of a device do not matter. Normal
    noise lowers the quantile, which is corrected. If a touch lasts for longer than the quantile allows, as in
    a recording that begins in contact, the readings together fall far below it in the few frames at rest;
    the level is then the mean of these.

    Args:
        touches: B touches of S sensors.
        noise: standard deviation in each touch, (B,), N; None: :func:`estimate_noise`.
        rest: fraction of its window for which a touch rests at least.
    """
    raw = _valid(touches)
    noise = estimate_noise(touches) if noise is None else noise
    # 0.8416: standard deviations from the quantile 0.2 of normal noise up to its mean
    idle = torch.quantile(raw, rest, dim=1, keepdim=True) + 0.8416 * noise[:, None, None]
    total = (raw - idle).sum(dim=2)
    # a touch that lasts longer rests in one of 20 frames
    lowest = total.topk(max(1, raw.shape[1] // 20), dim=1, largest=False)
    fall, noisy = -lowest.values.mean(dim=1), 5 * raw.shape[2] ** 0.5 * noise
    # silicone that is pulled lowers the sum by less than a fifth of its range
    contact = (fall > noisy) & (fall > 0.2 * (total.amax(dim=1) + fall))
    at_rest = raw.gather(1, lowest.indices[..., None].expand(-1, -1, raw.shape[2])).mean(dim=1, keepdim=True)
    return (raw - torch.where(contact[:, None, None], at_rest, idle)) * touches.valid


def _valid(touches: Touches) -> Tensor:
    """Return the readings (B, T, S), N, 0 where they are not valid."""
    return torch.where(touches.valid, touches.readings, torch.zeros(()))


def _frame_at(x: Tensor, index: Tensor) -> Tensor:
    """Return one frame of each touch, (B, K), of x (B, T, K), given its index (B,)."""
    return x.gather(1, index[:, None, None].expand(-1, 1, x.shape[2]))[:, 0]


def _fractions(x: Tensor) -> Tensor:
    """Return numbers (B, K), none below 0, divided by their sum."""
    return x / x.sum(dim=1, keepdim=True).clamp(min=1e-6)


def _levels(x: Tensor, peak: Tensor, frame: Tensor, noise: Tensor) -> Iterable[Block]:
    """Yield how long and on how many sensors a touch exceeds absolute and relative levels, and noise."""
    highest = x.amax(dim=1)
    top = peak.amax(dim=1, keepdim=True).clamp(min=1e-6)
    at_peak = _frame_at(x, frame.argmax(dim=1))
    # All levels at once, for a window alone costs what the calls cost.
    levels, fractions = (
        torch.tensor(values, dtype=x.dtype, device=x.device) for values in (LEVELS, FRACTIONS)
    )
    raised = levels + 3 * (noise[:, None] - NOISE).clamp(min=0)
    parts = torch.maximum(fractions * top, 3 * noise[:, None])
    # Noise of the sum grows with the root of the number of sensors.
    sums = torch.maximum(fractions * frame.amax(dim=1, keepdim=True), 3 * x.shape[2] ** 0.5 * noise[:, None])
    above = peak[..., None] > raised[:, None]
    runs = torch.cat([above, peak[..., None] > parts[:, None], frame[..., None] > sums[:, None]], dim=2)
    sizes = [len(LEVELS), len(FRACTIONS), len(FRACTIONS)]
    lasting, strongly, summed = longest_run(runs).float().split(sizes, 1)
    at_once = [(x > level[:, None, None]).sum(dim=2).amax(dim=1) for level in raised.T]
    absolute = {
        "frames above {} N": above.sum(dim=1),
        "longest run above {} N": lasting,
        "sensors above {} N": (highest[..., None] > raised[:, None]).sum(dim=1),
        "most sensors above {} N at once": torch.stack(at_once, dim=1),
    }
    relative = {
        "longest run above {} of the peak": strongly,
        "longest run of the sum above {} of its peak": summed,
        "sensors above {} of the peak": (highest[..., None] > parts[:, None]).sum(dim=1),
        "sensors above {} of the peak at once": (at_peak[..., None] > parts[:, None]).sum(dim=1),
    }
    yield _named(absolute, LEVELS)
    yield _named(relative, FRACTIONS)


def _named(columns: dict[str, Tensor], levels: tuple[float, ...]) -> Block:
    """Return the columns (B, K) level by level, each under its name with the level in it."""
    names = [name.format(level) for level in levels for name in columns]
    return names, torch.stack([column.float() for column in columns.values()], dim=2).flatten(1)


def _sorted(raw: Tensor, x: Tensor, peak: Tensor, frame: Tensor, count: int = 10) -> Iterable[Block]:
    """Yield maxima and sums of sensors and frames, from the largest down."""
    columns = {
        "raw sensor maximum": raw.amax(dim=1),
        "sensor maximum": x.amax(dim=1),
        "sensor sum": x.sum(dim=1),
        "frame maximum": peak,
        "frame sum": frame,
    }
    for name, values in columns.items():
        largest = values.topk(min(count, values.shape[1]), dim=1).values
        yield [f"{name} {rank + 1}" for rank in range(count)], pad(largest, (0, count - largest.shape[1]))


def _changes(x: Tensor, peak: Tensor, frame: Tensor) -> Iterable[Block]:
    """Yield how fast the touch rises and falls, and how often the strongest sensor changes."""
    for name, values in {"sum": frame, "maximum": peak}.items():
        step = values.diff(dim=1)
        names = [f"fastest rise of the {name}", f"fastest fall of the {name}", f"deviation of the {name}"]
        yield names, torch.stack([step.amax(dim=1), step.amin(dim=1), values.std(dim=1)], dim=1)
    active = peak > 0.3 * peak.amax(dim=1, keepdim=True)
    strongest = x.argmax(dim=2)
    moved = (strongest.diff(dim=1) != 0) & active[:, 1:] & active[:, :-1]
    ever = (one_hot(strongest, x.shape[2]) * active[..., None]).amax(dim=1)
    counts = torch.stack([moved.sum(dim=1), ever.sum(dim=1)], dim=1)
    yield ["changes of the strongest sensor", "sensors that were strongest"], counts


def _sharing(x: Tensor, peak: Tensor, frame: Tensor) -> Block:
    """Return whether all sensors follow one course over time, as they do under a touch that stands still."""
    strength = pad(torch.linalg.svdvals(x), (0, SINGULAR_VALUES))[:, :SINGULAR_VALUES]
    ratio = strength / strength[:, :1].clamp(min=1e-6)
    centre, total = _mean_time(x.clamp(min=0))
    weight = _fractions(total.clamp(min=1e-6) * (x.amax(dim=1) > 0.3 * peak.amax(dim=1, keepdim=True)))
    mean = (weight * centre).sum(dim=1, keepdim=True)
    spread = (weight * (centre - mean).square()).sum(dim=1, keepdim=True).sqrt()
    fraction = (peak.amax(dim=1) / frame.amax(dim=1).clamp(min=1e-6))[:, None]
    names = [
        "singular value 1",
        *[f"singular value {number + 1} of the first" for number in range(1, SINGULAR_VALUES)],
        "spread of the sensors in time",
        "fraction of the strongest sensor",
    ]
    return names, torch.cat([strength[:, :1], ratio[:, 1:], spread, fraction], dim=1)


def _mean_time(push: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean frame of each sensor, weighted by force ``push`` (B, T, S), and its sum; (B, S)."""
    total = push.sum(dim=1)
    time = torch.arange(push.shape[1], dtype=push.dtype)[None, :, None]
    return (push * time).sum(dim=1) / total.clamp(min=1e-6), total


def _path(x: Tensor, peak: Tensor, positions: Tensor, rise: Tensor) -> Iterable[Block]:
    """Yield how the centre of the readings moves while the touch lasts, m."""
    active = peak > 0.25 * peak.amax(dim=1, keepdim=True)
    inside, frames = active[..., None], active.sum(dim=1).clamp(min=1)
    first = active.to(torch.int64).argmax(dim=1)
    last = active.shape[1] - 1 - active.flip(1).to(torch.int64).argmax(dim=1)
    for power in (1, 2):
        push = (x - 0.1 - rise[:, None, None]).clamp(min=0) ** power
        centre = push @ positions / push.sum(dim=2, keepdim=True).clamp(min=1e-6)
        step = centre.diff(dim=1).norm(dim=2) * (active[:, 1:] & active[:, :-1])
        middle = torch.where(inside, centre, 0).sum(dim=1, keepdim=True) / frames[:, None, None]
        far = ((centre - middle).norm(dim=2) * active).amax(dim=1)
        high = torch.where(inside, centre, -torch.inf).amax(dim=1)
        low = torch.where(inside, centre, torch.inf).amin(dim=1)
        ends = (_frame_at(centre, last) - _frame_at(centre, first)).norm(dim=1)
        columns = {
            "path": step.sum(dim=1),
            "mean step": step.sum(dim=1) / frames,
            "longest step": step.amax(dim=1),
            "reach": far,
            "extent": torch.where(active.any(dim=1), (high - low).norm(dim=1), 0),
            "way": ends,
            "speed": ends / frames,
        }
        names = [f"{name} of the centre {power}" for name in columns]
        yield names, torch.stack(list(columns.values()), dim=1)


def _spread(x: Tensor, positions: Tensor, rise: Tensor) -> Iterable[Block]:
    """Yield how wide the touch is at its strongest frame and over all, m."""
    strongest = _frame_at(x, x.sum(dim=2).argmax(dim=1))
    for name, values in {"strongest frame": strongest, "maxima": x.amax(dim=1)}.items():
        weight = _fractions((values - 0.1 - rise[:, None]).clamp(min=0))
        # In single precision the breadth of sensors in a line would be the root of rounding errors.
        fraction = weight.double() / weight.double().sum(dim=1, keepdim=True).clamp(min=0.5)
        offset = positions.double() - fraction[:, None] @ positions.double()
        moments = torch.einsum("bs,bsi,bsj->bij", fraction, offset, offset)
        axes = torch.linalg.eigvalsh(moments).clamp(min=0).sqrt().flip(1).to(x.dtype)
        evenness = weight.square().sum(dim=1, keepdim=True).clamp(min=1e-6).reciprocal()
        names = [f"{measure} of the {name}" for measure in ("length", "breadth", "evenness")]
        yield names, torch.cat([axes, evenness], dim=1)


# Features of the course over time, of each sensor, and those that a task needs.


def course_features(touches: Touches) -> dict[str, Tensor]:
    """Return about 90 named features, (B,) each, of how often and when a touch of any layout comes and goes.

    They tell repeated contacts, such as pats, from a long one. Times are in frames.
    """
    x = above_idle(touches)
    columns = dict[str, Tensor]()
    for name, course in {"sum": x.clamp(min=0).sum(dim=2), "maximum": x.amax(dim=2)}.items():
        columns |= {f"{key} of the {name}": value for key, value in _course(course).items()}
    highest = x.amax(dim=(1, 2), keepdim=True).clamp(min=1e-6)
    for fraction in (0.1, 0.3):
        active = (x > fraction * highest).int()
        rises = _count_rises(active).float()
        columns |= {
            f"rises of sensors above {fraction}": rises.sum(dim=1),
            f"most rises of a sensor above {fraction}": rises.amax(dim=1),
            f"sensors that rise above {fraction}": (rises > 0).float().sum(dim=1),
            f"sensors at once above {fraction}": active.sum(dim=(1, 2))
            / active.amax(dim=2).sum(dim=1).clamp(min=1),
        }
    return columns


def _count_rises(active: Tensor) -> Tensor:
    """Return how often numbers 0 or 1, (B, T, ...), become 1, (B, ...)."""
    return (active.diff(dim=1) > 0).sum(dim=1) + active[:, 0]


def _course(course: Tensor) -> dict[str, Tensor]:
    """Return features of a course over time (B, T)."""
    count, columns = course.shape[1], dict[str, Tensor]()
    top = course.amax(dim=1, keepdim=True).clamp(min=1e-6)
    for fraction in FRACTIONS:
        active = (course > fraction * top).int()
        rises, first = _count_rises(active), active.argmax(dim=1)
        last = count - 1 - active.flip(1).argmax(dim=1)
        columns |= {
            f"contacts above {fraction}": rises.float(),
            f"mean contact above {fraction}": active.sum(dim=1) / rises.clamp(min=1),
            f"span above {fraction}": (last - first + 1).float(),
            f"begin above {fraction}": first.float(),
        }
    power = torch.fft.rfft(course - course.mean(dim=1, keepdim=True), dim=1).abs().square()
    power = power / power.sum(dim=1, keepdim=True).clamp(min=1e-12)
    frequency = torch.linspace(0, 0.5, power.shape[1], dtype=power.dtype)
    edges = torch.tensor([0.02, 0.05, 0.1, 0.2], dtype=power.dtype)  # of bands, in cycles per frame
    bands = power.new_zeros(len(power), len(edges) + 1)
    bands = bands.index_add(1, torch.bucketize(frequency, edges), power)
    push, step = course.clamp(min=0), course.diff(dim=1)
    turned = (step[:, 1:] * step[:, :-1] < 0) & (step[:, 1:].abs() > 0.05 * top)
    done = push.cumsum(dim=1) / push.sum(dim=1, keepdim=True).clamp(min=1e-6)
    return (
        columns
        | {"mean frequency": power @ frequency}
        | {f"fraction of band {number}": band for number, band in enumerate(bands.unbind(dim=1))}
        | {"variation": step.abs().sum(dim=1) / top[:, 0], "reversals": turned.float().sum(dim=1)}
        | {f"time of {part} of it": (done < part).float().sum(dim=1) for part in (0.1, 0.25, 0.5, 0.75, 0.9)}
    )


def sensor_features(touches: Touches) -> dict[str, Tensor]:
    """Return four named features, (B,) each, of each sensor, N: where and how hard a touch is.

    Unlike the other features they depend on the sensors and their order, and have a sign.
    """
    raw = _valid(touches)
    strongest = raw.abs().sum(dim=2).argmax(dim=1)
    columns = {
        "reading in the strongest frame": _frame_at(raw, strongest),
        "mean": raw.mean(dim=1),
        "maximum": raw.amax(dim=1),
        "minimum": raw.amin(dim=1),
    }
    return {
        f"{name} of sensor {number}": column
        for name, values in columns.items()
        for number, column in enumerate(values.unbind(dim=1))
    }


def feature_matrix(touches: Touches, task: Task) -> np.ndarray:
    """Return the features that a task needs, (B, D), float32."""
    touches = touches.to("cpu")
    columns = engineered_features(touches)
    columns |= direction_features(touches) if task.direction else {}
    columns |= sensor_features(touches) if task.kind == "regression" else {}
    return torch.stack([column.to(torch.float32) for column in columns.values()], dim=1).numpy()


# Signed features of the direction of sliding, along x and along y.


def direction_features(touches: Touches, force: float = 0.1) -> dict[str, Tensor]:
    """Return about 60 named features, (B,) each, of touches of any layout.

    Each vector is given as it is and normalised to length 1, like the label.

    Args:
        touches: B touches of S sensors.
        force: N, twice the noise; smaller readings have no weight in a centre.
    """
    x = above_idle(touches)
    positions = touches.positions[..., :2].to(x.dtype).expand(*x.shape, 2)
    time, total = _mean_time((x - force).clamp(min=0))
    vectors = {"order of the sensors": _slope(positions.mean(dim=1), total, time, 1e-3)}
    vectors |= _lean(x, positions, force)
    for power in (1, 2):
        push = (x - force).clamp(min=0) ** power
        for fraction in (0.1, 0.25, 0.5):
            name = f"centre {power} beyond {fraction} of the peak"
            ways = _ways(push, positions, x.amax(dim=2), fraction)
            vectors |= {f"{way} of the {name}": vector for way, vector in ways.items()}
    return {
        f"{name}, {axis}": column
        for name, vector in vectors.items()
        for axis, column in zip("xy", vector.T, strict=True)
    } | {
        f"{name}, cosine with {axis}": column
        for name, vector in vectors.items()
        for axis, column in zip("xy", normalize(vector, dim=1).T, strict=True)
    }


def _ways(push: Tensor, positions: Tensor, peak: Tensor, fraction: float) -> dict[str, Tensor]:
    """Return vectors (B, 2), m or m per frame, of the motion of the centre of ``push`` (B, T, S).

    A frame is active where its largest reading ``peak`` (B, T), N, exceeds a fraction of the touch's peak.
    """
    total = push.sum(dim=2)
    centre = torch.einsum("bts,btsi->bti", push, positions) / total.clamp(min=1e-6)[..., None]
    active = (peak > fraction * peak.amax(dim=1, keepdim=True)) & (total > 0)
    first, last = active.int().argmax(dim=1), active.shape[1] - 1 - active.flip(1).int().argmax(dim=1)
    way = _frame_at(centre, last) - _frame_at(centre, first)
    time = torch.arange(push.shape[1], dtype=push.dtype)
    return {
        "way": torch.where(active.any(dim=1)[:, None], way, 0),
        "slope": _slope(centre, total * active, time, 1e-6),
    }


def _slope(positions: Tensor, weight: Tensor, time: Tensor, minimum: float) -> Tensor:
    """Return the slope of the least-squares line through positions (B, K, 2) over time, (B, 2), m per frame.

    Args:
        positions: (B, K, 2), m.
        weight: (B, K), of each.
        time: (K,) or (B, K), of each, frames.
        minimum: of the variance of time that the slope is divided by.
    """
    weight = _fractions(weight)
    late = time - (weight * time).sum(dim=1, keepdim=True)
    variance = (weight * late**2).sum(dim=1).clamp(min=minimum)
    return torch.einsum("bt,bti->bi", weight * late, positions) / variance[:, None]


def _lean(x: Tensor, positions: Tensor, force: float) -> dict[str, Tensor]:
    """Return the offset of readings below idle from the centre, (B, 2), m: friction lifts behind it."""
    sides = [(x - force).clamp(min=0), (-x - force).clamp(min=0)]
    totals = [side.sum(dim=(1, 2)) for side in sides]
    push, pull = (
        torch.einsum("bts,btsi->bi", side, positions) / total.clamp(min=1e-6)[:, None]
        for side, total in zip(sides, totals, strict=True)
    )
    both = (totals[0] > 0) & (totals[1] > 0)
    return {"lean": torch.where(both[:, None], push - pull, 0)}
