"""The table, the verdicts and the figure say what was found."""

import numpy as np
import pytest

from experiments.studies.embeddings import (
    FRAME,
    ProbeResult,
    Space,
    embedding_statements,
    embeddings_table,
    planes,
    spaces,
)

NAMES = ("big", "press")


def found(attribute, name, seed, right, layout):
    """Return a finding whose accuracies and explained shares are given."""
    generator = np.random.default_rng(seed)
    labels = np.tile([[0, 1], [1, 0]], (20, 1))
    space = Space(generator.standard_normal((40, 5)), labels, 30, generator.standard_normal((40, 5)),
                  np.arange(40) % 2, labels)  # fmt: skip
    accuracy = {"big": right, "press": right - 0.1, "layout": 1.0}
    return ProbeResult(attribute, name, seed, accuracy, {"layout": layout, "big": 0.2, "press": 0.1}, space)


@pytest.fixture
def three():
    """Three seeds of an embedding at chance that shows the layout, of one that does not, and of readings."""
    return [
        one
        for seed, noise in enumerate([-0.01, 0.0, 0.01])
        for one in (
            found("degree", "Graph2Vec", seed, 0.55 + noise, 0.9 + noise),
            found("reading", "Graph2Vec", seed, 0.95 + noise, 0.1 + noise),
            found("", FRAME, seed, 0.95 - noise, 0.2),
        )
    ]


def test_the_table_has_means_and_deviations(three):
    head, degree, *_ = embeddings_table(three, NAMES)
    assert head[:4] == ["input", "big", "press", "mean"]
    assert degree[0] == "Graph2Vec, degree"
    assert degree[1:4] == ["55.0 ± 1.0", "45.0 ± 1.0", "50.0 ± 1.0"]
    assert degree[4:] == ["100.0 ± 0.0", "90.0 ± 1.0", "20.0 ± 0.0"]


def test_verdicts_follow_the_figures(three):
    words = [line.split("**")[1] for line in embedding_statements(three, NAMES)]
    # layout against the best label; against readings, 0 ± 5.0; against chance, 0 ± 2.5 and 45 ± 2.5
    assert words == ["agree", "agree", "undecided", "disagree", "undecided", "disagree"]


def test_one_seed_decides_nothing(three):
    assert all("**undecided**" in line for line in embedding_statements(three[:3], NAMES))


def test_without_layouts_morphology_is_undecided(three):
    alone = [one._replace(explained={}, space=one.space._replace(mixed=None)) for one in three]
    said = embedding_statements(alone, NAMES)
    assert "**undecided**" in said[0]
    assert "one layout only" in said[0]
    assert "**agree**" in said[1]
    assert embeddings_table(alone, NAMES)[1][-2:] == ["", ""]


def test_clusters_stay_apart_in_the_plane():
    generator = np.random.default_rng(0)
    classes = np.arange(60) % 2
    vectors = generator.standard_normal((60, 40)) + 20 * classes[:, None]
    plane = planes(vectors)
    distance = np.linalg.norm(plane[:, None] - plane, axis=-1) + 1e9 * np.eye(60)
    assert (classes[distance.argmin(axis=1)] == classes).all()
    assert (planes(np.ones((60, 5))) == 0).all()


def test_the_figure_has_a_panel_per_label_and_layout(three):
    figure = spaces(three[:2], NAMES, points=20)
    assert len(figure.axes) == 2 * 3
    assert figure.axes[2].get_title() == "layout"
    assert [len(group.get_offsets()) for group in figure.axes[0].collections] == [10, 10]
