"""Graph embeddings without training, and what they tell of a touch (report, 3.2.4).

Graph2Vec, GL2Vec and an invariant embedding never see the labels. All take graphs of one topology, as the
frames of one layout have it; what differs are the nodes' labels. Documents of several layouts may be
embedded together. An SVM tells what is in them, and the variance that labels and layouts explain.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from statistics import fmean, stdev
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
from annotated_types import Ge, MinLen
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import track
from sklearn.decomposition import PCA
from sklearn.manifold import TSNE
from sklearn.model_selection import GridSearchCV
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC

from experiments.studies.comparison import combine_verdicts, compare_samples, judge
from experiments.studies.measures import Subject
from experiments.studies.pages import Page, figure_text
from experiments.studies.study import Statement
from skin.device.base import AbstractDevice
from skin.device.simulated import Simulated, check_label_leakage
from skin.device.touches import Touches
from skin.errors import InputError
from skin.evaluation.report import scattered_devices
from skin.learning.graph import adjacency, neighbours
from skin.learning.learner import AbstractLearner
from skin.plot.figures import COLOURS, MARKS

FRAME = "readings, one frame"
Row = dict[str, Any]


@dataclass(frozen=True)
class Embeddings:
    """Accuracy of an SVM on graph embeddings, readings, and the encoder of a run, if one is given.

    A simulated device draws new touches for each seed, separate from all training data; other devices use
    their train and test splits, once. Embeddings use the readings of all touches, but no labels.
    ``conf/study/embeddings.yaml`` explains the other fields.

    The columns are ``attribute`` (degree, reading, or nothing where the input is not a graph embedding),
    ``name`` and ``seed``; ``accuracy LABEL``, the fraction of held-out touches that an SVM labels rightly,
    NaN where it had no choice; ``chance``, the accuracy of always predicting the commoner class; of several
    layouts ``accuracy layout``, ``variance layout`` and ``variance LABEL`` (:func:`explained`), NaN without;
    of the first seed ``plane`` and ``mixed`` (:func:`planes`), with ``classes`` and ``layouts``.

    Args:
        first: seed of the first touches; no training draws from it and those behind it.
        drawn: number of touches in each panel of the figure.
    """

    attributes: Annotated[Sequence[Literal["degree", "reading"]], MinLen(1)] = ("degree", "reading")
    train: Annotated[int, Ge(20)] = 800
    test: Annotated[int, Ge(10)] = 400
    seeds: Annotated[Sequence[int], MinLen(1)] = (0, 1, 2)
    layouts: Annotated[int, Ge(1)] = 3
    levels: Annotated[int, Ge(2)] = 8
    depth: Annotated[int, Ge(0)] = 2
    width: Annotated[int, Ge(2)] = 128
    epochs: Annotated[int, Ge(1)] = 50
    graph: Mapping[str, Any] = field(default_factory=lambda: {"edges": "knn", "count": 6, "weight": "exp"})
    first: int = 1_000_000
    drawn: int = 400

    def __call__(self, subject: Subject) -> pd.DataFrame:
        device, learner = subject.device, subject.learner if subject.model else None
        check_label_leakage(device)
        count = (len(self.attributes) * 3 + (learner is not None) + 2) * len(self.seeds)
        frame = pd.DataFrame(
            track(self.probe(device, learner), "probing", count, console=Console(stderr=True))
        )
        frame.attrs["labels"] = list(device.task.names)
        return frame

    def probe(self, device: AbstractDevice, learner: AbstractLearner | None) -> Iterator[Row]:
        """Yield a row for each input and seed: graph embeddings, a trained encoder, plain readings."""
        if device.task.direction:
            raise InputError("embeddings are probed for labels that hold or not: set data.direction=false")
        for seed in self.seeds if device.simulation else self.seeds[:1]:
            train, test, *mixed = sets = self._touches(device, seed)
            labels, others = label_frame([train, test], device), label_frame(mixed, device)
            others["layout"] = np.repeat(np.arange(len(mixed)), [len(touches) for touches in mixed])
            order, drawn = np.random.default_rng(seed).permutation(len(others)), seed == self.seeds[0]
            held = labels[len(train) :].mean()
            for (attribute, name), vectors in self._inputs(sets, seed, learner):
                own, scattered = vectors[: len(labels)], vectors[len(labels) :]
                row: Row = {"attribute": attribute, "name": name, "seed": seed}
                row |= {f"accuracy {key}": svm_accuracy(own, labels[key], len(train)) for key in labels}
                row |= {f"variance {key}": explained(scattered, others[key]) for key in others}
                mixture = scattered[order], others.layout[order], len(order) * 2 // 3
                row |= {
                    "accuracy layout": svm_accuracy(*mixture),
                    "chance": np.maximum(held, 1 - held).mean(),
                }
                yield row | (self._drawn(own, labels, scattered, others) if drawn else {})

    def _drawn(
        self, own: np.ndarray, labels: pd.DataFrame, scattered: np.ndarray, others: pd.DataFrame
    ) -> Row:
        """Return the panels of the figure, as lists."""
        order = np.random.default_rng(0).permutation(len(others))[: self.drawn]
        panels = {"plane": planes(own[: self.drawn]), "classes": labels[: self.drawn].to_numpy()}
        panels |= {"mixed": planes(scattered[order]), "layouts": others.layout[order].to_numpy()}
        return {name: panel.ravel().tolist() for name, panel in panels.items()}

    def _touches(self, device: AbstractDevice, seed: int) -> list[Touches]:
        """Return touches of one layout, to train and to test the SVM, and those of scattered layouts."""
        if device.simulation is None:
            return [device.touches("train")[: self.train], device.touches("test")[: self.test]]
        simulation = device.simulation.replace(data_seed=self.first + seed, gestures=self.train + self.test)
        drawn, others = simulation.recording().touches, list[Simulated]()
        if self.layouts > 1:
            with suppress(InputError):  # this number of sensors cannot form a grid
                others = list(scattered_devices(device.simulation, self.layouts))
        mixed = [
            other.replace(data_seed=self.first * (2 + number) + seed, gestures=self.test).recording().touches
            for number, other in enumerate(others)
        ]
        return [drawn[: self.train], drawn[self.train :], *mixed]

    def _inputs(
        self, sets: Sequence[Touches], seed: int, learner: AbstractLearner | None
    ) -> Iterator[tuple[tuple[str, str], np.ndarray]]:
        """Yield attribute and name, and the vectors (B, E) of all touches."""
        for attribute in self.attributes:
            yield from self._graph_vectors(sets, attribute, seed)
        if learner is not None:
            encoded = [learner.embeddings(touches).numpy() for touches in sets]
            yield ("", "trained encoder"), np.concatenate(encoded)
        yield ("", FRAME), np.concatenate([strongest(touches) for touches in sets])
        windows = [touches.readings.where(touches.valid, 0).flatten(1).numpy() for touches in sets]
        yield ("", "readings, window"), np.concatenate(windows)

    def _graph_vectors(
        self, sets: Sequence[Touches], attribute: str, seed: int
    ) -> Iterator[tuple[tuple[str, str], np.ndarray]]:
        """Yield each graph embedding (B, E) of the strongest frames of touches, one layout per set.

        GL2Vec gives half its width to the graph and half to its line graph.
        """
        if any(touches.positions.ndim > 2 for touches in sets):
            raise InputError(
                "graph embeddings need sensors that stay in place, these have one layout per touch"
            )
        frames = [strongest(touches) for touches in sets]
        positions = [touches.positions.double().numpy() for touches in sets]
        edges, count, weight = (self.graph[name] for name in ("edges", "count", "weight"))
        weights = [adjacency(points, neighbours(points, edges, count), weight) for points in positions]
        if attribute == "degree":
            labels = [np.tile((w > 0).sum(0), (len(f), 1)) for w, f in zip(weights, frames, strict=True)]
        else:
            ends = np.cumsum([len(frame) for frame in frames])[:-1]
            labels = np.split(levels(np.concatenate(frames), self.levels), ends)
        pairs = list(zip(labels, weights, strict=True))
        words = [row for label, matrix in pairs for row in subtrees(label, matrix > 0, self.depth)]
        yield (attribute, "Graph2Vec"), doc2vec(words, self.width, self.epochs, seed)
        lines = [row for pair in pairs for row in subtrees(*line_graph(*pair), self.depth)]
        half = [doc2vec(documents, self.width // 2, self.epochs, seed) for documents in (words, lines)]
        yield (attribute, "GL2Vec"), np.concatenate(half, axis=1)
        kinds = 1 + max(int(label.max()) for label in labels)
        yield (attribute, "IGE"), np.concatenate([invariant(label, matrix, kinds) for label, matrix in pairs])

    def page(self, frame: pd.DataFrame, title: str) -> Page:
        """Return the table, the verdicts, and figure 5 of the report, of the first seed."""
        table, names = embeddings_table(frame), frame.attrs["labels"]
        about = f"{_ABOUT}\n" + "".join(f"- {line}\n" for line in embedding_statements(frame))
        figure = spaces(frame[frame.seed == frame.seed.iloc[0]], names)
        return Page(about, {"What an SVM reads in embeddings, accuracy in per cent": table}, table, figure)


def label_frame(sets: Sequence[Touches], device: AbstractDevice) -> pd.DataFrame:
    """Return the labels of all touches, a column each."""
    labels = [touches.known_labels.numpy().astype(int) for touches in sets]
    names = device.task.names
    return pd.DataFrame(np.concatenate([np.zeros((0, len(names)), int), *labels]), columns=list(names))


def strongest(touches: Touches) -> np.ndarray:
    """Return the readings (B, S), N, of each touch's strongest frame, 0 where not valid."""
    readings = touches.readings.where(touches.valid, 0).numpy()
    return readings[np.arange(len(readings)), readings.sum(axis=2).argmax(axis=1)]


