"""Embeddings of whole graphs that never see the labels: Graph2Vec, GL2Vec, invariant (report, 3.2.4).

All take graphs of one topology, as the frames of one layout have it; what differs are the nodes' labels.
Documents of several layouts may be embedded together.
"""

from collections.abc import Sequence

import numpy as np

from skin.errors import InputError

_POWERS = 5
_EIGENVALUES = 10
_BINS = 20


def levels(readings: np.ndarray, count: int) -> np.ndarray:
    """Return readings (B, S), N, as whole numbers 0 to count - 1: equal steps from 0 N to the largest."""
    top = max(float(readings.max()), np.finfo(float).tiny)
    return np.clip((readings / top * count).astype(np.int64), 0, count - 1)


def subtrees(labels: np.ndarray, linked: np.ndarray, depth: int = 2) -> np.ndarray:
    """Return the Weisfeiler-Lehman words of graphs: each node's rooted subtrees of depth 0 to ``depth``.

    A word is a 64-bit hash of a node's word one level down and of its neighbours' ones in any order, so words
    of graphs of different topology can be compared (Shervashidze et al. 2011; Narayanan et al. 2017,
    algorithm 2).

    Args:
        labels: (B, S), whole numbers.
        linked: (S, S), bool, symmetric: which nodes are neighbours.
        depth: of the deepest subtrees.

    Returns:
        (B, (depth + 1) * S), uint64.
    """
    links = linked.astype(np.uint64)
    words = [_mix(labels.astype(np.uint64))]
    for _ in range(depth):
        # A sum does not depend on the order of the neighbours.
        words.append(_mix(words[-1] ^ _mix(_mix(words[-1]) @ links)))
    return np.concatenate(words, axis=1)


def line_graph(labels: np.ndarray, weights: np.ndarray, steps: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Return the labels (B, E) and links (E, E) of the line graph: a node per edge, linked where edges meet.

    An edge's label tells the labels of both its ends, in any order, and its weight in ``steps`` equal steps
    (Chen and Koga 2019: line graphs with edge features).

    Args:
        labels: (B, S), whole numbers.
        weights: (S, S), symmetric, 0 where there is no edge.
        steps: in which weights are told apart.
    """
    one, other = np.nonzero(np.triu(weights, 1))
    weight = weights[one, other]
    step = np.minimum((weight / weight.max(initial=1e-300) * steps).astype(np.uint64), np.uint64(steps - 1))
    ends = np.sort(_mix(np.stack([labels[:, one], labels[:, other]], axis=-1).astype(np.uint64)), axis=-1)
    found = _mix(_mix(ends[..., 0] ^ step) ^ ends[..., 1])
    meet = np.zeros((len(one), len(labels[0])), dtype=int)
    meet[np.arange(len(one)), one] = meet[np.arange(len(one)), other] = 1
    linked = meet @ meet.T > 0
    np.fill_diagonal(linked, False)
    return found, linked


def doc2vec(documents: Sequence[np.ndarray], width: int, epochs: int, seed: int) -> np.ndarray:
    """Return the vectors (B, width) of documents of words, by PV-DBOW (Le and Mikolov 2014).

    Graph2Vec is this on the words of :func:`subtrees`; GL2Vec appends the same on those of the line graph.
    Learning rate, rarest word and subsampling are the usual ones of Graph2Vec (Karate Club).

    Raises:
        InputError: gensim is not installed.
    """
    try:
        from gensim.models.doc2vec import Doc2Vec, TaggedDocument
    except ImportError:
        raise InputError(
            'Graph2Vec and GL2Vec need gensim: python -m pip install -c constraints.txt -e ".[embeddings]"'
        ) from None
    tagged = [TaggedDocument(list(map(str, words)), [number]) for number, words in enumerate(documents)]
    model = Doc2Vec(
        tagged,
        vector_size=width,
        dm=0,
        window=0,
        min_count=5,
        sample=1e-4,
        alpha=0.025,
        epochs=epochs,
        workers=1,  # more would not be repeatable
        seed=seed,
    )
    return model.dv.vectors


def invariant(labels: np.ndarray, weights: np.ndarray, count: int) -> np.ndarray:
    """Return the invariant embedding of graphs (Galland and Lelarge 2019, with Karate Club's three parts).

    The labels' mean after 1 to 5 steps of a random walk; the 10 smallest eigenvalues of the Laplacian L; and
    a histogram of the nodes' pairwise similarities in spectral space, the entries of L's pseudo-inverse.
    Weights are taken relative to their mean. Only the first part sees the labels.

    Args:
        labels: (B, S), whole numbers from 0 to count - 1.
        weights: (S, S), symmetric, 0 where there is no edge.
        count: of different labels.

    Returns:
        (B, 5 count + 10 + 20).
    """
    edges = weights / weights[weights > 0].mean() if weights.any() else weights
    degree = edges.sum(axis=1)
    walk = edges / np.maximum(degree, np.finfo(float).tiny)[:, None]
    values, vectors = np.linalg.eigh(np.diag(degree) - edges)
    smallest = np.pad(values[:_EIGENVALUES], (0, max(0, _EIGENVALUES - len(values))))
    real = values > 1e-9
    similar = vectors[:, real] / values[real] @ vectors[:, real].T
    histogram = np.histogram(np.clip(similar, -1, 1), bins=_BINS, range=(-1, 1))[0]
    hot = np.eye(count)[labels]
    reach, parts = np.full(len(weights), 1 / len(weights)), []
    for _ in range(_POWERS):
        reach = reach @ walk
        parts.append(np.einsum("s,bsl->bl", reach, hot))
    fixed = np.concatenate([smallest, histogram / similar.size])
    return np.concatenate([*parts, np.tile(fixed, (len(labels), 1))], axis=1)


def _mix(values: np.ndarray) -> np.ndarray:
    """Return values (...), uint64, scattered over all 64 bits (splitmix64, Steele et al. 2014)."""
    values = values + np.uint64(0x9E3779B97F4A7C15)
    values = (values ^ (values >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    values = (values ^ (values >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return values ^ (values >> np.uint64(31))
