"""What is read in an embedding is what was put there."""

import numpy as np
import pytest

from experiments.studies.embeddings import FRAME, Embeddings, explained, svm_accuracy
from skin.runs.build import build_device
from skin.touch.labels import TOUCH

SMALL = {"train": 160, "test": 80, "seeds": [4], "epochs": 60, "width": 32, "layouts": 2}


@pytest.fixture(scope="module")
def found(configured):
    device = build_device(configured("simulator=naive"))
    return {(one["attribute"], one["name"]): one for one in Embeddings(**SMALL).probe(device, None)}


def test_an_svm_reads_what_is_there_and_no_more():
    generator = np.random.default_rng(0)
    vectors, probability = generator.standard_normal((400, 4)), generator.integers(0, 2, 400)
    assert svm_accuracy(vectors, (vectors[:, 0] ** 2 + vectors[:, 1] ** 2 > 1.4).astype(int), 300) > 0.85
    assert abs(svm_accuracy(vectors, probability, 300) - 0.5) < 0.15  # three standard errors
    assert np.isnan(svm_accuracy(vectors, np.zeros(400, dtype=int), 300))


def test_explained_variance_of_known_vectors():
    classes = np.repeat([0, 1], 50)
    spread = np.tile([-1.0, 1.0], 50)
    # 1 within classes and 4 between them
    assert explained(np.stack([spread, 4 * classes - 2], axis=1), classes) == pytest.approx(4 / 5)
    assert explained(np.stack([spread, np.zeros(100)], axis=1), classes) == pytest.approx(0)
    assert explained(np.full((100, 3), 0.1), classes) == 0


def test_degrees_tell_the_layout_and_nothing_else(found):
    for name in ("Graph2Vec", "GL2Vec", "IGE"):
        one = found["degree", name]
        assert one["variance layout"] > 0.9
        assert one["accuracy layout"] == 1
        assert all(abs(one[f"accuracy {label}"] - 0.5) < 0.17 for label in TOUCH.names)
    assert not any(found["degree", "IGE"]["plane"])


def test_readings_tell_what_presses_but_one_frame_no_duration(found):
    for key in (("reading", "IGE"), ("reading", "Graph2Vec"), ("", FRAME)):
        assert found[key]["accuracy dangerous"] > 0.8
        assert found[key]["accuracy press"] < 0.7
    assert len(found["", "readings, window"]["plane"]) == 2 * 240
