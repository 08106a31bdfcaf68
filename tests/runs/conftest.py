"""Stores of MLflow for the tests of runs."""

import pytest

from skin.runs.configuration import Tracking
from skin.runs.store import Store
from tests.commands.conftest import run  # noqa: F401


def tracking(folder):
    return Tracking(f"sqlite:///{folder}/m.db", f"{folder}/a", "skin", True, None)


@pytest.fixture(scope="session")
def opened():
    return lambda folder: Store.open(tracking(folder))
