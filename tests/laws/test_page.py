"""Comparisons of laws are judged, and their page says which hold."""

import math

import numpy as np
import pytest

from experiments.laws import test_mechanics as laws
from experiments.laws.conftest import Law, publish_laws
from experiments.laws.references import Slab
from skin.body.base import Sensors
from skin.body.sheet import Sheet
from skin.core.files import ROOT
from skin.mechanics.simulator._mesh import Hexahedra


def record(law, statement="Things fall.", source="an apple"):
    about = {"law": law.name, "statement": statement, "source": source}
    return about | {"findings": law.findings, "remarks": law.remarks}


@pytest.mark.parametrize(
    ("ours", "reference", "error", "expected"),
    [(2.2, 2.0, None, 0.1), (-2.2, -2.0, None, 0.1), (0.05, 0.0, None, 0.05), (7, 1, 0.1, 0.1)],
)
def test_an_error_is_relative_and_passes_up_to_its_tolerance(ours, reference, error, expected):
    law = Law(False, "gravity")
    law.compare("case", ours, reference, expected + 1e-9, error)
    assert law.findings[0]["error"] == pytest.approx(expected)
    assert not law.misses()


@pytest.mark.parametrize("error", [0.11, math.nan, math.inf])
def test_a_miss_is_written_as_one(tmp_path, error):
    law = Law(False, "gravity", remarks=["a remark"])
    law.compare("this", 1.2, 1.0, 0.1, error)
    law.compare("that", 1.0, 1.0, 0.1)
    assert [miss.split(":")[0] for miss in law.misses()] == ["this"]
    publish_laws([record(law)], tmp_path)
    text = (tmp_path / "physics.md").read_text()
    assert f"| gravity | Things fall. | an apple | {error:.2g} | 0.1 | **fails** |" in text
    assert f"\n- gravity, **missed**: this, error {error:.2g}\n- gravity: a remark\n" in text
    assert "that, error" not in text
    table = (tmp_path / "results/physics/physics.csv").read_text().splitlines()
    assert table[1:] == [f"gravity,this,1.2,1,{error:.2g},0.1,no", "gravity,that,1,1,< 1e-06,0.1,yes"]


def test_the_files_are_the_same_where_rounding_differs(tmp_path):
    """Noise of double and of single precision, of either sign, and other laws worst by it."""

    def write_files(noise: float) -> tuple[str, str]:
        exact, single, real = (Law(False, name) for name in ("exact", "single", "real"))
        for law in (exact, single):
            law.compare("exact", 2.23588314 * (1 + 1e-13 * noise), 2.23588314, 1e-8)
        exact.compare("nothing", 1e-14 * noise, 0.0, 1e-10)
        single.compare("single", 66867.31 * (1 + 1e-7 * noise), 66867.31, 1e-6)
        real.compare("real", 0.98361523 * (1 + 1e-9 * noise), 0.98768812, 0.05)
        publish_laws([*map(record, (exact, single, real))], tmp_path)
        return (tmp_path / "physics.md").read_text(), (tmp_path / "results/physics/physics.csv").read_text()

    files = write_files(0.0)
    assert all(write_files(noise) == files for noise in (-3.1, -1.0, 0.4, 1.7, 3.0))
    for line in (
        "exact,exact,2.2359,2.2359,< 1e-10,1e-08,yes",
        "exact,nothing,< 1e-10,0,< 1e-10,1e-10,yes",
        "real,real,0.98362,0.98769,0.0041,0.05,yes",
    ):
        assert f"{line}\n" in files[1]


def test_the_page_in_the_docs_has_every_law():
    text = (ROOT / "docs/physics.md").read_text()
    names = {name.removeprefix("test_") for name in vars(laws) if name.startswith("test_")}
    for name in names:
        statement, _, source = getattr(laws, f"test_{name}").__doc__.partition("\n\n    Reference: ")
        assert f"\n| {name} | {' '.join(statement.split())} | {source.strip().removesuffix('.')} | " in text
    assert "missed" not in text
    table = (ROOT / "docs/results/physics/physics.csv").read_text().splitlines()[1:]
    assert {line.split(",")[0] for line in table} == names
    assert all(line.endswith(",yes") for line in table)


def test_a_wrong_stiffness_is_a_miss(monkeypatch):
    right = Hexahedra.stiffness
    monkeypatch.setattr(Hexahedra, "stiffness", lambda mesh: 1.1 * right(mesh))
    law = Law(False, "confined")
    laws.test_confined(law)
    assert law.misses()[0].startswith("motion of the surface, m/Pa: ")


def test_a_thick_layer_is_read_at_its_base():
    """Two rows of elements made 14 % of error here, and 94 % under a small disc on 30 mm."""
    slabs, depth = [Slab(0.02, 170e3, 0.499)], 0.0195
    body = Sheet((0.16, 0.16), (16, 16), laws.layers_of(slabs))
    ours = laws.disc_readings_of(body, Sensors(np.array([[0.08, 0.08, depth]]), laws.FOOTPRINT))[2, 0]
    exact = laws.exact_readings(slabs, depth)[2]
    assert ours == pytest.approx(exact, abs=0.015 * exact[0])
