"""make physics through its command: every law in its quick version, files, exit codes."""

import json

import pytest

from experiments.validation.laws import LAWS
from skin.paths import ROOT


@pytest.mark.slow
def test_every_law_holds(run, tmp_path):
    done = run(tmp_path, "validate", "validate.quick=true", f"out={tmp_path}", store=False)
    assert done.returncode == 0, done.stdout + done.stderr
    lines = json.loads((tmp_path / "physics.json").read_text())
    assert {line["law"] for line in lines} == {law.name for law in LAWS}
    assert all(line["ok"] and line["error"] <= line["tolerance"] for line in lines)
    text = (tmp_path / "physics.md").read_text()
    for law in LAWS:
        assert f"## {law.name}\n" in text
    for picture in (tmp_path / "results" / "physics").iterdir():
        assert f"results/physics/{picture.name}" in text


def test_some_laws_leave_the_page_alone(run, tmp_path):
    page = ROOT / "docs" / "physics.md"
    before = page.read_bytes() if page.exists() else None
    done = run(tmp_path, "validate", "validate.quick=true", "validate.laws=[confined,naive]", store=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["confined: holds, 2 numbers", "naive: holds, 1 numbers"]
    assert (page.read_bytes() if page.exists() else None) == before


def test_an_unknown_law_is_refused(run, tmp_path):
    done = run(tmp_path, "validate", "validate.laws=[gravity]", store=False)
    assert done.returncode == 2
    assert "got gravity" in done.stderr
    assert "hertz" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_law_that_fails_ends_with_one(run, tmp_path):
    """A solid whose stiffness is wrong by a tenth does not pass for the right one."""
    spoilt = tmp_path / "spoilt.py"
    spoilt.write_text(
        "from skin.simulator._hexahedra import Hexahedra\n"
        "right = Hexahedra.stiffness; Hexahedra.stiffness = lambda mesh: 1.1 * right(mesh)\n"
        "from skin.cli import main; import sys; main(['validate', *sys.argv[1:]])\n"
    )
    done = run(
        tmp_path, spoilt, "validate.quick=true", "validate.laws=[confined]", f"out={tmp_path}", store=False
    )
    assert done.returncode == 1, done.stderr
    assert "confined: FAILS" in done.stdout
    assert "**missed**" in (tmp_path / "physics.md").read_text()