def svm_accuracy(vectors: np.ndarray, classes: np.ndarray | pd.Series, train: int) -> float:
    """Return the fraction of ``vectors[train:]`` that an SVM trained on the others puts into its class (B,).

    Radial basis functions on standardised vectors, the cost chosen by cross-validation among the training
    ones only (report, 2.2.2). nan where some class is too rare to learn.
    """
    classes = np.asarray(classes)
    counts = np.unique(classes[:train], return_counts=True)[1]
    if len(counts) < 2 or counts.min() < 3:
        return float("nan")
    search = GridSearchCV(make_pipeline(StandardScaler(), SVC()), {"svc__C": (0.1, 1, 10, 100)}, cv=3)
    return float(search.fit(vectors[:train], classes[:train]).score(vectors[train:], classes[train:]))


def explained(vectors: np.ndarray, classes: np.ndarray | pd.Series) -> float:
    """Return the fraction of the variance of vectors (B, E) between classes (B,); 0 if all are one.

    It is nan without vectors.
    """
    if not len(vectors):
        return float("nan")
    centred = vectors - vectors.mean(axis=0)
    parts = [centred[classes == number] for number in np.unique(classes)]
    between = sum(len(part) * (part.mean(axis=0) ** 2).sum() for part in parts)
    # Where nothing but the last bit differs there is no variance to explain.
    whole = (centred**2).sum()
    return float(between / whole) if whole > 1e-12 * (vectors**2).sum() else 0.0


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


