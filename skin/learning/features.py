"""Hand-made features of a touch that do not depend on the number or order of sensors."""

from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

from skin.device.touches import Touches
from skin.touch.labels import Task
from skin.touch.movie import longest_run

LEVELS = (0.15, 0.3, 0.6, 1.0, 2.0, 3.0)  # N above idle, where the noise is NOISE
NOISE = 0.05  # N
SHARES = (0.05, 0.1, 0.2, 0.3, 0.5, 0.7)  # of the touch's own peak
IDLE = 0.2  # a touch rests for at least a fifth of its window
BEST = 10  # how many sorted values are kept
SINGULAR_VALUES = 4  # how many of them are used
Block = tuple[list[str], Tensor]
"""Names of K features, and their values (B, K)."""

# Standard deviation of normal noise, per median distance between two frames.
_PER_MEDIAN = 1.0484
_REST = 20  # of so many frames one is at rest at least, in a touch that lasts longer than IDLE allows
_FALL = 0.2  # of the range of the sum of readings; what silicone pulls is less
_BELOW = 0.8416  # standard deviations from the quantile IDLE of normal noise up to its mean


def engineered_features(touches: Touches) -> dict[str, Tensor]:
    """Return about 130 named features, (B,) each, of touches of any layout.

    Nearly all are of what exceeds a sensor's idle level; readings that are not valid count as idle. Levels in
    newtons rise with the noise of the touch: by three times what exceeds ``NOISE``, so that noise alone does
    not pass them. Their names give the levels of a device with that noise.
    """
    blocks = feature_blocks(touches)
    return {
        name: column
        for names, values in blocks
        for name, column in zip(names, values.unbind(dim=1), strict=True)
    }


def feature_blocks(touches: Touches) -> list[Block]:
    """Return the features of :func:`engineered_features`, in the same order, as matrices."""
    raw, noise = _valid(touches), estimate_noise(touches)
    x = above_idle(touches, noise)
    places = touches.positions[..., :2].to(x.dtype)
    frame, peak = x.sum(dim=2), x.amax(dim=2)
    rise = 3 * (noise - NOISE).clamp(min=0)
    return [
        (["noise"], noise[:, None]),
        *_levels(x, peak, frame, noise),
        *_sorted(raw, x, peak, frame),
        *_changes(x, peak, frame),
        _sharing(x, peak, frame),
        *_path(x, peak, places, rise),
        *_spread(x, places, rise),
    ]


def estimate_noise(touches: Touches) -> Tensor:
    """Return the standard deviation of the noise in each touch, (B,), N; 0 where no reading is valid.

    It is estimated from the median distance between consecutive readings of all sensors, so that the frames
    and sensors of the touch itself hardly count.
    """
    steps = _valid(touches).diff(dim=1).abs()
    valid = touches.valid[:, 1:] & touches.valid[:, :-1]
    known_steps = torch.where(valid, steps, torch.nan).flatten(1)
    return _PER_MEDIAN * known_steps.nanmedian(dim=1).values.nan_to_num(0)


