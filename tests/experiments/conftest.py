"""What tests of whole commands share."""

import subprocess
import sys
from collections.abc import Callable

import pytest

from skin.core.files import ROOT
from tests.commands.conftest import run  # noqa: F401

HEAVY = {"torch", "mlflow", "pytorch_lightning", "numpy", "scipy"}
LIGHT = f"""
import atexit, sys
sys.path.insert(0, {str(ROOT)!r})
from skin.__main__ import main
atexit.register(lambda: print(*sorted({HEAVY} & set(sys.modules))))
main(sys.argv[1:])
"""


@pytest.fixture(scope="session")
def light() -> Callable[..., subprocess.CompletedProcess]:
    """Return a function that runs ``skin`` in a folder; its last line has the heavy libraries it imported."""

    def start(folder, *words: str) -> subprocess.CompletedProcess:
        command = [sys.executable, "-c", LIGHT, *words]
        return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)

    return start
