"""The table, the verdicts and the figure say what was found."""

import numpy as np
import pandas as pd
import pytest

from experiments.studies.embeddings import FRAME, embedding_statements, embeddings_table, spaces

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


def test_the_table_has_means_and_deviations(three):
    table = embeddings_table(three)
    head, (degree, *_) = list(table.columns), table.to_numpy().tolist()
    assert head[:4] == ["input", "big", "press", "mean"]
    assert degree[0] == "Graph2Vec, degree"
    assert degree[1:4] == ["55.0 ± 1.0", "45.0 ± 1.0", "50.0 ± 1.0"]
    assert degree[4:] == ["100.0 ± 0.0", "90.0 ± 1.0", "20.0 ± 0.0"]


def test_verdicts_follow_the_figures(three):
    words = [line.split("**")[1] for line in embedding_statements(three)]
    # layout against the best label; against readings, 0 ± 5.0; against chance, 0 ± 2.5 and 45 ± 2.5
    assert words == ["agree", "agree", "undecided", "disagree", "undecided", "disagree"]
    one_seed = embedding_statements(three[:3])
    assert all("**undecided**" in line for line in one_seed)


def test_the_figure_has_a_panel_per_label_and_layout(three):
    figure = spaces(three[:2], NAMES)
    assert len(figure.axes) == 2 * 3
    assert figure.axes[2].get_title() == "layout"
    assert [len(group.get_offsets()) for group in figure.axes[0].collections] == [10, 10]
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts == ["the label does not hold", "the label holds", "layout 1", "layout 2"]
    colours = {tuple(handle.get_facecolor()[0]) for handle in figure.legends[0].legend_handles}
    assert len(colours) == 4
