"""What the tests of peers share."""

import sys

import pytest

from experiments.peers import PYTHON


@pytest.fixture
def own_python(monkeypatch):
    """Run the worker in this environment, which has all that a ridge without kernels needs."""
    monkeypatch.setenv(PYTHON, sys.executable)
