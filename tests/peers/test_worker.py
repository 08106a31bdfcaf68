"""The fits of ridges and logistic curves, against those of scikit-learn."""

import numpy as np
import pytest
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.calibration import CalibratedClassifierCV
from sklearn.frozen import FrozenEstimator

from experiments.peers.worker import platt


class Scores(ClassifierMixin, BaseEstimator):
    """A classifier whose score is its only feature."""

    def fit(self, x, y):
        self.classes_ = np.array([0, 1])
        return self

    def decision_function(self, x):
        return x[:, 0]

    def predict(self, x):
        return (x[:, 0] > 0).astype(int)


def probability(curve, score):
    return 1 / (1 + np.exp(-(curve[0] * score + curve[1])))


def test_scores_become_probabilities_by_platt_scaling():
    random = np.random.default_rng(0)
    truth = random.integers(0, 2, 300)
    score = truth + 0.4 * random.standard_normal(300)
    theirs = CalibratedClassifierCV(FrozenEstimator(Scores().fit(None, None)), method="sigmoid")
    theirs.fit(score[:, None], truth)
    # Both search for the minimum of the same smooth loss.
    expected = theirs.predict_proba(score[:, None])[:, 1]
    assert probability(platt(score, truth), score) == pytest.approx(expected, abs=2e-3)


def test_scores_that_separate_the_classes_stay_finite_and_in_order():
    score = np.linspace(-1, 1, 40)
    found = probability(platt(score, (score > 0).astype(int)), score)
    assert (np.diff(found) > 0).all()
    assert 0 < found[0] < 0.1 < 0.9 < found[-1] < 1
