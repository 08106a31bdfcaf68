"""What tests of learners share."""

import pytest


@pytest.fixture
def few_trees(monkeypatch):
    """Forests of 30 trees: those of 300 take minutes."""
    monkeypatch.setattr("skin.learning.few._TREES", 30)
