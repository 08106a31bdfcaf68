"""Graph embeddings without training, and what they tell of a touch (report, 3.2.4).

Graph2Vec, GL2Vec and an invariant embedding never see the labels. All take graphs of one topology, as the
frames of one layout have it; what differs are the nodes' labels. Documents of several layouts may be
embedded together. An SVM tells what is in them, and the variance that labels and layouts explain.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from statistics import fmean, stdev
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from sklearn.decomposition import PCA
from sklearn.manifold import TSNE
from sklearn.model_selection import GridSearchCV
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC

from experiments.studies.comparison import combine_verdicts, judge_claim, paired
from experiments.studies.measures import ProbeSettings
from experiments.studies.pages import Page
from skin.device.base import AbstractDevice
from skin.device.touches import Touches
from skin.errors import InputError
from skin.evaluation.report import scattered_devices
from skin.learning.graph import adjacency, neighbours
from skin.learning.learner import AbstractLearner
from skin.plot.figures import COLOURS, MARKS

_POWERS = 5
_EIGENVALUES = 10
_BINS = 20

FRAME = "readings, one frame"

_FIRST_SEED = 1_000_000  # no training draws from these
_COSTS = (0.1, 1, 10, 100)
_FOLDS = 3


class Space(NamedTuple):
    """Touches in an embedding's space.

    Attributes:
        vectors: (B, E), the SVM's training touches first.
        labels: (B, L), 0 or 1, int.
        train: how many of them the SVM is trained on.
        mixed: (B', E), touches on several layouts; None where the device has one layout.
        layouts: (B',), which layout, int.
        mixed_labels: (B', L), of the same touches.
    """

    vectors: np.ndarray
    labels: np.ndarray
    train: int
    mixed: np.ndarray | None
    layouts: np.ndarray
    mixed_labels: np.ndarray


class ProbeResult(NamedTuple):
    """Result of probing one embedding with one seed.

    Attributes:
        attribute: degree, reading, or nothing where the input is no graph embedding.
        name: of the input.
        seed: which draw of touches.
        accuracy: label -> share of the held-out touches that the SVM labels rightly, nan where it had no
            choice; ``layout`` of the touches on several layouts.
        explained: label or ``layout`` -> share of the variance on several layouts that it explains.
        space: where the touches lie.
    """

    attribute: str
    name: str
    seed: int
    accuracy: dict[str, float]
    explained: dict[str, float]
    space: Space


def probe(
    device: AbstractDevice, settings: ProbeSettings, learner: AbstractLearner | None
) -> Iterator[ProbeResult]:
    """Yield the result of each input and seed: graph embeddings, those of a trained encoder, plain readings.

    A simulated device draws new touches for each seed, separate from all training data; other devices use
    their train and test splits, once. Embeddings use the readings of all touches, but no labels.
    """
    if device.task.direction:
        raise InputError("embeddings are probed for labels that hold or not: set data.direction=false")
    for seed in settings.seeds if device.simulation else settings.seeds[:1]:
        touches, mixed = _touches(device, settings, seed), _layouts(device, settings, seed)
        for (attribute, name), vectors in _inputs([*touches, *mixed], settings, seed, learner):
            yield _probed(attribute, name, seed, _space(vectors, touches, mixed), device.task.names)


def strongest(touches: Touches) -> np.ndarray:
    """Return the readings (B, S), N, of each touch's strongest frame, 0 where not valid."""
    readings = touches.readings.where(touches.valid, 0).numpy()
    return readings[np.arange(len(readings)), readings.sum(axis=2).argmax(axis=1)]


def svm_accuracy(vectors: np.ndarray, classes: np.ndarray, train: int) -> float:
    """Return the share of ``vectors[train:]`` that an SVM trained on the others puts into its class (B,).

    Radial basis functions on standardised vectors, the cost chosen by cross-validation among the training
    ones only (report, 2.2.2). nan where some class is too rare to learn.
    """
    if np.unique(classes[:train], return_counts=True)[1].min() < _FOLDS or np.ptp(classes[:train]) == 0:
        return float("nan")
    machine = make_pipeline(StandardScaler(), SVC())
    search = GridSearchCV(machine, {"svc__C": _COSTS}, cv=_FOLDS)
    return float(search.fit(vectors[:train], classes[:train]).score(vectors[train:], classes[train:]))


def explained(vectors: np.ndarray, classes: np.ndarray) -> float:
    """Return the share of the variance of vectors (B, E) that lies between classes (B,); 0 if all are one."""
    centred = vectors - vectors.mean(axis=0)
    means = [(classes == number, centred[classes == number].mean(axis=0)) for number in np.unique(classes)]
    between = sum(which.sum() * (mean**2).sum() for which, mean in means)
    # Where nothing but the last bit differs there is no variance to explain.
    whole = (centred**2).sum()
    return float(between / whole) if whole > 1e-12 * (vectors**2).sum() else 0.0


def _graph_vectors(
    sets: Sequence[Touches], attribute: str, settings: ProbeSettings, seed: int
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield each graph embedding (B, E) of the strongest frames of touches, one layout per set.

    GL2Vec gives half its width to the graph and half to its line graph.
    """
    if any(touches.positions.ndim > 2 for touches in sets):
        raise InputError("graph embeddings need sensors that stay in place, these have one layout per touch")
    frames = [strongest(touches) for touches in sets]
    places = [touches.positions.double().numpy() for touches in sets]
    edges, count, weight = (settings.graph[name] for name in ("edges", "count", "weight"))
    weights = [adjacency(matrix, neighbours(matrix, edges, count), weight) for matrix in places]
    if attribute == "degree":
        labels = [
            np.tile((matrix > 0).sum(0), (len(f), 1)) for matrix, f in zip(weights, frames, strict=True)
        ]
    else:
        ends = np.cumsum([len(frame) for frame in frames])[:-1]
        labels = np.split(levels(np.concatenate(frames), settings.levels), ends)
    pairs = list(zip(labels, weights, strict=True))
    words = [row for label, matrix in pairs for row in subtrees(label, matrix > 0, settings.depth)]
    yield "Graph2Vec", doc2vec(words, settings.width, settings.epochs, seed)
    lines = [row for pair in pairs for row in subtrees(*line_graph(*pair), settings.depth)]
    half = [doc2vec(documents, settings.width // 2, settings.epochs, seed) for documents in (words, lines)]
    yield "GL2Vec", np.concatenate(half, axis=1)
    kinds = 1 + max(int(label.max()) for label in labels)
    yield "IGE", np.concatenate([invariant(label, matrix, kinds) for label, matrix in pairs])


def _inputs(
    sets: Sequence[Touches], settings: ProbeSettings, seed: int, learner: AbstractLearner | None
) -> Iterator[tuple[tuple[str, str], np.ndarray]]:
    for attribute in settings.attributes:
        for name, vectors in _graph_vectors(sets, attribute, settings, seed):
            yield (attribute, name), vectors
    if learner is not None:
        encoded = [learner.embeddings(touches).numpy() for touches in sets]
        yield ("", "trained encoder"), np.concatenate(encoded)
    yield ("", FRAME), np.concatenate([strongest(touches) for touches in sets])
    windows = [touches.readings.where(touches.valid, 0).flatten(1).numpy() for touches in sets]
    yield ("", "readings, window"), np.concatenate(windows)


def _space(vectors: np.ndarray, touches: Sequence[Touches], mixed: Sequence[Touches]) -> Space:
    count = sum(map(len, touches))
    layouts = np.repeat(np.arange(len(mixed)), [len(layout) for layout in mixed])
    labels = _labels(touches)
    mixed_labels = _labels(mixed) if mixed else labels[:0]
    return Space(
        vectors[:count], labels, len(touches[0]), vectors[count:] if mixed else None, layouts, mixed_labels
    )


def _probed(attribute: str, name: str, seed: int, space: Space, names: Sequence[str]) -> ProbeResult:
    columns = zip(names, space.labels.T, strict=True)
    right = {label: svm_accuracy(space.vectors, classes, space.train) for label, classes in columns}
    shares: dict[str, float] = {}
    if space.mixed is not None:
        shares = {"layout": explained(space.mixed, space.layouts)}
        columns = zip(names, space.mixed_labels.T, strict=True)
        shares |= {label: explained(space.mixed, classes) for label, classes in columns}
        order = np.random.default_rng(seed).permutation(len(space.mixed))
        right["layout"] = svm_accuracy(space.mixed[order], space.layouts[order], len(order) * 2 // 3)
    return ProbeResult(attribute, name, seed, right, shares, space)


def _touches(device: AbstractDevice, settings: ProbeSettings, seed: int) -> list[Touches]:
    """Return the touches of one layout, those to train the SVM on first."""
    count = settings.train + settings.test
    if device.simulation is not None:
        drawn = device.simulation.replace(data_seed=_FIRST_SEED + seed, gestures=count).recording().touches
        return [drawn[: settings.train], drawn[settings.train :]]
    return [device.touches("train")[: settings.train], device.touches("test")[: settings.test]]


def _layouts(device: AbstractDevice, settings: ProbeSettings, seed: int) -> list[Touches]:
    """Return as many other touches on each of some scattered layouts; none where that cannot be."""
    if device.simulation is None or settings.layouts < 2:
        return []
    try:
        others = list(scattered_devices(device.simulation, settings.layouts))
    except InputError:  # this number of sensors cannot form a grid
        return []
    draws = (_FIRST_SEED * (2 + number) + seed for number in range(settings.layouts))
    return [
        other.replace(data_seed=draw, gestures=settings.test).recording().touches
        for other, draw in zip(others, draws, strict=True)
    ]


def _labels(sets: Sequence[Touches]) -> np.ndarray:
    return np.concatenate([touches.known_labels.numpy() for touches in sets]).astype(int)


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
    start, end = np.nonzero(np.triu(weights, 1))
    weight = weights[start, end]
    step = np.minimum((weight / weight.max(initial=1e-300) * steps).astype(np.uint64), np.uint64(steps - 1))
    ends = np.sort(_mix(np.stack([labels[:, start], labels[:, end]], axis=-1).astype(np.uint64)), axis=-1)
    hashes = _mix(_mix(ends[..., 0] ^ step) ^ ends[..., 1])
    meet = np.zeros((len(start), len(labels[0])), dtype=int)
    meet[np.arange(len(start)), start] = meet[np.arange(len(start)), end] = 1
    linked = meet @ meet.T > 0
    np.fill_diagonal(linked, False)
    return hashes, linked


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


_ABOUT = """\
The labels: accuracy on held-out touches of an SVM (radial basis functions on standardised vectors, cost
chosen by cross-validation on the training touches). Graph embeddings and "readings, one frame" see the
strongest frame of a touch alone, the encoder and "readings, window" all: one frame does not tell how long
or where to. Layout: the same SVM on touches of several scattered layouts, whose graphs differ in
morphology; beside it the share of an embedding's variance there that the layout explains, and the share
that the best label does. On one layout all graphs have one morphology: labelled by degree, as Graph2Vec
usually is, they are all equal.
"""
_Figure = Callable[[ProbeResult], float]


def build_embeddings_page(results: Sequence[ProbeResult], names: Sequence[str]) -> Page:
    """Return the table, the verdicts, and figure 5 of the report, of the first seed."""
    table = embeddings_table(results, names)
    about = f"{_ABOUT}\n" + "".join(f"- {line}\n" for line in embedding_statements(results, names))
    figure = spaces([result for result in results if result.seed == results[0].seed], names)
    return Page(about, {"What an SVM reads in embeddings, accuracy in per cent": table}, table, figure)


def planes(vectors: np.ndarray, points: int = 400) -> np.ndarray:
    """Return the first touches in the plane, (points, 2): PCA to 30 axes, then t-SNE (report, 2.2.2)."""
    few = np.asarray(vectors[:points], dtype=float)
    # Neither method works on vectors that are all equal.
    if np.ptp(few, axis=0).max() < 1e-9:
        return np.zeros((len(few), 2))
    reduced = PCA(min(30, *few.shape), random_state=0).fit_transform(few)
    return TSNE(perplexity=min(30.0, (len(few) - 1) / 3), init="pca", random_state=0).fit_transform(reduced)


def spaces(results: Sequence[ProbeResult], names: Sequence[str], points: int = 400) -> Figure:
    """Draw one row of planes per embedding, coloured by each label and by the layout (report, figure 5).

    Args:
        results: of one seed.
        names: of the labels.
        points: touches in each panel.
    """
    columns = len(names) + (results[0].space.mixed is not None)
    figure = Figure(figsize=(2.1 * columns, 2.0 * len(results)), layout="constrained")
    axes = figure.subplots(len(results), columns, squeeze=False)
    for row, result in zip(axes, results, strict=True):
        plane = planes(result.space.vectors, points)
        for axis, classes in zip(row, result.space.labels.T, strict=False):
            _scatter(axis, plane, classes[:points])
        if result.space.mixed is not None:
            order = np.random.default_rng(0).permutation(len(result.space.mixed))[:points]
            _scatter(row[-1], planes(result.space.mixed[order], points), result.space.layouts[order])
        row[0].set_ylabel(_title(result), fontsize=8)
    for axis, name in zip(axes[0], [*names, "layout"], strict=False):
        axis.set_title(name)
    figure.supxlabel("square: the label holds, circle: it does not; each layout has a mark", fontsize=8)
    return figure


def embeddings_table(results: Sequence[ProbeResult], names: Sequence[str]) -> list[list[str]]:
    """Return the table, its head first: accuracies and shares of variance in per cent, means over seeds."""
    head = ["input", *names, "mean", "layout", "variance: layout", "variance: best label"]
    table = [head]
    for group in _groups(results).values():
        labels = [[result.accuracy[name] for result in group] for name in names]
        means = [_mean(result, names) for result in group]
        layout = [result.accuracy["layout"] for result in group if "layout" in result.accuracy]
        shares = [result.explained for result in group if result.explained]
        variance = (
            [share["layout"] for share in shares],
            [max(share[name] for name in names) for share in shares],
        )
        table.append([_title(group[0]), *map(_percent, [*labels, means, layout, *variance])])
    return table


def embedding_statements(results: Sequence[ProbeResult], names: Sequence[str]) -> list[str]:
    """Return verdicts on the report's statements about pretrained embeddings (3.2.4), one line each.

    A statement holds if it holds for each embedding. Agree and disagree need the margin of at least
    three seeds; "chance" has a tolerance of two points.
    """
    groups = _groups(results)
    frame = {result.seed: _mean(result, names) for result in groups[("", FRAME)]}
    claims: tuple[tuple[str, str, _Figure, _Figure], ...] = (
        (
            "emphasise the graph's morphology (variance explained by layout over best label)",
            "greater",
            lambda result: result.explained["layout"],
            lambda result: max(result.explained[name] for name in names),
        ),
        (
            "are not purposeful on a fixed layout (mean accuracy below the readings of the same frame)",
            "less",
            lambda result: _mean(result, names),
            lambda result: frame[result.seed],
        ),
        (
            "leave an SVM at chance (mean accuracy over the commoner class)",
            "no better",
            lambda result: _mean(result, names),
            _chance,
        ),
    )
    lines = []
    for attribute in dict.fromkeys(result.attribute for result in results if result.attribute):
        mine = [group for key, group in groups.items() if key[0] == attribute]
        for says, claim, figure, reference in claims:
            verdicts = [_compare(group, claim, figure, reference) for group in mine]
            whole = combine_verdicts([word for word, _ in verdicts])
            details = "; ".join(detail for _, detail in verdicts)
            lines.append(f"Nodes labelled by {attribute}: the embeddings {says}: **{whole}**. {details}.")
    return lines


def _compare(
    group: Sequence[ProbeResult], claim: str, figure: _Figure, reference: _Figure
) -> tuple[str, str]:
    """Return the verdict on a claim about one embedding, and its figures."""
    able = [result for result in group if result.explained or claim != "greater"]
    left, right = ({str(result.seed): value(result) for result in able} for value in (figure, reference))
    difference = paired(left, right)
    word = judge_claim(claim, difference, by=0.02)
    if difference is None:
        return word, f"{group[0].name} has one layout only ({word})"
    spread = f" ± {100 * difference.margin:.1f}" if difference.seeds > 1 else ""
    return word, f"{group[0].name} {100 * difference.mean:+.1f}{spread} points ({word})"


def _groups(results: Iterable[ProbeResult]) -> dict[tuple[str, str], list[ProbeResult]]:
    """Return the results of each input, by seed."""
    groups: dict[tuple[str, str], list[ProbeResult]] = {}
    for result in results:
        groups.setdefault((result.attribute, result.name), []).append(result)
    return groups


def _mean(result: ProbeResult, names: Sequence[str]) -> float:
    """Return the mean accuracy over the labels that could be learnt."""
    return float(np.nanmean([result.accuracy[name] for name in names]))


def _chance(result: ProbeResult) -> float:
    """Return the mean share of the held-out touches that are of their label's commoner class."""
    share = result.space.labels[result.space.train :].mean(axis=0)
    return float(np.maximum(share, 1 - share).mean())


def _title(result: ProbeResult) -> str:
    return f"{result.name}, {result.attribute}" if result.attribute else result.name


def _percent(values: Sequence[float]) -> str:
    """Return the mean of shares in per cent, with the deviation over seeds if there are several."""
    if not values or np.isnan(values).any():
        return ""
    spread = f" ± {100 * stdev(values):.1f}" if len(values) > 1 else ""
    return f"{100 * fmean(values):.1f}{spread}"


def _scatter(axis: Axes, plane: np.ndarray, classes: np.ndarray) -> None:
    for number in np.unique(classes):
        x, y = plane[classes == number].T
        colour, mark = COLOURS[number % len(COLOURS)], MARKS[number % len(MARKS)]
        axis.scatter(x, y, s=7, color=colour, marker=mark, alpha=0.6, linewidths=0)
    axis.set_xticks([])
    axis.set_yticks([])
