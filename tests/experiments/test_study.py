"""The command finds finished runs, trains what is missing, and gives verdicts; bad input is one sentence."""

import subprocess
import sys

import pytest

from skin.config import ROOT, checked, fingerprint
from skin.tracking import Store
from studies.study import SMOKE

# MLflow's own business with SQLAlchemy.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy")

STUDY = ROOT / "experiments" / "study.py"
LIGHT = f"""
import runpy, sys
sys.path.insert(0, {str(STUDY.parent)!r})
try:
    runpy.run_path({str(STUDY)!r}, run_name="__main__")
finally:
    print("heavy:", *sorted({{"torch", "mlflow", "pytorch_lightning", "numpy", "scipy"}} & set(sys.modules)))
"""


def light(folder, *arguments):
    """Run the command with a store and a folder of results of its own; it tells its heavy imports."""
    own = [f"tracking.uri=sqlite:///{folder}/m.db", f"tracking.artifacts={folder}/a", f"--out={folder}/r"]
    return subprocess.run(
        [sys.executable, "-c", LIGHT, *arguments, *own],
        capture_output=True,
        text=True,
        timeout=300,
        cwd=folder,
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory, configured):
    """A store with finished runs of one study: silu has 80, 81, 82 %, relu 10 points less, elu 10 more."""
    folder = tmp_path_factory.mktemp("studies")
    row = ["sweep=activation", "experiment=temporal_graph", f"tracking.uri=sqlite:///{folder}/m.db"]
    for activation, gain in (("silu", 0.0), ("relu", -0.1), ("elu", 0.1)):
        for seed in range(3):
            config = checked(configured(*row, f"model.activation={activation}", f"seed={seed}"))
            store = Store.open(config.tracking)
            # 0.002 more or less, that the differences have a spread
            value = 0.8 + gain * (1 + 0.02 * seed) + 0.01 * seed
            with store.run("made up", {"fingerprint": fingerprint(config)}) as run:
                store.log_metrics(run, {"same/overall/accuracy": value, "seconds_per_epoch": 1.0})
    return folder


def test_finished_runs_are_found_and_judged(run, folder):
    done = run(folder, "study.py", "activation", f"--out={folder}/r")
    assert done.returncode == 0, done.stderr
    assert "…" not in done.stdout, "nothing was to be trained"
    page = (folder / "r" / "study_activation.md").read_text()
    assert "| activation=silu | 81.0 ± 1.0 |" in page
    assert "+10.2 ± 0.1 points (activation=relu); -10.2 ± 0.1 points (activation=elu) | disagree |" in page
    assert len((folder / "r" / "study_activation.csv").read_text().splitlines()) == 10
    assert {path.name for path in (folder / "r").iterdir()} == {"study_activation.md", "study_activation.csv"}


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["pooling"], "graph_pooling"),
        (["norm", "typo=1"], "typo"),
        (["norm", "--seeds", "0"], "1 or more"),
    ],
)
def test_bad_input_ends_with_code_2_and_says_what(arguments, named, tmp_path):
    done = light(tmp_path, *arguments)
    assert (done.returncode, done.stdout.split()) == (2, ["heavy:"])
    assert named in done.stderr
    assert not list(tmp_path.iterdir())


def test_the_list_names_studies_and_statements_at_once(tmp_path):
    done = light(tmp_path, "--list")
    assert done.returncode == 0
    assert "edge_weight: " in done.stdout
    assert "  3.2.2  SiLU has a significant benefit" in done.stdout
    assert done.stdout.splitlines()[-1] == "heavy:"


@pytest.mark.slow
def test_what_is_missing_is_trained_and_what_failed_is_told(run, folder):
    # graph convolutions know this pooling, the transformer does not
    few = ["--smoke", "--seeds", "1", "model.pooling=attention", f"--out={folder}/r"]
    done = run(folder, "study.py", "transformer", *few)
    assert done.returncode == 1
    assert done.stdout.count("took") == 1
    assert all(setting in done.stdout.replace("\n", "") for setting in SMOKE[:2])
    assert "SMOKE" in done.stdout
    assert "SMOKE" in next((folder / "r").glob("study_*.md")).read_text()
    assert [line.count("| failed |") for line in table(folder, "transformer")] == [0, 1, 1]
    assert done.stderr.count("failed: model.pooling=attention must be 'mean' or 'max'") == 2


def table(folder, name):
    """Return the lines of a study's first table."""
    lines = (folder / "r" / f"study_{name}.md").read_text().split("\n\n")[1].splitlines()
    return lines[2:]
