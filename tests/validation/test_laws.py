"""Every law of mechanics holds, in its quick version; and the command says which do."""

import json

import numpy as np
import pytest

from experiments.validation.__main__ import LAWS, main
from experiments.validation.references import Slab
from experiments.validation.solid import _layers, _under_discs, exact_readings
from skin.body.base import Sensors, Sheet
from skin.core.files import ROOT
from skin.errors import InputError
from skin.mechanics.simulator._hexahedra import Hexahedra

SOLVED = {"boussinesq", "cerruti", "hertz", "punch"}
SLOW = pytest.mark.slow("solves blocks for seconds")


@pytest.mark.parametrize(
    "law",
    [pytest.param(law, marks=SLOW if law.name in SOLVED else (), id=law.name) for law in LAWS],
)
def test_a_law_holds(law):
    outcome = law.check(True)
    assert outcome.findings
    for finding in outcome.findings:
        assert finding.ok, f"{finding.case}: {finding.ours}, must be {finding.reference}"
        assert finding.error <= finding.tolerance


def test_a_thick_layer_is_read_at_its_base():
    """Two rows of elements made 14 % of error here, and 94 % under a small disc on 30 mm."""
    slabs, depth = [Slab(0.02, 170e3, 0.499)], 0.0195
    body = Sheet((0.16, 0.16), (16, 16), _layers(slabs))
    ours = _under_discs(body, Sensors(np.array([[0.08, 0.08, depth]]), (0.01, 0.01)))[2, 0]
    exact = exact_readings(slabs, depth)[2]
    assert ours == pytest.approx(exact, abs=0.015 * exact[0])


def test_chosen_laws_are_written_where_they_should_be(tmp_path, capsys):
    assert main(["quick=true", "laws=locking,confined", f"out={tmp_path}"])
    lines = json.loads((tmp_path / "physics.json").read_text())
    assert {line["law"] for line in lines} == {"locking", "confined"}
    assert all(line["ok"] and line["error"] <= line["tolerance"] for line in lines)
    text = (tmp_path / "physics.md").read_text()
    assert "## locking\n" in text
    for picture in (tmp_path / "results" / "physics").iterdir():
        assert f"results/physics/{picture.name}" in text
    assert "confined: holds, 2 numbers" in capsys.readouterr().out


def test_some_laws_leave_the_page_alone(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = (ROOT / "docs" / "physics.md").read_bytes()
    assert main(["quick=true", "laws=confined,convergence"])
    assert capsys.readouterr().out.splitlines() == [
        "confined: holds, 2 numbers",
        "convergence: holds, 2 numbers",
    ]
    assert (ROOT / "docs" / "physics.md").read_bytes() == before
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("word", "reason"),
    [("laws=gravity", "got gravity"), ("quick=yes", "must be true or false"), ("law=hertz", "is no setting")],
)
def test_a_bad_setting_is_refused(word, reason):
    with pytest.raises(InputError, match=reason):
        main([word])


def test_a_law_that_fails_is_said_to(tmp_path, capsys, monkeypatch):
    """A solid whose stiffness is wrong by a tenth does not pass for the right one."""
    right = Hexahedra.stiffness
    monkeypatch.setattr(Hexahedra, "stiffness", lambda mesh: 1.1 * right(mesh))
    assert not main(["quick=true", "laws=confined", f"out={tmp_path}"])
    assert "confined: FAILS" in capsys.readouterr().out
    assert "**missed**" in (tmp_path / "physics.md").read_text()
