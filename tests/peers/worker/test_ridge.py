"""The fits of ridges and logistic curves, against those of scikit-learn."""

import numpy as np
import pytest
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.calibration import CalibratedClassifierCV
from sklearn.frozen import FrozenEstimator
from sklearn.linear_model import Ridge

from experiments.peers.worker.ridge import STRENGTHS, normal_equations, platt


class Scores(ClassifierMixin, BaseEstimator):
    """A classifier whose score is its only feature."""

    def fit(self, x, y):
        self.classes_ = np.array([0, 1])
        return self

    def decision_function(self, x):
        return x[:, 0]

    def predict(self, x):
        return (x[:, 0] > 0).astype(int)


def chance(curve, score):
    return 1 / (1 + np.exp(-(curve[0] * score + curve[1])))


def test_scores_become_probabilities_by_platt_scaling():
    random = np.random.default_rng(0)
    truth = random.integers(0, 2, 300)
    score = truth + 0.4 * random.standard_normal(300)
    theirs = CalibratedClassifierCV(FrozenEstimator(Scores().fit(None, None)), method="sigmoid")
    theirs.fit(score[:, None], truth)
    # Both search for the minimum of the same smooth loss.
    expected = theirs.predict_proba(score[:, None])[:, 1]
    assert chance(platt(score, truth), score) == pytest.approx(expected, abs=2e-3)


def test_scores_that_separate_the_classes_stay_finite_and_in_order():
    score = np.linspace(-1, 1, 40)
    found = chance(platt(score, (score > 0).astype(int)), score)
    assert (np.diff(found) > 0).all()
    assert 0 < found[0] < 0.1 < 0.9 < found[-1] < 1


def test_normal_equations_give_the_ridge_with_the_least_validation_error():
    random = np.random.default_rng(0)
    x = random.standard_normal((400, 30)).astype(np.float32) + 2
    noise = random.standard_normal((400, 2)) * (0.1, 30.0)  # the second label needs a stronger ridge
    y = x @ random.standard_normal((30, 2)) + noise + 5
    train, held = slice(0, 300), slice(300, 400)
    parts = zip(np.split(x[train], [64, 200]), np.split(y[train], [64, 200]), strict=True)
    weights, bias = normal_equations(parts, x[held], y[held])
    chosen = set()
    for label in range(2):
        fits = [Ridge(alpha).fit(x[train].astype(float), y[train, label]) for alpha in STRENGTHS]
        errors = [np.square(fit.predict(x[held]) - y[held, label]).mean() for fit in fits]
        best = fits[int(np.argmin(errors))]
        chosen.add(best.alpha)
        assert weights[:, label] == pytest.approx(best.coef_, abs=1e-3)
        assert bias[label] == pytest.approx(best.intercept_, abs=1e-2)
    assert len(chosen) == 2


def test_features_that_hardly_vary_and_depend_on_each_other_are_fitted():
    """Shares near 1, divided by their standard deviation, as MiniRocket's features are."""
    random = np.random.default_rng(0)
    hidden = random.standard_normal((4000, 20))
    x = (300 + hidden @ random.standard_normal((20, 200))).astype(np.float32)
    y = hidden[:, :2] + 0.1 * random.standard_normal((4000, 2))
    train, held = slice(0, 3000), slice(3000, 4000)
    weights, bias = normal_equations(iter([(x[train], y[train])]), x[held], y[held])
    errors = np.square(x[held].astype(float) @ weights + bias - y[held]).mean(0)
    fits = [Ridge(alpha).fit(x[train].astype(float), y[train]) for alpha in STRENGTHS]
    least = np.min([np.square(fit.predict(x[held].astype(float)) - y[held]).mean(0) for fit in fits], axis=0)
    assert errors == pytest.approx(least, rel=1e-3)
