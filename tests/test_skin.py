"""What ``import skin`` offers to a script."""

import ast
import re
import subprocess
import sys

import pytest
import torch

import skin
from skin.paths import ROOT

SMALL = ["simulator=naive", "data.gestures=200", "device.test_gestures=32", "evaluation.devices=0"]
SMALL += ["evaluation.layouts=0", "evaluation.safe_gestures=64"]
# A matter between MLflow and SQLAlchemy.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy")

HEAVY = {"hydra", "numpy", "torch", "mlflow", "pytorch_lightning"}


def test_there_are_ten_names_and_they_cost_nothing_yet():
    assert len(skin.__all__) == 10
    assert all(getattr(skin, name).__module__.startswith("skin.") for name in skin.__all__)
    assert set(skin.__all__) <= set(dir(skin))
    with pytest.raises(AttributeError, match="no attribute 'shin'"):
        _ = skin.shin
    code = f"import sys, skin; print(*({HEAVY} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "", done.stderr


def test_names_for_type_checkers_are_the_names():
    tree = ast.parse((ROOT / "skin" / "__init__.py").read_text())
    checked = {
        alias.asname for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for alias in node.names
    }
    assert checked - {None} == set(skin.__all__)


def test_a_skin_is_described_simulated_and_differentiated():
    body = skin.Sheet((0.12, 0.12), (12, 12), [{"material": "EcoFlex 00-30", "thickness": 0.012}])
    sensors = skin.Grid(rows=3, columns=3, depth=0.006).sensors(body)
    simulator = skin.Solid(body, sensors)
    pressure = torch.zeros(12, 12, dtype=torch.float32, requires_grad=True)
    readings = simulator(pressure).readings
    assert readings.shape == (9,)
    readings[4].backward()
    # A sensor feels most what presses right above it.
    assert pressure.grad.argmax() in (65, 66, 77, 78)


def test_a_run_is_loaded_and_predicts_a_recording(run, tmp_path):
    for arguments in (
        ["train.py", "experiment=rules", *SMALL],
        ["generate.py", *SMALL[:1], "n=20", "out=x.csv"],
    ):
        done = run(tmp_path, *arguments, store="train" in arguments[0])
        assert done.returncode == 0, done.stderr
    trained = skin.load_run("latest", f"sqlite:///{tmp_path}/m.db")
    touches = skin.read_recording(tmp_path / "x.csv").touches
    chances = trained.predict(touches)
    assert chances.shape == (20, len(trained.labels))
    assert trained.labels == ("big", "dynamic", "press", "dangerous")
    assert 0 <= chances.min() <= chances.max() <= 1
    with pytest.raises(skin.InputError, match="no finished training run none"):
        skin.load_run("none", f"sqlite:///{tmp_path}/m.db")


def test_the_example_of_the_readme_runs():
    (code,) = re.findall(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text(), re.DOTALL | re.MULTILINE)
    assert len([line for line in code.splitlines() if line.strip()]) <= 12
    made = {}
    exec(code, made)
    assert made["readings"].shape == (20,)
    assert made["pressure"].grad.abs().max() > 0
