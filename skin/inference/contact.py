"""One contact: boxes of positions and radii, refined where the probability is."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.special import log_ndtr, logsumexp, softmax

from skin.inference.candidates import Boxes, CandidateReadings, FingertipPrior
from skin.inference.likelihood import (
    NEGLIGIBLE,
    Forces,
    Observation,
    blend,
    fit_force,
    integrate_force,
    invert_on_prior,
    needed_force,
    refit_force,
    spread_readings,
)
from skin.inference.noise import Noise

# Without friction, and with it. There the first values take 1.5 times as long, and move means by 0.02
# deviations (median; 99 %: 0.2), and deviations by up to 2 % on average. Without friction, 1e-6 makes
# forces 5 % too narrow.
_LENGTH = (1.8, 2.5)  # a box is split along an axis that is longer, in standard deviations
_DROPPED = (1e-7, 1e-5)  # estimated probability that a refinement may lose
_REST = 1e-5  # the same of the boxes in the end
_MOST, _FEW = 500, 64  # boxes, and those of a contact that does not matter
_ROUNDS = 12
_FORCE_STEP = 0.5  # largest change of the logarithm of the force over a box
_RADIUS_STEP = 0.3  # largest fraction of the radii in a box


@dataclass(frozen=True)
class Cloud:
    """Posterior of one contact as weighted boxes.

    Attributes:
        boxes: N of them.
        force: (N, J), N.
        weight: (N, J), probabilities that sum to 1.
        evidence: log of the likelihood integrated over the prior.
        misfit: posterior mean of the squared misfit in variances.
        tangential, variance: (N, J, 2), mean and variance of the force along x and y, N; (N, J, 0) without
            friction.
        mode: (4 or 6,), the most probable contact: x, y and radius, m, and forces inwards, along x and y, N.
    """

    boxes: Boxes
    force: np.ndarray
    weight: np.ndarray
    evidence: float
    misfit: float
    tangential: np.ndarray
    variance: np.ndarray
    mode: np.ndarray


class _Leaves(NamedTuple):
    """Boxes with what is computed of them.

    Attributes:
        boxes: N of them.
        rows: (N, 4, L, S), as of :meth:`skin.inference.candidates.CandidateReadings.at`.
        spread: (N, S), variance from gains, thickness and positions per square newton.
        forces: of the boxes.
        evidence: (N,), log of the probability in a box.
    """

    boxes: Boxes
    rows: np.ndarray
    spread: np.ndarray
    forces: Forces
    evidence: np.ndarray

    def take(self, which: np.ndarray) -> "_Leaves":
        """Return some of the boxes."""
        return _each(lambda values: values[which], self)

    @staticmethod
    def join(parts: "Sequence[_Leaves]") -> "_Leaves":
        """Return the boxes of all parts."""
        return _each(lambda *values: np.concatenate(values), *parts)


def _each(change: Callable[..., np.ndarray], *parts: Any) -> Any:
    """Return nested tuples of what a change makes of each of their arrays."""
    changed = (
        change(*same) if isinstance(same[0], np.ndarray) else _each(change, *same)
        for same in zip(*parts, strict=True)
    )
    return type(parts[0])(*changed)


def blur_first(candidates: CandidateReadings, noise: Noise) -> tuple[np.ndarray, np.ndarray]:
    """Return the relative variance of the first boxes, without and with their width; common to all frames."""
    return spread_readings(noise, candidates.rows, candidates.boxes.width)


def one_contact(
    candidates: CandidateReadings,
    prior: FingertipPrior,
    frame: Observation,
    first: tuple[np.ndarray, np.ndarray] | None = None,
    least: float = -math.inf,
) -> Cloud:
    """Return the posterior of one contact.

    Args:
        candidates: of the skin.
        prior: of the contact.
        frame: the frame.
        first: of :func:`blur_first` for the noise of the frame; None: it is computed.
        least: log evidence below which a contact does not matter: the best of the first boxes stand for it.
    """
    spread, blurred = first or blur_first(candidates, frame.noise)
    boxes = candidates.boxes
    forces, evidence = fit_force(frame, prior, candidates.readings, blurred)
    # The first boxes have the same width.
    evidence = evidence + math.log(boxes.width[0].prod())
    active = _Leaves(boxes, candidates.rows, spread, forces, evidence)
    leaves = list[_Leaves]()
    whole = float(logsumexp(evidence) - np.log(np.prod(candidates.size) * candidates.span))
    if whole < least:
        best = active.take(np.argsort(-evidence, kind="stable")[:_FEW])
        return replace(_weigh(candidates, frame, prior, best), evidence=whole)
    length, dropped = (pair[candidates.friction > 0] for pair in (_LENGTH, _DROPPED))
    for _ in range(_ROUNDS):
        kept = _probable(active.evidence, [part.evidence for part in leaves], dropped)
        active = active.take(kept)
        _, information, turn = _expand(frame, prior, active)
        lengths = np.sqrt(np.maximum(np.diagonal(information, axis1=1, axis2=2), 0)) * active.boxes.width
        lengths = np.maximum(lengths, np.abs(turn) * active.boxes.width * (length / _FORCE_STEP))
        lengths[:, 2] = np.maximum(lengths[:, 2], active.boxes.width[:, 2] / (_RADIUS_STEP * candidates.span))
        cut = lengths > length
        many = sum(len(part.evidence) for part in leaves) + (1 << cut.sum(1)).sum() > _MOST
        if many:
            # Where there are many boxes, each is cut along its longest axis alone.
            cut &= lengths == lengths.max(1, keepdims=True)
        split = cut.any(1)
        if len(kept) > _MOST or not split.any():
            break
        leaves.append(active.take(np.flatnonzero(~split)))
        boxes = Boxes(active.boxes.centre[split], active.boxes.width[split]).split(cut[split])
        active = _judge(frame, prior, boxes, candidates.at(boxes.centre))
    every = _Leaves.join([*leaves, active])
    return _weigh(candidates, frame, prior, every.take(_probable(every.evidence, [], _REST)))


def _judge(frame: Observation, prior: FingertipPrior, boxes: Boxes, rows: np.ndarray) -> _Leaves:
    """Return boxes with their probability, as if each were blurred over its width."""
    spread, blurred = spread_readings(frame.noise, rows, boxes.width)
    forces, evidence = fit_force(frame, prior, rows[:, 0], blurred)
    return _Leaves(boxes, rows, spread, forces, evidence + np.log(boxes.width.prod(1)))


def _probable(evidence: np.ndarray, others: list[np.ndarray], dropped: float) -> np.ndarray:
    """Return the indices of what holds nearly all probability, in their order, beside that of others."""
    top = max(float(part.max()) for part in [evidence, *others] if len(part))
    probability = np.exp(evidence - top)
    order = np.argsort(probability)
    lost = np.cumsum(probability[order], dtype=float)
    whole = lost[-1] + sum(float(np.exp(part - top).sum()) for part in others)
    return np.sort(order[lost > dropped * whole])


def _expand(
    frame: Observation, prior: FingertipPrior, leaves: _Leaves, kind: type = np.float32
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return slope (N, 3), 1/m, and information (N, 3, 3), 1/m^2, of the log likelihood in boxes.

    Derivatives are by position and radius, with the force integrated, which depends on both: the last result
    is the derivative of its mean logarithm, (N, 3), 1/m.
    """
    rows, force = leaves.rows, np.exp(leaves.forces.mode)[:, None]
    mean, *_ = leaves.forces.tangent(force)
    # The readings and their derivatives, then what the tangential force changes.
    every = blend(rows.reshape(-1, *rows.shape[2:]), mean.repeat(4, axis=0)).reshape(-1, 4, rows.shape[3])
    every = np.concatenate([every, rows[:, 0, 1:]], axis=1).astype(kind) * force[..., None]
    predicted = every[:, 0]
    variance = np.float32(frame.noise.floor) + force * force * leaves.spread
    weight = frame.counts / variance
    pull = weight * (frame.readings - predicted)
    left = (every[:, :4] @ pull[..., None])[..., 0]
    gram = (every * weight[:, None]) @ every.transpose(0, 2, 1)
    # The tangential force follows what changes, and then the force.
    across = gram[:, :4, 4:]
    gram = gram[:, :4, :4] - across @ invert_on_prior(gram[:, 4:, 4:])[0] @ across.transpose(0, 2, 1)
    distance = (leaves.forces.mode - math.log(prior.force)) / prior.spread**2
    turn = -gram[:, 1:, 0] / (gram[:, :1, 0] + 1 / prior.spread**2)
    slope = left[:, 1:] + turn * (left[:, 0] - distance)[:, None]
    information = gram[:, 1:, 1:] + gram[:, 1:, :1] * turn[:, None]
    if len(frame.clipped):
        # A sensor that clips is most informative where it needs the most probable force.
        needed, _, width, sensor = needed_force(frame, rows[:, 0], leaves.spread, leaves.forces)
        above = ((leaves.forces.mode - needed) / width)[:, None]
        hazard = np.exp(-0.5 * above**2 - log_ndtr(above)) / math.sqrt(2 * math.pi)
        which = rows[np.arange(len(rows)), :, 0, sensor]
        rise = (
            (turn + which[:, 1:] / np.maximum(which[:, :1], NEGLIGIBLE))
            * (which[:, :1] > NEGLIGIBLE)
            / width[:, None]
        )
        share = hazard * (hazard + above)  # of the force that follows what the sensor needs
        sharper = information + (share * rise)[..., None] * rise[:, None]
        return slope + hazard * rise, sharper, turn - share * rise * width[:, None]
    return slope, information, turn


