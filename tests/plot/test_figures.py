"""Figures show the numbers that they were given."""

import numpy as np
import pytest
import torch
from PIL import Image

from skin.plot.figures import confusions, images, misclassified, misclassified_fractions, save_figure, traces


def test_a_confusion_matrix_shows_shares_of_each_true_class():
    figure = confusions({"x": np.array([[30, 10], [1, 3]])}, ("safe", "dangerous"))
    texts = [text.get_text().split() for text in figure.axes[0].texts]
    assert texts == [["75.0%", "30"], ["25.0%", "10"], ["25.0%", "1"], ["75.0%", "3"]]
    figure = confusions({"x": np.array([[5, 5], [0, 0]])}, ("no", "yes"))
    assert figure.axes[0].texts[2].get_text() == "0.0%\n0"


def test_static_touches_stand_on_their_own_and_slides_in_their_bin():
    speeds = np.array([0, 0, 0.03, 0.09, 0.11, 0.20])
    wrong, bins = np.array([True, False, False, True, True, True]), np.array([0.03, 0.10, 0.20])
    fractions, errors = misclassified_fractions(speeds, wrong, bins)
    assert errors == pytest.approx([0.5 / 2**0.5, 0.5 / 2**0.5, 0])
    figure = misclassified({"row": (fractions, errors)}, "big", bins)
    x, y = figure.axes[0].containers[0].lines[0].get_data()
    assert x == pytest.approx([0, 65, 150])
    assert y == pytest.approx([0.5, 0.5, 1.0])


def test_a_trace_is_of_the_most_active_sensor():
    readings = torch.zeros(5, 3)
    readings[2, 1] = 4
    axis = traces({"naive": readings}, rate=10).axes[0]
    assert axis.lines[0].get_ydata().max() == 4
    assert axis.lines[0].get_xdata()[-1] == pytest.approx(0.4)


def test_a_picture_is_saved_whole(tmp_path):
    pictures = {name: torch.rand(8, 8) for name in ("image", "fourier")}
    figure = images(pictures, np.array([[0.05, 0.05]]), (0.1, 0.1))
    path = save_figure(figure, tmp_path / "new" / "figure.png")
    assert [one.name for one in path.parent.iterdir()] == ["figure.png"]
    with Image.open(path) as picture:
        assert min(picture.size) > 200