def above_idle(touches: Touches, noise: Tensor | None = None) -> Tensor:
    """Return by how much each reading exceeds its sensor's idle level, (B, T, S), N; 0 where it is not valid.

    That level is a low quantile over the window, so that constant offsets of a device do not matter. Normal
    noise lowers the quantile, which is corrected. If a touch lasts for longer than the quantile allows, as in
    a recording that begins in contact, the readings together fall far below it in the few frames at rest;
    the level is then the mean of these.

    Args:
        touches: B touches of S sensors.
        noise: standard deviation in each touch, (B,), N; None: :func:`estimate_noise`.
    """
    raw = _valid(touches)
    noise = estimate_noise(touches) if noise is None else noise
    idle = torch.quantile(raw, IDLE, dim=1, keepdim=True) + _BELOW * noise[:, None, None]
    total = (raw - idle).sum(dim=2)
    rest = total.topk(max(1, raw.shape[1] // _REST), dim=1, largest=False)
    fall, noisy = -rest.values.mean(dim=1), 5 * raw.shape[2] ** 0.5 * noise
    contact = (fall > noisy) & (fall > _FALL * (total.amax(dim=1) + fall))
    at_rest = raw.gather(1, rest.indices[..., None].expand(-1, -1, raw.shape[2])).mean(dim=1, keepdim=True)
    return (raw - torch.where(contact[:, None, None], at_rest, idle)) * touches.valid


def _valid(touches: Touches) -> Tensor:
    """Return the readings (B, T, S), N, 0 where they are not valid."""
    return torch.where(touches.valid, touches.readings, torch.zeros(()))


def _frame_at(x: Tensor, index: Tensor) -> Tensor:
    """Return one frame of each touch, (B, K), of x (B, T, K), given its index (B,)."""
    return x.gather(1, index[:, None, None].expand(-1, 1, x.shape[2]))[:, 0]


def _levels(x: Tensor, peak: Tensor, frame: Tensor, noise: Tensor) -> Iterable[Block]:
    """Yield how long and on how many sensors a touch exceeds absolute and relative levels, and noise."""
    highest = x.amax(dim=1)
    top = peak.amax(dim=1, keepdim=True).clamp(min=1e-6)
    at_peak = _frame_at(x, frame.argmax(dim=1))
    # All levels at once, for a window alone costs what the calls cost.
    levels, shares = (torch.tensor(values, dtype=x.dtype, device=x.device) for values in (LEVELS, SHARES))
    raised = levels + 3 * (noise[:, None] - NOISE).clamp(min=0)
    parts = torch.maximum(shares * top, 3 * noise[:, None])
    # Noise of the sum grows with the root of the number of sensors.
    sums = torch.maximum(shares * frame.amax(dim=1, keepdim=True), 3 * x.shape[2] ** 0.5 * noise[:, None])
    above = peak[..., None] > raised[:, None]
    strong = peak[..., None] > parts[:, None]
    much = frame[..., None] > sums[:, None]
    runs = longest_run(torch.cat([above, strong, much], dim=2)).float()
    lasting, strongly, summed = runs.split([len(LEVELS), len(SHARES), len(SHARES)], 1)

    def most(level: Tensor) -> Tensor:
        return (x > level[:, None, None]).sum(dim=2).amax(dim=1)

    absolute = {
        "frames above {} N": above.sum(dim=1),
        "longest run above {} N": lasting,
        "sensors above {} N": (highest[..., None] > raised[:, None]).sum(dim=1),
        "most sensors above {} N at once": torch.stack([most(level) for level in raised.T], dim=1),
    }
    relative = {
        "longest run above {} of the peak": strongly,
        "longest run of the sum above {} of its peak": summed,
        "sensors above {} of the peak": (highest[..., None] > parts[:, None]).sum(dim=1),
        "sensors above {} of the peak at once": (at_peak[..., None] > parts[:, None]).sum(dim=1),
    }
    yield _named(absolute, LEVELS)
    yield _named(relative, SHARES)


def _named(columns: dict[str, Tensor], levels: tuple[float, ...]) -> Block:
    """Return the columns (B, K) level by level, each under its name with the level in it."""
    names = [name.format(level) for level in levels for name in columns]
    return names, torch.stack([column.float() for column in columns.values()], dim=2).flatten(1)


def _sorted(raw: Tensor, x: Tensor, peak: Tensor, frame: Tensor) -> Iterable[Block]:
    """Yield maxima and sums of sensors and frames, from the largest down."""
    columns = {
        "raw sensor maximum": raw.amax(dim=1),
        "sensor maximum": x.amax(dim=1),
        "sensor sum": x.sum(dim=1),
        "frame maximum": peak,
        "frame sum": frame,
    }
    for name, values in columns.items():
        count = min(BEST, values.shape[1])
        best = torch.nn.functional.pad(values.topk(count, dim=1).values, (0, BEST - count))
        yield [f"{name} {rank + 1}" for rank in range(BEST)], best


def _changes(x: Tensor, peak: Tensor, frame: Tensor) -> Iterable[Block]:
    """Yield how fast the touch rises and falls, and how often the strongest sensor changes."""
    for name, values in {"sum": frame, "maximum": peak}.items():
        step = values.diff(dim=1)
        names = [f"fastest rise of the {name}", f"fastest fall of the {name}", f"deviation of the {name}"]
        yield names, torch.stack([step.amax(dim=1), step.amin(dim=1), values.std(dim=1)], dim=1)
    active = peak > 0.3 * peak.amax(dim=1, keepdim=True)
    strongest = x.argmax(dim=2)
    moved = (strongest.diff(dim=1) != 0) & active[:, 1:] & active[:, :-1]
    ever = (torch.nn.functional.one_hot(strongest, x.shape[2]) * active[..., None]).amax(dim=1)
    counts = torch.stack([moved.sum(dim=1), ever.sum(dim=1)], dim=1)
    yield ["changes of the strongest sensor", "sensors that were strongest"], counts


def _sharing(x: Tensor, peak: Tensor, frame: Tensor) -> Block:
    """Return whether all sensors follow one course over time, as they do under a touch that stands still."""
    strength = torch.linalg.svdvals(x)
    strength = torch.nn.functional.pad(strength, (0, SINGULAR_VALUES))[:, :SINGULAR_VALUES]
    ratio = strength / strength[:, :1].clamp(min=1e-6)
    push = x.clamp(min=0)
    time = torch.arange(x.shape[1], dtype=x.dtype)[None, :, None]
    total = push.sum(dim=1).clamp(min=1e-6)
    centre = (push * time).sum(dim=1) / total
    weight = total * (x.amax(dim=1) > 0.3 * peak.amax(dim=1, keepdim=True))
    weight = weight / weight.sum(dim=1, keepdim=True).clamp(min=1e-6)
    mean = (weight * centre).sum(dim=1, keepdim=True)
    spread = (weight * (centre - mean).square()).sum(dim=1, keepdim=True).sqrt()
    share = (peak.amax(dim=1) / frame.amax(dim=1).clamp(min=1e-6))[:, None]
    names = [
        "singular value 1",
        *[f"singular value {number + 1} of the first" for number in range(1, SINGULAR_VALUES)],
        "spread of the sensors in time",
        "share of the strongest sensor",
    ]
    return names, torch.cat([strength[:, :1], ratio[:, 1:], spread, share], dim=1)


def _path(x: Tensor, peak: Tensor, places: Tensor, rise: Tensor) -> Iterable[Block]:
    """Yield how the centre of the readings moves while the touch lasts, m."""
    active = peak > 0.25 * peak.amax(dim=1, keepdim=True)
    inside, frames = active[..., None], active.sum(dim=1).clamp(min=1)
    first = active.to(torch.int64).argmax(dim=1)
    last = active.shape[1] - 1 - active.flip(1).to(torch.int64).argmax(dim=1)
    for power in (1, 2):
        push = (x - 0.1 - rise[:, None, None]).clamp(min=0) ** power
        centre = push @ places / push.sum(dim=2, keepdim=True).clamp(min=1e-6)
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


def _spread(x: Tensor, places: Tensor, rise: Tensor) -> Iterable[Block]:
    """Yield how wide the touch is at its strongest frame and over all, m."""
    strongest = _frame_at(x, x.sum(dim=2).argmax(dim=1))
    for name, values in {"strongest frame": strongest, "maxima": x.amax(dim=1)}.items():
        weight = (values - 0.1 - rise[:, None]).clamp(min=0)
        weight = weight / weight.sum(dim=1, keepdim=True).clamp(min=1e-6)
        # In single precision the breadth of sensors in a line would be the root of rounding errors.
        share, place = weight.double(), places.double()
        share = share / share.sum(dim=1, keepdim=True).clamp(min=0.5)
        offset = place - share[:, None] @ place
        moments = torch.einsum("bs,bsi,bsj->bij", share, offset, offset)
        axes = torch.linalg.eigvalsh(moments).clamp(min=0).sqrt().flip(1).to(x.dtype)
        evenness = weight.square().sum(dim=1, keepdim=True).clamp(min=1e-6).reciprocal()
        names = [f"{measure} of the {name}" for measure in ("length", "breadth", "evenness")]
        yield names, torch.cat([axes, evenness], dim=1)


# Features of the course over time, of each sensor, and those that a task needs.


BANDS = (0.02, 0.05, 0.1, 0.2)  # cycles per frame


def course_features(touches: Touches) -> dict[str, Tensor]:
    """Return about 90 named features, (B,) each, of how often and when a touch of any layout comes and goes.

    They tell repeated contacts, such as pats, from a long one. Times are in frames.
    """
    x = above_idle(touches)
    columns = dict[str, Tensor]()
    for name, course in {"sum": x.clamp(min=0).sum(dim=2), "maximum": x.amax(dim=2)}.items():
        columns |= {f"{key} of the {name}": value for key, value in _course(course).items()}
    highest = x.amax(dim=(1, 2), keepdim=True).clamp(min=1e-6)
    for share in (0.1, 0.3):
        active = (x > share * highest).int()
        rises = _count_rises(active).float()
        columns |= {
            f"rises of sensors above {share}": rises.sum(dim=1),
            f"most rises of a sensor above {share}": rises.amax(dim=1),
            f"sensors that rise above {share}": (rises > 0).float().sum(dim=1),
            f"sensors at once above {share}": active.sum(dim=(1, 2))
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
    for share in SHARES:
        active = (course > share * top).int()
        rises, first = _count_rises(active), active.argmax(dim=1)
        last = count - 1 - active.flip(1).argmax(dim=1)
        columns |= {
            f"contacts above {share}": rises.float(),
            f"mean contact above {share}": active.sum(dim=1) / rises.clamp(min=1),
            f"span above {share}": (last - first + 1).float(),
            f"begin above {share}": first.float(),
        }
    power = torch.fft.rfft(course - course.mean(dim=1, keepdim=True), dim=1).abs().square()
    power = power / power.sum(dim=1, keepdim=True).clamp(min=1e-12)
    frequency = torch.linspace(0, 0.5, power.shape[1], dtype=power.dtype)
    columns["mean frequency"] = power @ frequency
    band = torch.bucketize(frequency, torch.tensor(BANDS, dtype=power.dtype))
    shares = power.new_zeros(len(power), len(BANDS) + 1).index_add(1, band, power)
    columns |= {f"share of band {number}": shares[:, number] for number in range(len(BANDS) + 1)}
    step = course.diff(dim=1)
    turned = (step[:, 1:] * step[:, :-1] < 0) & (step[:, 1:].abs() > 0.05 * top)
    done = course.clamp(min=0).cumsum(dim=1) / course.clamp(min=0).sum(dim=1, keepdim=True).clamp(min=1e-6)
    columns |= {"variation": step.abs().sum(dim=1) / top[:, 0], "reversals": turned.float().sum(dim=1)}
    return columns | {
        f"time of {part} of it": (done < part).float().sum(dim=1) for part in (0.1, 0.25, 0.5, 0.75, 0.9)
    }


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
    moved = touches.to("cpu")
    columns = engineered_features(moved)
    if task.direction:
        columns |= direction_features(moved)
    if task.kind == "regression":
        columns |= sensor_features(moved)
    return torch.stack([column.to(torch.float32) for column in columns.values()], dim=1).numpy()


# Signed features of the direction of sliding, along x and along y.


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
