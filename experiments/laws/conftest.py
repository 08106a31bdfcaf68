"""What the tests of laws record, and the page of it.

    pytest experiments/laws
    pytest experiments/laws --full --page=docs

The test ``test_hertz`` checks the law ``hertz``. Its docstring is the law and, behind "Reference:", the
source of the independent solution. ``--full`` solves finer meshes and more cases, with the same tolerances.
``--page`` writes physics.md and its numbers into a folder.
"""

import math
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, field
from inspect import getdoc
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from experiments.studies.pages import write_csv
from skin.core.files import write

RECORD = "law"
"""Name of the property of a report with the record of its law."""

NUMBERS = "results/physics/physics.csv"
"""File of all numbers, in the folder of the page."""


@dataclass
class Law:
    """What a test records of a law.

    Attributes:
        full: whether to solve the meshes and cases that are published; else a few coarse ones.
        name: of the law.
        findings: case, our number, the reference, the error and its tolerance, of each comparison.
        remarks: for the page.
    """

    full: bool
    name: str
    findings: list[dict[str, Any]] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)

    def compare(
        self, case: str, ours: float, reference: float, tolerance: float, error: float | None = None
    ) -> None:
        """Record a number and its reference.

        Args:
            case: what was computed.
            ours: our number.
            reference: the independent number.
            tolerance: the largest error that passes.
            error: None: the difference, relative to the reference if that is not 0.
        """
        error = abs(ours - reference) / (abs(reference) or 1.0) if error is None else error
        numbers = {"ours": ours, "reference": reference, "error": error, "tolerance": tolerance}
        finding: dict[str, Any] = {name: float(number) for name, number in numbers.items()}
        # A bound of rounding errors, of double precision where the tolerance is as strict.
        rounding = 1e-10 if tolerance <= 1e-8 else 1e-6
        text = f"< {rounding:.0e}" if error < rounding else f"{error:.2g}"
        excess = math.inf if math.isnan(error) else float(max(error, rounding) / tolerance)
        ok = "yes" if error <= tolerance else "no"  # one that is not finite is beyond
        self.findings.append({"case": case, **finding, "text": text, "excess": excess, "ok": ok})

    def misses(self) -> list[str]:
        """Return each comparison whose error is beyond its tolerance, or not finite, in words."""
        return [
            f"{each['case']}: {each['ours']:.6g}, must be {each['reference']:.6g}: "
            f"error {each['error']:.2g}, tolerance {each['tolerance']:g}"
            for each in self.findings
            if each["ok"] == "no"
        ]


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of the laws."""
    parser.addoption("--full", action="store_true", help="check laws on fine meshes, as published")
    parser.addoption("--page", type=Path, help="folder into which the page of the laws is written")


@pytest.fixture
def law(request: pytest.FixtureRequest) -> Law:
    """Return what the test records."""
    return Law(request.config.getoption("full"), request.node.name.removeprefix("test_"))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Function) -> Generator[None, None, None]:
    """Fail a test of a law that has recorded a miss; its report contains the record."""
    yield
    law: Any = item.funcargs["law"]
    statement, _, source = " ".join((getdoc(item.function) or "").split()).partition(" Reference: ")
    words = {"law": law.name, "statement": statement, "source": source.removesuffix(".")}
    record = words | {"findings": law.findings, "remarks": law.remarks}
    item.user_properties.append((RECORD, record))
    assert law.findings, "nothing was compared"
    assert not law.misses(), "\n".join(law.misses())


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Write the page of the laws that were checked."""
    groups = terminalreporter.stats.values()
    reports = [each for group in groups for each in group if getattr(each, "when", "") == "call"]
    reports.sort(key=lambda report: report.location[1] or 0)
    properties = [dict(report.user_properties) for report in reports]  # others belong to other tests
    records = [every[RECORD] for every in properties if RECORD in every]
    if (page := config.getoption("page")) and records:
        publish_laws(records, page)
        terminalreporter.write_line(f"{page / 'physics.md'}")


Record = Mapping[str, Any]
"""Name, statement, source, findings and remarks of a law."""

_PAGE = """# Physics, verified

Written by `make physics`, which fails if a law does not hold. Errors are those nearest to their tolerance;
rounding errors are an upper bound. [All numbers](results/physics/physics.csv) have the digits that are the
same on every processor. `pytest tests/mechanics` compares small examples, `solid` with scikit-fem, `fem` with
PyNite.

| law | statement | reference | error | tolerance | |
|---|---|---|---|---|---|
{lines}
{notes}
## Limits

- Only the linear theory is verified; many default gestures strain the skin beyond its
  [range](limitations.md).
- Surface displacements converge slowly where the skin is thin and nearly incompressible. Readings are more
  accurate, but an error of 1 % of the reading under an object can be a large part of a reading beside it.
- The thick block ends at 60 half sides: its surface moves 2 % less than that of a half-space.
- A tilted sensor at the interface of two layers reads a mean of the stresses above and below.
- Deep in an arm a footprint covers a shorter arc than the sensor (10 % less for the default sleeve).
- Contact is solved without friction. The traction of a sliding touch is added afterwards.
"""


def publish_laws(records: Sequence[Record], folder: Path) -> None:
    """Write physics.md, and the numbers of all laws, each file whole.

    The texts of the numbers have digits that do not depend on the processor.
    """
    findings = pd.DataFrame(
        [{"law": each["law"], **finding} for each in records for finding in each["findings"]]
    )
    texts = {name: findings[name].map("{:.5g}".format) for name in ("ours", "reference")}
    texts["ours"] = texts["ours"].where(findings.reference != 0, findings.text)
    texts |= {"error": findings.text, "tolerance": findings.tolerance.map("{:.2g}".format)}
    table = findings.assign(**texts)
    write_csv(table.drop(columns=["text", "excess"]), folder / NUMBERS)
    lines, notes = list[str](), list[str]()
    for record, (name, law) in zip(records, table.groupby("law", sort=False), strict=True):
        worst, missed = law.loc[law.excess.idxmax()], law[law.ok == "no"].itertuples()
        notes += [f"- {name}, **missed**: {finding.case}, error {finding.error}\n" for finding in missed]
        notes += [f"- {name}: {remark}\n" for remark in record["remarks"]]
        verdict = "holds" if (law.ok == "yes").all() else "**fails**"
        cells = name, record["statement"], record["source"], worst.error, worst.tolerance, verdict
        lines.append(f"| {' | '.join(cells)} |\n")
    write(_PAGE.format(lines="".join(lines), notes="".join(notes)), folder / "physics.md")