def invariant(
    labels: np.ndarray, weights: np.ndarray, count: int, sizes: tuple[int, int, int] = (5, 10, 20)
) -> np.ndarray:
    """Return the invariant embedding of graphs (Galland and Lelarge 2019, with Karate Club's three parts).

    The labels' mean after 1 to 5 steps of a random walk; the 10 smallest eigenvalues of the Laplacian L; and
    a histogram of the nodes' pairwise similarities in spectral space, the entries of L's pseudo-inverse.
    Weights are taken relative to their mean. Only the first part sees the labels.

    Args:
        labels: (B, S), whole numbers from 0 to count - 1.
        weights: (S, S), symmetric, 0 where there is no edge.
        count: of different labels.
        sizes: numbers of steps, of eigenvalues and of bins of the histogram.

    Returns:
        (B, 5 count + 10 + 20).
    """
    edges = weights / weights[weights > 0].mean() if weights.any() else weights
    degree = edges.sum(axis=1)
    walk = edges / np.maximum(degree, np.finfo(float).tiny)[:, None]
    values, vectors = np.linalg.eigh(np.diag(degree) - edges)
    smallest = np.pad(values[: sizes[1]], (0, max(0, sizes[1] - len(values))))
    real = values > 1e-9
    similar = vectors[:, real] / values[real] @ vectors[:, real].T
    histogram = np.histogram(np.clip(similar, -1, 1), bins=sizes[2], range=(-1, 1))[0]
    hot = np.eye(count)[labels]
    reach, parts = np.full(len(weights), 1 / len(weights)), []
    for _ in range(sizes[0]):
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


def planes(vectors: np.ndarray) -> np.ndarray:
    """Return touches in the plane, (B, 2): PCA to 30 axes, then t-SNE (report, 2.2.2)."""
    few = np.asarray(vectors, dtype=float)
    # Neither method works on vectors that are all equal.
    if not len(few) or np.ptp(few, axis=0).max() < 1e-9:
        return np.zeros((len(few), 2))
    reduced = PCA(min(30, *few.shape), random_state=0).fit_transform(few)
    return TSNE(perplexity=min(30.0, (len(few) - 1) / 3), init="pca", random_state=0).fit_transform(reduced)


