"""Findings are judged, written for people and for programs, and a miss is shown as one."""

import json
import math
import re

import pytest

from experiments.validation import (
    CheckResult,
    Curve,
    Finding,
    Law,
    Plot,
    as_json,
    physics_page,
    publish_physics,
    relative_finding,
)
from experiments.validation.__main__ import LAWS, select_laws
from skin.core.files import ROOT
from skin.errors import InputError

MISS = CheckResult(
    [relative_finding("this", 1.2, 1.0, 0.1), relative_finding("that", 1.0, 1.0, 0.1)], ["a remark"]
)
LAW = Law("gravity", "Things fall.", "an apple", lambda quick: MISS)


@pytest.mark.parametrize(
    ("error", "ok"), [(0.0, True), (0.1, True), (0.11, False), (math.nan, False), (math.inf, False)]
)
def test_an_error_passes_up_to_its_tolerance(error, ok):
    assert Finding("case", 1, 1, error, 0.1).ok is ok


def test_errors_are_relative():
    assert relative_finding("case", 2.2, 2.0, 1).error == pytest.approx(0.1)
    assert relative_finding("case", -2.2, -2.0, 1).error == pytest.approx(0.1)
    assert relative_finding("case", 0.3, 0.0, 1).error == pytest.approx(0.3)


def test_a_miss_is_written_as_one(tmp_path):
    picture = Plot("apple", "An apple", "time, s", "height, m", [Curve("ours", [1, 2], [4, 1])])
    outcome = CheckResult(MISS.findings, MISS.remarks, [picture])
    publish_physics(tmp_path, tmp_path / "physics.json", [(LAW, outcome)])
    text = (tmp_path / "physics.md").read_text()
    assert "| [gravity](#gravity) | an apple | 0.2 | 0.1 | **fails** |" in text
    assert "- **missed**: this, error 0.2\n" in text
    assert "that, error" not in text
    table = (tmp_path / "results" / "physics" / "physics.csv").read_text().splitlines()
    assert table[1:] == ["gravity,this,1.2,1,0.2,0.1,no", "gravity,that,1,1,< 1e-06,0.1,yes"]
    assert "a remark" in text
    assert (tmp_path / "results" / "physics" / "apple.png").stat().st_size > 2000
    assert not list(tmp_path.rglob("*.part"))
    lines = json.loads((tmp_path / "physics.json").read_text())
    assert [line["ok"] for line in lines] == [False, True]
    assert lines[0] == {
        "law": "gravity", "case": "this", "ours": 1.2, "reference": 1.0,
        "error": pytest.approx(0.2), "tolerance": 0.1, "ok": False,
    }  # fmt: skip
    assert "nan" in physics_page([(LAW, CheckResult([Finding("lost", math.nan, 1, math.nan, 0.1)]))])
    assert "NaN" not in as_json([(LAW, CheckResult([Finding("lost", math.nan, 1, math.nan, 0.1)]))])


def test_the_files_are_the_same_where_rounding_differs(tmp_path):
    """Noise of double and of single precision, of either sign, and other laws worst by it."""

    def write_files(noise: float) -> tuple[str, str]:
        exact = relative_finding("exact", 2.23588314 * (1 + 1e-13 * noise), 2.23588314, 1e-8)
        single = relative_finding("single", 66867.31 * (1 + 1e-7 * noise), 66867.31, 1e-6)
        nothing = relative_finding("nothing", 1e-14 * noise, 0.0, 1e-10)
        real = relative_finding("real", 0.98361523 * (1 + 1e-9 * noise), 0.98768812, 0.05)
        results = [(LAW, CheckResult(found)) for found in ([exact, nothing], [exact, single], [real])]
        publish_physics(tmp_path, tmp_path / "physics.json", results)
        table = tmp_path / "results" / "physics" / "physics.csv"
        return (tmp_path / "physics.md").read_text(), table.read_text()

    files = write_files(0.0)
    assert all(write_files(noise) == files for noise in (-3.1, -1.0, 0.4, 1.7, 3.0))
    assert "gravity,exact,2.2359,2.2359,< 1e-10,1e-08,yes\n" in files[1]
    assert "gravity,nothing,< 1e-10,0,< 1e-10,1e-10,yes\n" in files[1]
    assert "gravity,real,0.98362,0.98769,0.0041,0.05,yes\n" in files[1]


def test_laws_are_chosen_by_name():
    assert select_laws("all") == list(LAWS)
    assert [law.name for law in select_laws("punch,hertz")] == ["punch", "hertz"]
    assert len({law.name for law in LAWS}) == len(LAWS)
    for wrong in ("gravity", ""):
        with pytest.raises(InputError, match="hertz"):
            select_laws(wrong)


def test_the_page_in_the_docs_knows_every_law_and_its_pictures():
    text = (ROOT / "docs" / "physics.md").read_text()
    for law in LAWS:
        assert f"## {law.name}\n\n{law.statement}\n" in text
    for name in re.findall(r"\((results/physics/[^)]+)\)", text):
        assert (ROOT / "docs" / name).is_file()
    assert "missed" not in text
    table = (ROOT / "docs" / "results" / "physics" / "physics.csv").read_text().splitlines()[1:]
    assert {line.split(",")[0] for line in table} == {law.name for law in LAWS}
    assert all(line.endswith(",yes") for line in table)
