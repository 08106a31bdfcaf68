"""Embeddings of graphs: against networkx, what is read in them, and the page that says so."""

import networkx as nx
import numpy as np
import pandas as pd
import pytest

from experiments.studies import embeddings
from experiments.studies.embeddings import FRAME, Embeddings, invariant, subtrees
from skin.runs.build import build_device
from skin.touch.labels import TOUCH


def network(seed=0, nodes=9):
    """Return a random connected graph and its weights (S, S)."""
    graph = nx.connected_watts_strogatz_graph(nodes, 4, 0.4, seed=seed)
    weights = np.triu(np.random.default_rng(seed).uniform(0.2, 1, (nodes, nodes)), 1)
    linked = nx.to_numpy_array(graph, nodelist=range(nodes)) > 0
    return graph, linked * (weights + weights.T)


def test_words_tell_apart_the_same_subtrees_as_networkx():
    collected = {depth: ([], []) for depth in range(4)}
    for seed in range(6):
        graph, weights = network(seed)
        labels = np.random.default_rng(seed).integers(0, 2, (1, 9))
        nx.set_node_attributes(graph, {n: str(labels[0, n]) for n in graph}, "label")
        depths = {"iterations": 3, "include_initial_labels": True}
        known = nx.weisfeiler_lehman_subgraph_hashes(graph, node_attr="label", **depths)
        words = subtrees(labels, weights > 0, depth=3).reshape(4, 9)
        for depth, (ours, theirs) in collected.items():
            ours += words[depth].tolist()
            theirs += [known[node][depth] for node in range(9)]
    for ours, theirs in collected.values():
        np.testing.assert_array_equal(pd.factorize(np.array(ours))[0], pd.factorize(np.array(theirs))[0])
    assert len(set(collected[2][0])) > len(set(collected[1][0])) > 2


@pytest.mark.parametrize("seed", [0, 5])
def test_words_and_invariants_know_nothing_of_the_order_of_nodes(seed):
    _, weights = network(seed)
    labels, order = np.random.default_rng(0).integers(0, 3, (4, 9)), np.random.default_rng(1).permutation(9)
    other, moved = labels[:, order], weights[np.ix_(order, order)]
    graphs = (labels, weights > 0), (other, moved > 0)
    words, permuted = (np.sort(subtrees(*one).reshape(4, 3, 9)) for one in graphs)
    assert (words == permuted).all()
    assert not (np.sort(subtrees(1 - labels, weights > 0).reshape(4, 3, 9)) == words).all()
    embedded = invariant(labels, weights, 3)
    assert embedded == pytest.approx(invariant(other, moved, 3))
    assert embedded[0] != pytest.approx(embedded[1])


def test_the_line_graph_is_that_of_networkx():
    graph, weights = network(3)
    labels, linked = embeddings.line_graph(np.zeros((2, 9), dtype=int), weights)
    edges = list(zip(*np.nonzero(np.triu(weights, 1)), strict=True))
    known = nx.line_graph(graph)
    theirs = nx.relabel_nodes(known, {(a, b): (min(a, b), max(a, b)) for a, b in known})
    assert (linked == (nx.to_numpy_array(theirs, nodelist=edges) > 0)).all()
    # without node labels, an edge's label is the step of its weight
    step = np.minimum(4 * weights[tuple(zip(*edges, strict=True))] / weights.max(), 3).astype(int)
    np.testing.assert_array_equal(pd.factorize(labels[0])[0], pd.factorize(step)[0])
    assert (labels[0] == labels[1]).all()


def test_the_invariant_embedding_of_a_complete_graph_is_known():
    nodes = 6
    weights = 3.0 * (1 - np.eye(nodes))  # the unit of weights does not matter
    found = invariant(np.array([[0, 0, 0, 1, 1, 2]]), weights, 3)[0]
    # the mean over nodes of a walk on a regular graph stays the share of each label
    assert found[:15].reshape(5, 3) == pytest.approx(np.tile([3 / 6, 2 / 6, 1 / 6], (5, 1)))
    assert found[15:25] == pytest.approx([0, *[nodes] * 5, 0, 0, 0, 0])
    # the pseudo-inverse is (I - 1/n) / n: 5/36 on the diagonal, -1/36 beside it
    histogram = np.zeros(20)
    histogram[[9, 11]] = 30 / 36, 6 / 36
    assert found[25:] == pytest.approx(histogram)


def test_documents_of_like_words_lie_together():
    generator = np.random.default_rng(0)
    documents = [generator.integers(30 * (n % 2), 30 * (n % 2) + 30, 40) for n in range(60)]
    vectors = embeddings.doc2vec(documents, 8, epochs=400, seed=0)
    assert vectors.shape == (60, 8)
    assert (vectors == embeddings.doc2vec(documents, 8, epochs=400, seed=0)).all()
    unit = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    like = unit @ unit.T - 9 * np.eye(60)
    assert (like.argmax(axis=1) % 2 == np.arange(60) % 2).mean() > 0.95