def _average(
    frame: Observation, prior: FingertipPrior, leaves: _Leaves
) -> tuple[Boxes, np.ndarray, np.ndarray]:
    """Return what a box holds, as a smaller box, and the log of the mean of the likelihood by its middle's.

    The last result, (2, N), holds how much mean and variance of the log force exceed those in the middle.

    To second order, with a normal distribution in place of the uniform one over the box.
    """
    # In double precision: what the force explains is subtracted, and may be nearly all.
    slope, information, turn = _expand(frame, prior, leaves, float)
    centre, width = leaves.boxes
    # In units of the standard deviation over a box.
    unit = width / math.sqrt(12)
    slope, information = slope * unit, information * unit[:, :, None] * unit[:, None] + np.eye(3)
    covariance = np.linalg.inv(information)
    moved = np.vecdot(covariance, slope[:, None])
    factor = 0.5 * (np.vecdot(slope, moved) - np.log(np.maximum(np.linalg.det(information), 1)))
    inside = np.clip(moved, -1.5, 1.5)
    factor = np.where((inside == moved).all(1), factor, np.vecdot(slope, inside) / 2)
    narrow, turn = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)), turn * unit
    shift = np.vecdot(turn, inside)
    wider = np.maximum(np.vecdot(turn, np.vecdot(covariance, turn[:, None])), 0)
    return Boxes(centre + inside * unit, width * narrow), factor, np.stack([shift, wider])


