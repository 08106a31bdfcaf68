"""Figure 5 of the report, the table of accuracies on embeddings, and verdicts."""

from collections.abc import Callable, Iterable, Sequence
from statistics import fmean, stdev

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from sklearn.decomposition import PCA
from sklearn.manifold import TSNE

from experiments.studies.comparison import combine_verdicts, paired, verdict
from experiments.studies.embeddings import FRAME, ProbeResult
from experiments.studies.tables import Page
from skin.plot.figures import COLOURS, MARKS

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


def build_embeddings_page(found: Sequence[ProbeResult], names: Sequence[str]) -> Page:
    """Return the table, the verdicts, and figure 5 of the report, of the first seed."""
    table = embeddings_table(found, names)
    about = f"{_ABOUT}\n" + "".join(f"- {line}\n" for line in embedding_statements(found, names))
    figure = spaces([one for one in found if one.seed == found[0].seed], names)
    return Page(about, {"What an SVM reads in embeddings, accuracy in per cent": table}, table, figure)


def planes(vectors: np.ndarray, points: int = 400) -> np.ndarray:
    """Return the first touches in the plane, (points, 2): PCA to 30 axes, then t-SNE (report, 2.2.2)."""
    few = np.asarray(vectors[:points], dtype=float)
    # Neither method works on vectors that are all equal.
    if np.ptp(few, axis=0).max() < 1e-9:
        return np.zeros((len(few), 2))
    reduced = PCA(min(30, *few.shape), random_state=0).fit_transform(few)
    near = min(30.0, (len(few) - 1) / 3)
    return TSNE(perplexity=near, init="pca", random_state=0).fit_transform(reduced)


def spaces(found: Sequence[ProbeResult], names: Sequence[str], points: int = 400) -> Figure:
    """Draw one row of planes per embedding, coloured by each label and by the layout (report, figure 5).

    Args:
        found: of one seed.
        names: of the labels.
        points: touches in each panel.
    """
    columns = len(names) + (found[0].space.mixed is not None)
    figure = Figure(figsize=(2.1 * columns, 2.0 * len(found)), layout="constrained")
    axes = figure.subplots(len(found), columns, squeeze=False)
    for row, one in zip(axes, found, strict=True):
        plane = planes(one.space.vectors, points)
        for axis, classes in zip(row, one.space.labels.T, strict=False):
            _scatter(axis, plane, classes[:points])
        if one.space.mixed is not None:
            order = np.random.default_rng(0).permutation(len(one.space.mixed))[:points]
            _scatter(row[-1], planes(one.space.mixed[order], points), one.space.layouts[order])
        row[0].set_ylabel(_title(one), fontsize=8)
    for axis, name in zip(axes[0], [*names, "layout"], strict=False):
        axis.set_title(name)
    figure.supxlabel("square: the label holds, circle: it does not; each layout has a mark", fontsize=8)
    return figure


def embeddings_table(found: Sequence[ProbeResult], names: Sequence[str]) -> list[list[str]]:
    """Return the table, its head first: accuracies and shares of variance in per cent, means over seeds."""
    head = ["input", *names, "mean", "layout", "variance: layout", "variance: best label"]
    table = [head]
    for group in _groups(found).values():
        labels = [[one.accuracy[name] for one in group] for name in names]
        means = [_mean(one, names) for one in group]
        layout = [one.accuracy["layout"] for one in group if "layout" in one.accuracy]
        shares = [one.explained for one in group if one.explained]
        variance = (
            [share["layout"] for share in shares],
            [max(share[name] for name in names) for share in shares],
        )
        table.append([_title(group[0]), *map(_percent, [*labels, means, layout, *variance])])
    return table


def embedding_statements(found: Sequence[ProbeResult], names: Sequence[str]) -> list[str]:
    """Return verdicts on the report's statements about pretrained embeddings (3.2.4), one line each.

    A statement holds if it holds for each embedding. Agree and disagree need the margin of at least
    three seeds; "chance" has a tolerance of two points.
    """
    groups = _groups(found)
    frame = {one.seed: _mean(one, names) for one in groups[("", FRAME)]}
    claims: tuple[tuple[str, str, _Figure, _Figure], ...] = (
        (
            "emphasise the graph's morphology (variance explained by layout over best label)",
            "greater",
            lambda one: one.explained["layout"],
            lambda one: max(one.explained[name] for name in names),
        ),
        (
            "are not purposeful on a fixed layout (mean accuracy below the readings of the same frame)",
            "less",
            lambda one: _mean(one, names),
            lambda one: frame[one.seed],
        ),
        (
            "leave an SVM at chance (mean accuracy over the commoner class)",
            "no better",
            lambda one: _mean(one, names),
            _chance,
        ),
    )
    said = []
    for attribute in dict.fromkeys(one.attribute for one in found if one.attribute):
        mine = [group for key, group in groups.items() if key[0] == attribute]
        for says, claim, figure, reference in claims:
            each = [_compare(group, claim, figure, reference) for group in mine]
            whole = combine_verdicts([word for word, _ in each])
            details = "; ".join(detail for _, detail in each)
            said.append(f"Nodes labelled by {attribute}: the embeddings {says}: **{whole}**. {details}.")
    return said


def _compare(
    group: Sequence[ProbeResult], claim: str, figure: _Figure, reference: _Figure
) -> tuple[str, str]:
    """Return the verdict on a claim about one embedding, and its figures."""
    able = [one for one in group if one.explained or claim != "greater"]
    one, other = ({str(each.seed): of(each) for each in able} for of in (figure, reference))
    difference = paired(one, other)
    word = verdict(claim, difference, by=0.02)
    if difference is None:
        return word, f"{group[0].name} has one layout only ({word})"
    spread = f" ± {100 * difference.margin:.1f}" if difference.seeds > 1 else ""
    return word, f"{group[0].name} {100 * difference.mean:+.1f}{spread} points ({word})"


def _groups(found: Iterable[ProbeResult]) -> dict[tuple[str, str], list[ProbeResult]]:
    """Return the results of each input, by seed."""
    groups: dict[tuple[str, str], list[ProbeResult]] = {}
    for one in found:
        groups.setdefault((one.attribute, one.name), []).append(one)
    return groups


def _mean(one: ProbeResult, names: Sequence[str]) -> float:
    """Return the mean accuracy over the labels that could be learnt."""
    return float(np.nanmean([one.accuracy[name] for name in names]))


def _chance(one: ProbeResult) -> float:
    """Return the mean share of the held-out touches that are of their label's commoner class."""
    share = one.space.labels[one.space.train :].mean(axis=0)
    return float(np.maximum(share, 1 - share).mean())


def _title(one: ProbeResult) -> str:
    return f"{one.name}, {one.attribute}" if one.attribute else one.name


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
