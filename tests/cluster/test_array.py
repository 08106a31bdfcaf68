"""A task of a job array runs its part."""

import os
import subprocess

import pytest

from skin.core.files import ROOT

SCRIPTS = sorted((ROOT / "experiments" / "cluster").glob("*.sh"))


def test_a_task_runs_its_part_with_its_cores():
    task = {"SLURM_ARRAY_TASK_ID": "3", "SLURM_ARRAY_TASK_COUNT": "8", "SLURM_CPUS_PER_TASK": "4"}
    script = [str(ROOT / "experiments" / "cluster" / "array.sh"), "study", "study=norm", "seed=0,1"]
    kept = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}
    out = subprocess.check_output(script, env=kept | task | {"PYTHON": "echo"}, text=True)
    assert out == "-m skin study study=norm seed=0,1 shard=3/8\n"


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.name)
def test_a_script_is_correct_shell(path):
    subprocess.run(["bash", "-n", str(path)], check=True)
    assert os.access(path, os.X_OK)
