"""Stores of MLflow for the tests of runs."""

import pytest

from skin.runs.configuration import Tracking
from skin.runs.store import Store


def tracking(folder):
    """Return where the commands of ``run`` log in a folder."""
    return Tracking(f"sqlite:///{folder}/m.db", f"{folder}/a", "skin", True, None)


@pytest.fixture(scope="session")
def opened():
    """Return a function that opens the store of a folder."""
    return lambda folder: Store.open(tracking(folder))