def spaces(frame: pd.DataFrame, names: Sequence[str]) -> Figure:
    """Draw one row of planes per embedding, coloured by each label and by the layout (report, figure 5).

    Args:
        frame: rows of one seed.
        names: of the labels.
    """
    columns = len(names) + bool(len(frame.mixed.iloc[0]))
    figure = Figure(figsize=(2.1 * columns, 2.0 * len(frame)), layout="constrained")
    axes = figure.subplots(len(frame), columns, squeeze=False)
    for panels, row in zip(axes, frame.itertuples(), strict=True):
        plane = np.reshape(row.plane, (-1, 2))
        drawn = [(plane, classes) for classes in np.reshape(row.classes, (len(plane), -1)).T]
        drawn.append((np.reshape(row.mixed, (-1, 2)), 2 + np.asarray(row.layouts, int)))  # in other colours
        for axis, (points, classes) in zip(panels, drawn, strict=False):
            for number in np.unique(classes):
                colour, mark = COLOURS[number % len(COLOURS)], MARKS[number % len(MARKS)]
                name = ("the label does not hold", "the label holds", f"layout {number - 1}")[min(number, 2)]
                axis.scatter(
                    *points[classes == number].T,
                    s=7,
                    color=colour,
                    marker=mark,
                    alpha=0.6,
                    linewidths=0,
                    label=name,
                )
            axis.set(xticks=[], yticks=[])
        panels[0].set_ylabel(_title((row.attribute, row.name)), fontsize=8)
    for axis, name in zip(axes[0], [*names, "layout"], strict=False):
        axis.set_title(name)
    marks = {group.get_label(): group for axis in axes.flat for group in axis.collections}
    figure.legend(
        marks.values(), marks, loc="outside lower center", ncols=len(marks), fontsize=8, markerscale=2
    )
    return figure


def _summary(frame: pd.DataFrame) -> pd.DataFrame:
    """Return the columns of the table by attribute, name and seed, %.

    The mean is over the labels that could be learnt.
    """
    rows = 100 * frame.set_index(["attribute", "name", "seed"]).select_dtypes("number")
    labels = {name: rows[f"accuracy {name}"] for name in frame.attrs["labels"]}
    columns = labels | {
        "mean": pd.DataFrame(labels).mean(axis=1),
        "layout": rows["accuracy layout"],
        "variance: layout": rows["variance layout"],
        "variance: best label": rows[[f"variance {name}" for name in labels]].max(axis=1),
    }
    return pd.DataFrame(columns)


def embeddings_table(frame: pd.DataFrame) -> pd.DataFrame:
    """Return accuracies and fractions of variance in per cent, means over seeds and their deviation."""
    table = _summary(frame).groupby(["attribute", "name"], sort=False).agg(_mean_and_deviation)
    table.insert(0, "input", [_title(key) for key in table.index])
    return table.reset_index(drop=True)


_STATEMENTS: tuple[tuple[str, str, str, Any], ...] = (
    ("variance: layout", "variance: best label",
     "emphasise the graph's morphology (variance explained by layout over best label)", {"minimum": 2.0}),
    ("mean", "frame",
     "are not purposeful on a fixed layout (mean accuracy below the readings of the same frame)",
     {"maximum": 2.0}),
    ("mean", "chance", "leave an SVM at chance (mean accuracy over the commoner class)", {"maximum": 2.0}),
)  # fmt: skip
"""Two columns of the summary, a statement about their difference, and its limit: two points of tolerance."""


def embedding_statements(frame: pd.DataFrame) -> list[str]:
    """Return verdicts on the report's statements about pretrained embeddings (3.2.4), one line each.

    A statement holds if it holds for each embedding. Agree and disagree need the margin of at least
    three seeds.
    """
    summary, lines = _summary(frame), list[str]()
    frames = summary["mean"].unstack(["attribute", "name"])["", FRAME]
    summary["frame"] = frames.reindex(summary.index, level="seed")
    summary["chance"] = 100 * frame.chance.to_numpy()
    embedded = summary.drop(index="", level="attribute")
    for attribute, group in embedded.groupby("attribute", sort=False):
        for first, second, says, limits in _STATEMENTS:
            verdicts, details = [], []
            for name, rows in group.groupby("name", sort=False):
                pairs = rows[[first, second]].dropna()
                difference = compare_samples(pairs[first], pairs[second])
                verdicts.append(judge(Statement("", says, {}, "", **limits), difference))
                text = figure_text(difference, "points") if difference else "has one layout only"
                details.append(f"{name} {text} ({verdicts[-1]})")
            start = f"Nodes labelled by {attribute}: the embeddings {says}"
            lines.append(f"{start}: **{combine_verdicts(verdicts)}**. {'; '.join(details)}.")
    return lines


def _title(key: tuple[str, str]) -> str:
    return f"{key[1]}, {key[0]}" if key[0] else key[1]


def _mean_and_deviation(values: pd.Series) -> str:
    """Return the mean, with the deviation over seeds if there are several; nothing where one is not known."""
    if values.isna().any():
        return ""
    return f"{fmean(values):.1f}" + (f" ± {stdev(values):.1f}" if len(values) > 1 else "")