def _weigh(
    candidates: CandidateReadings, frame: Observation, prior: FingertipPrior, leaves: _Leaves
) -> Cloud:
    """Return the posterior of boxes."""
    readings, spread = leaves.rows[:, 0], leaves.spread
    fit = refit_force(frame, prior, readings, spread, leaves.forces.mode)
    leaves = leaves._replace(forces=fit)
    boxes, factor, further = _average(frame, prior, leaves)
    force, logs, tangent, variances = integrate_force(frame, prior, readings, spread, fit)
    share, logarithm = softmax(logs, axis=1), np.log(force)
    middle = np.vecdot(share, logarithm)[:, None]
    side = candidates.friction * force[..., None]
    logarithm -= middle
    stretch = np.sqrt(1 + further[1] / np.maximum(np.vecdot(share, logarithm**2), 0.01 / fit.curvature))
    force = np.exp(middle + np.clip(further[0], -1, 1)[:, None] + logarithm * stretch[:, None])
    middle = np.exp(middle)
    logs = logs + (np.log(leaves.boxes.width.prod(1)) + factor)[:, None]
    total = logsumexp(logs)
    weight = np.exp(logs - total)
    mean, covariance, _ = fit.tangent(middle)
    variance = frame.noise.floor + middle * middle * spread
    misfit = ((frame.readings - middle * blend(readings, mean)[:, 0]) ** 2 / variance) @ frame.counts
    # Each parameter that readings determine and that is integrated misses by a variance.
    misfit += 1 + mean.shape[2] - np.trace(covariance[:, 0], axis1=1, axis2=2)
    evidence = float(total - np.log(np.prod(candidates.size) * candidates.span))
    sides, best = side * tangent, np.unravel_index(weight.argmax(), weight.shape)
    mode = np.array([*boxes.centre[best[0]], force[best], *sides[best]])
    misfit = float(weight.sum(1) @ misfit)
    return Cloud(boxes, force, weight, evidence, misfit, sides, side**2 * variances, mode)
