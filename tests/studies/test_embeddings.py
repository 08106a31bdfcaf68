"""Embeddings of graphs, against networkx and by what must not change them."""

import networkx as nx
import numpy as np
import pandas as pd
import pytest

from experiments.studies.embeddings import doc2vec, invariant, line_graph, subtrees


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
        known = nx.weisfeiler_lehman_subgraph_hashes(
            graph, node_attr="label", iterations=3, include_initial_labels=True
        )
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
    labels, linked = line_graph(np.zeros((2, 9), dtype=int), weights)
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
    vectors = doc2vec(documents, 8, epochs=400, seed=0)
    assert vectors.shape == (60, 8)
    assert (vectors == doc2vec(documents, 8, epochs=400, seed=0)).all()
    unit = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    like = unit @ unit.T - 9 * np.eye(60)
    assert (like.argmax(axis=1) % 2 == np.arange(60) % 2).mean() > 0.95
