"""What ``import skin`` offers to a script."""

import re
import runpy
import subprocess
import sys

import numpy as np
import pytest
import torch

import skin
from skin.core.files import ROOT

SMALL = ["simulator=naive", "data.gestures=200", "device.test_gestures=32", "evaluation.devices=0"]
SMALL += ["evaluation.layouts=0", "evaluation.safe_gestures=64"]

HEAVY = {"hydra", "numpy", "torch", "mlflow", "pytorch_lightning"}
TRAINING = {"mlflow", "pytorch_lightning", "torchmetrics", "sklearn", "pandas", "matplotlib"}
POSTERIOR = """
import skin
body = skin.Sheet((0.08, 0.08), (8, 8), [{"material": "EcoFlex 00-30", "thickness": 0.012}])
sensors = skin.Grid(rows=2, columns=2, depth=0.006).sensors(body)
print(skin.Posterior(skin.Solid(body, sensors), skin.Noise(0.05), body).estimate([0.0] * 4).number)
"""
LIVE = """
from skin.__main__ import main
main(["live", "run=any_skin", "simulator=naive", "seconds=0.3", "live.patience.above=0.5", "live.touch=0.3",
    "live.selftest=false", "live.contacts=false", "live.verdicts=stdout"])
"""
WHICH = f"import sys; print(*sorted({TRAINING} & set(sys.modules)))"


def test_there_are_sixteen_names_and_they_cost_nothing_yet():
    assert len(skin.__all__) == 16
    assert all(getattr(skin, name).__module__.startswith("skin.") for name in skin.__all__)
    assert set(skin.__all__) <= set(dir(skin))
    with pytest.raises(AttributeError, match="no attribute 'shin'"):
        _ = skin.shin
    code = f"import sys, skin; print(*({HEAVY} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "", done.stderr


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
    generation = ["generate", SMALL[0], "n=20", "out=x.parquet"]
    for verb, *words in (["train", "experiment=rules", *SMALL], generation):
        done = run(tmp_path, verb, *words, store=verb == "train")
        assert done.returncode == 0, done.stderr
    trained = skin.load_run("latest", f"sqlite:///{tmp_path}/m.db")
    touches = skin.read_recording(tmp_path / "x.parquet").touches
    probabilities = trained.learner.probabilities(touches)
    assert probabilities.shape == (20, len(trained.labels))
    assert trained.labels == ("big", "dynamic", "press", "dangerous")
    assert 0 <= probabilities.min() <= probabilities.max() <= 1


def run_example(page):
    (code,) = re.findall(r"^```python\n(.*?)^```", (ROOT / page).read_text(), re.DOTALL | re.MULTILINE)
    variables = {}
    exec(code, variables)
    return variables


def python(code, folder):
    """Return what Python code prints in a process of its own, in lines; no database is written."""
    (folder / "mlflow.db").touch()
    line = [sys.executable, "-c", code]
    done = subprocess.run(line, cwd=folder, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert (folder / "mlflow.db").stat().st_size == 0
    return done.stdout.splitlines()


@pytest.fixture(scope="module")
def readme(tmp_path_factory):
    (code,) = re.findall(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text(), re.DOTALL | re.MULTILINE)
    told = "\nprint(*run.labels); print(*run.predict(readings)[0])\n"
    return python(code + told + WHICH, tmp_path_factory.mktemp("readme"))


def test_the_example_of_the_readme_runs_without_what_only_training_needs(readme):
    *said, labels, values, found = readme
    probabilities = dict(zip(labels.split(), map(float, values.split()), strict=True))
    assert len(probabilities) == 4
    assert probabilities["press"] > 0.5 > probabilities["big"]
    assert "dangerous" in "".join(said)
    assert not found


@pytest.mark.parametrize(
    "code",
    [
        pytest.param(POSTERIOR, id="posterior", marks=pytest.mark.slow("solves a skin besides its imports")),
        pytest.param(LIVE, id="live", marks=pytest.mark.slow("a live view besides the import of torch")),
    ],
)
def test_what_only_training_needs_is_not_imported(code, tmp_path):
    *said, found = python(f"{code}\n{WHICH}", tmp_path)
    assert said
    assert not found


@pytest.mark.slow("solves a skin of 12 mm")
def test_the_simulator_is_differentiable_as_documented():
    made = run_example("docs/mechanics.md")
    assert made["readings"].shape == (20,)
    assert made["pressure"].grad.abs().max() > 0


def test_a_loop_of_ones_own_trains(capsys):
    made = runpy.run_path(str(ROOT / "docs/tutorials/tutorial_6_own_loop.py"))
    assert made["loss"] < 0.65  # ln 2 at the start
    assert "dangerous" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"simulater": "naive"}, "Could not override 'simulater'"),
        ({"data": {"gestures": "few"}}, "Value 'few' of type 'str' could not be converted to Integer"),
        ({"data": None}, "must be a string or a list"),
        ({"device": {"offset": -1}}, "device.offset=-1 must be greater than or equal to 0"),
        ({"layout": {"path": "none.csv"}}, "no layout file none.csv"),
    ],
)
def test_data_that_cannot_be_made_are_refused(settings, message):
    with pytest.raises(skin.InputError, match=message):
        skin.data(**settings)


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    """Return the variables of the example of the page on ``any_skin`` and its prediction."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("example"))
        made = run_example("docs/pretrained.md")
        return made | {"probabilities": made["run"].predict(made["readings"])}


def test_the_example_predicts_from_an_array_one_window_and_a_list(example):
    run, readings, probabilities = (example[name] for name in ("run", "readings", "probabilities"))
    assert run.positions.shape == (9, 3)
    assert isinstance(probabilities, np.ndarray)
    assert (probabilities.shape, probabilities.dtype) == ((1, 4), np.float32)
    expected = dict(zip(run.labels, probabilities[0], strict=True))
    assert expected["press"] > 0.5 > expected["big"]
    np.testing.assert_allclose(run.predict(readings[0]), probabilities[0], atol=1e-5)
    np.testing.assert_allclose(run.predict(readings.tolist()), probabilities, atol=1e-5)
    assert run.predict(readings[:0]).shape == (0, 4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda readings: readings[:, :20], r"\(B, 30, 9\) or \(30, 9\).*got \(1, 20, 9\)"),
        (lambda readings: readings[..., :8], r"9 sensors, got \(1, 30, 8\)"),
        (lambda readings: readings[0, 0], r"got \(9,\)"),
        (lambda readings: readings + np.inf, "must be finite: give NaN"),
        (lambda readings: [["touch"]], "must be an array of numbers"),
    ],
)
def test_other_arrays_are_refused(example, change, message):
    with pytest.raises(skin.InputError, match=message):
        example["run"].predict(change(example["readings"]))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"body": "sleeve"}, "there is no body sleeve: give one of arm, sheet"),
        ({"body": 3}, "body must be a body such as skin.Sheet"),
        ({"layout": "gird"}, "there is no layout gird: give one of file, grid"),
        ({"layout": "none.csv"}, "no layout file none.csv"),
    ],
)
def test_a_skin_that_cannot_be_built_is_refused(settings, message, tmp_path):
    with pytest.raises(skin.InputError, match=message):
        skin.load_run("any_skin", f"sqlite:///{tmp_path}/m.db", **settings)
