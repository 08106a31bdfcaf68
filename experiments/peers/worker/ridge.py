"""Ridges on any number of touches, and probabilities from their scores."""

from collections.abc import Iterator

import numpy as np
from scipy.linalg import solve
from sklearn.linear_model import LogisticRegression

STRENGTHS = np.logspace(0, 6, 7)
"""Strengths that are tried; each takes a factorisation of D x D."""


def normal_equations(
    parts: Iterator[tuple[np.ndarray, np.ndarray]], validation: np.ndarray, held: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return weights (D, L) and biases (L,) of ridges, from any number of touches in the memory of D x D.

    Args:
        parts: features (b, D) and targets (b, L); the features are read once.
        validation: features (B, D).
        held: targets (B, L); of each label, the strength with the smallest squared error on them is used.
    """
    width, labels = validation.shape[1], held.shape[1]
    count, gram, cross = 0, np.zeros((width, width)), np.zeros((width, labels))
    total, mean = np.zeros(labels), np.zeros(width)
    # Features may vary little around a large mean, so products are of what is left, in double precision.
    centre = validation.mean(axis=0, dtype=float)
    for table, truth in parts:
        left = table - centre
        gram += left.T @ left
        cross += left.T @ truth
        count, total, mean = count + len(table), total + truth.sum(0), mean + left.sum(0)
    total, mean = total / count, mean / count
    gram -= count * np.outer(mean, mean)
    cross -= count * np.outer(mean, total)
    held_out = validation - (centre + mean).astype(np.float32)
    best, least = np.zeros_like(cross), np.full(len(total), np.inf)
    diagonal = np.einsum("ii->i", gram)
    plain = diagonal.copy()
    for alpha in STRENGTHS:
        diagonal[:] = plain + alpha
        weights = solve(gram, cross, assume_a="pos")
        errors = np.square(held_out @ weights.astype(np.float32) + total - held).mean(0)
        better = errors < least
        best[:, better], least[better] = weights[:, better], errors[better]
    return best, total - (centre + mean) @ best


def platt(score: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Return slope and offset of the logistic curve through scores (B,), with the targets of Platt (1999)."""
    positive = truth.sum()
    target = np.where(truth == 1, (positive + 1) / (positive + 2), 1 / (len(truth) - positive + 2))
    twice = np.concatenate([score, score])[:, None]
    sides = np.repeat([1, 0], len(score))
    curve = LogisticRegression(C=np.inf).fit(twice, sides, sample_weight=np.concatenate([target, 1 - target]))
    return curve.coef_.item(), curve.intercept_.item()