NAMES = ("big", "press")


def found(attribute, name, seed, right, layout):
    points = np.random.default_rng(seed).standard_normal(40).tolist()
    row = {"attribute": attribute, "name": name, "seed": seed, "chance": 0.5, "accuracy layout": 1.0}
    row |= {"accuracy big": right, "accuracy press": right - 0.1, "variance layout": layout}
    row |= {"variance big": 0.2, "variance press": 0.1, "plane": points, "mixed": points}
    return row | {"classes": [0, 1, 1, 0] * 10, "layouts": [0, 1] * 10}


@pytest.fixture
def three():
    """Three seeds of an embedding at chance that shows the layout, of one that does not, and of readings."""
    rows = []
    for seed, noise in enumerate([-0.01, 0.0, 0.01]):
        rows.append(found("degree", "Graph2Vec", seed, 0.55 + noise, 0.9 + noise))
        rows.append(found("reading", "Graph2Vec", seed, 0.95 + noise, 0.1 + noise))
        rows.append(found("", FRAME, seed, 0.95 - noise, 0.2))
    frame = pd.DataFrame(rows)
    frame.attrs["labels"] = list(NAMES)
    return frame


def test_verdicts_follow_the_figures(three):
    words = [line.split("**")[1] for line in embeddings.embedding_statements(three)]
    # layout against the best label; against readings, 0 ± 5.0; against chance, 0 ± 2.5 and 45 ± 2.5
    assert words == ["agree", "agree", "undecided", "disagree", "undecided", "disagree"]
    one_seed = embeddings.embedding_statements(three[:3])
    assert all("**undecided**" in line for line in one_seed)


def test_the_figure_has_a_panel_per_label_and_layout(three):
    figure = embeddings.spaces(three[:2], NAMES)
    assert len(figure.axes) == 2 * 3
    assert figure.axes[2].get_title() == "layout"
    assert [len(group.get_offsets()) for group in figure.axes[0].collections] == [10, 10]
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts == ["the label does not hold", "the label holds", "layout 1", "layout 2"]
    colours = {tuple(handle.get_facecolor()[0]) for handle in figure.legends[0].legend_handles}
    assert len(colours) == 4


SMALL = {"train": 160, "test": 80, "seeds": [4], "epochs": 60, "width": 32, "layouts": 2}


@pytest.fixture(scope="module")
def probed(configured):
    device = build_device(configured("simulator=naive"))
    return {(one["attribute"], one["name"]): one for one in Embeddings(**SMALL).probe(device, None)}


def test_an_svm_reads_what_is_there_and_no_more():
    generator = np.random.default_rng(0)
    vectors, probability = generator.standard_normal((400, 4)), generator.integers(0, 2, 400)
    far = (vectors[:, 0] ** 2 + vectors[:, 1] ** 2 > 1.4).astype(int)
    assert embeddings.svm_accuracy(vectors, far, 300) > 0.85
    assert abs(embeddings.svm_accuracy(vectors, probability, 300) - 0.5) < 0.15  # three standard errors
    assert np.isnan(embeddings.svm_accuracy(vectors, np.zeros(400, dtype=int), 300))


def test_explained_variance_of_known_vectors():
    classes = np.repeat([0, 1], 50)
    spread = np.tile([-1.0, 1.0], 50)
    # 1 within classes and 4 between them
    assert embeddings.explained(np.stack([spread, 4 * classes - 2], axis=1), classes) == pytest.approx(4 / 5)
    assert embeddings.explained(np.stack([spread, np.zeros(100)], axis=1), classes) == pytest.approx(0)
    assert embeddings.explained(np.full((100, 3), 0.1), classes) == 0


def test_degrees_tell_the_layout_and_nothing_else(probed):
    for name in ("Graph2Vec", "GL2Vec", "IGE"):
        one = probed["degree", name]
        assert one["variance layout"] > 0.9
        assert one["accuracy layout"] == 1
        assert all(abs(one[f"accuracy {label}"] - 0.5) < 0.17 for label in TOUCH.names)
    assert not any(probed["degree", "IGE"]["plane"])


def test_readings_tell_what_presses_but_one_frame_no_duration(probed):
    for key in (("reading", "IGE"), ("reading", "Graph2Vec"), ("", FRAME)):
        assert probed[key]["accuracy dangerous"] > 0.8
        assert probed[key]["accuracy press"] < 0.7
    assert len(probed["", "readings, window"]["plane"]) == 2 * 240
