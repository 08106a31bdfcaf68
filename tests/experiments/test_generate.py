"""experiments/generate.py as a person runs it."""

import subprocess
import sys
from pathlib import Path

import pytest

from skin.storage import read

ROOT = Path(__file__).parents[2]


def generate(folder: Path, *overrides: str) -> subprocess.CompletedProcess:
    command = [sys.executable, str(ROOT / "experiments" / "generate.py"), "simulator=naive", *overrides]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_writes_a_recording(tmp_path):
    done = generate(tmp_path, "n=32", "out=x.csv")
    assert done.returncode == 0, done.stderr
    assert "x.csv: 32 gestures" in done.stdout
    recording = read(tmp_path / "x.csv")
    assert len(recording) == 32
    assert recording.metadata["config"]["data"]["gestures"] == 32
    assert len(recording.metadata["config_hash"]) >= 16


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["n=32"], "add out=touches.parquet"),
        (["n=32", "out=x.txt"], "got x.txt"),
        (["n=32", "out=x.csv", "touch.shapes=[potato]"], "no shape potato"),
    ],
)
def test_bad_input_ends_with_a_sentence(tmp_path, overrides, message):
    done = generate(tmp_path, *overrides)
    assert done.returncode == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.glob("x.*"))
