"""Every command as a person starts it: a mistake is answered at once, in one sentence."""

import re
import subprocess
import sys

import pytest

from skin.config import ROOT

SCRIPTS = {path.name: path for path in (ROOT / "experiments").glob("*.py")}
COMMANDS = sorted(name for name, path in SCRIPTS.items() if '__name__ == "__main__"' in path.read_text())
GIVEN = {"paired.py": ["rules", "features"], "study.py": ["norm"]}
HEAVY = re.compile(r"\| +(torch|mlflow|pytorch_lightning|numpy|scipy)$", re.MULTILINE)


# Commands whose own settings may be wrong, and how.
VALUES = {
    "dead.py": "dead.devices=0",
    "direction.py": "direction.shear=-1",
    "embeddings.py": "embeddings.train=1",
    "holds.py": "holds.gestures=0",
    "margins.py": "gestures=0",
    "moving.py": "moving.devices=0",
    "stream.py": "stream.hours=0",
}


@pytest.mark.parametrize(("name", "mistake"), [*((name, "typo=1") for name in COMMANDS), *VALUES.items()])
def test_a_mistake_waits_for_no_heavy_import(name, mistake, tmp_path):
    command = [sys.executable, "-X", "importtime", str(SCRIPTS[name]), *GIVEN.get(name, []), mistake]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert "hydra" in done.stderr  # imports are told
    said = "\n".join(line for line in done.stderr.splitlines() if not line.startswith("import time:"))
    assert mistake.split("=")[0] in said
    assert "Traceback" not in said
    assert not HEAVY.findall(done.stderr)
