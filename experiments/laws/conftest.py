"""What the tests of laws record, and the page of it.

    pytest experiments/laws
    pytest experiments/laws --full --page=docs

The test ``test_hertz`` checks the law ``hertz``. Its docstring is the law and, behind "Reference:", the
source of the independent solution. ``--full`` solves finer meshes and more cases, with the same tolerances.
``--page`` writes physics.md, its numbers and its pictures into a folder.
"""

import math
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, field
from inspect import getdoc
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from experiments.studies.pages import write_csv
from skin.core.files import write
from skin.plot.figures import MARKS, save_figure

RECORD = "law"
"""Name of the property of a report with the record of its law."""

PICTURES = "results/physics"
"""Folder of the numbers and the pictures, in that of the page."""

Line = tuple[str, Sequence[float] | np.ndarray, Sequence[float] | np.ndarray, str]
"""Label, x, y, and ``-`` for a line or ``o`` for points."""


@dataclass
class Law:
    """What a test records of a law.

    Attributes:
        full: whether to solve the meshes and cases that are published; else a few coarse ones.
        name: of the law.
        pictures: folder of the pictures; None: none are drawn.
        findings: case, our number, the reference, the error and its tolerance, of each comparison.
        remarks: for the page.
        titles: of the pictures, by the names of their files.
    """

    full: bool
    name: str
    pictures: Path | None = None
    findings: list[dict[str, Any]] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    titles: dict[str, str] = field(default_factory=dict)

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
        if error is None:
            error = abs(ours - reference) / (abs(reference) or 1.0)
        numbers = {"ours": ours, "reference": reference, "error": error, "tolerance": tolerance}
        self.findings.append({"case": case} | {name: float(number) for name, number in numbers.items()})

    def draw(self, name: str, title: str, x: str, y: str, lines: Sequence[Line], log: bool = False) -> None:
        """Draw lines with these labels of the axes, which may be logarithmic, as a PNG file of some name."""
        self.titles[name] = title
        if self.pictures is None:
            return
        figure = Figure(figsize=(5.6, 3.4), layout="constrained")
        axes = figure.add_subplot()
        for (label, across, up, kind), mark, dashes in zip(
            lines, cycle(MARKS), cycle(("-", "--", "-.", ":")), strict=False
        ):
            style: dict[str, Any] = (
                {"marker": mark, "ls": "", "ms": 3.5} if kind == "o" else {"ls": dashes, "lw": 1.2}
            )
            axes.plot(across, up, label=label, **style)
        if log:
            axes.set(xscale="log", yscale="log")
        axes.set(xlabel=x, ylabel=y, title=title)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
        save_figure(figure, self.pictures / f"{name}.png")

    def misses(self) -> list[str]:
        """Return each comparison whose error is beyond its tolerance, or not finite, in words."""
        return [
            f"{each['case']}: {each['ours']:.6g}, must be {each['reference']:.6g}: "
            f"error {each['error']:.2g}, tolerance {each['tolerance']:g}"
            for each in self.findings
            if not _holds(each)
        ]


def _holds(finding: Mapping[str, Any]) -> bool:
    """Return whether the error is within the tolerance; an error that is not finite is not."""
    return math.isfinite(finding["error"]) and finding["error"] <= finding["tolerance"]


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of the laws."""
    parser.addoption("--full", action="store_true", help="check laws on fine meshes, as published")
    parser.addoption("--page", type=Path, help="folder into which the page of the laws is written")


@pytest.fixture
def law(request: pytest.FixtureRequest) -> Law:
    """Return what the test records."""
    page = request.config.getoption("page")
    name = request.node.name.removeprefix("test_")
    return Law(request.config.getoption("full"), name, page and page / PICTURES)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Function) -> Generator[None, None, None]:
    """Fail a test of a law that has recorded a miss; its report contains the record."""
    yield
    law: Any = item.funcargs["law"]
    paragraphs = [" ".join(part.split()) for part in (getdoc(item.function) or "").split("\n\n")]
    words = {"law": law.name, "statement": paragraphs[0]}
    words["source"] = paragraphs[1].removeprefix("Reference: ").removesuffix(".")
    record = words | {"findings": law.findings, "remarks": law.remarks, "titles": law.titles}
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
"""Name, statement, source, findings, remarks and titles of pictures of a law."""

_HEAD = """# Physics, verified

Written by `make physics`, which exits with code 1 if a law does not hold: each is checked against an
independent solution; the table has the error nearest to its tolerance.
[Its numbers](results/physics/physics.csv) have the digits that are the same on every processor; rounding
errors are an upper bound. `results/physics.xml` holds all digits of one machine.
`pytest tests/mechanics` checks what small examples can show: balance and reciprocity, `solid` against
scikit-fem, `fem` against PyNite, relaxation, `naive`, and contact.

| law | reference | error | tolerance | |
|---|---|---|---|---|
"""

_LIMITS = """
## Limits

- **Only the linear theory is verified.** Most default gestures strain the skin beyond its range; see
  [limitations](limitations.md).
- **Surface displacements converge slowly where the skin is thin and nearly incompressible.** Elements as
  long as the skin is thick restrict the sideways motion of material under a wide object, most of all beside
  its edge. Readings are more accurate, because the layers transmit the applied force; beside
  an edge, however, an error of 1 % of the reading under the object can be a large part of a small reading.
- **The thick block is finite.** It ends at 60 half sides, and its surface moves about 2 % less than that of
  a half-space, on any mesh.
- **A tilted sensor at the interface of two layers** interpolates linearly between the stresses above and
  below. The stress along the layers is discontinuous there: it reads a mean of both sides.
- **A footprint is defined on the unrolled surface.** Deep in an arm it covers a shorter arc than the sensor
  (10 % less for the default sleeve). The reading is the mean stress on that arc times the sensor's full
  area.
- **Contact is solved without friction.** The tangential traction of a sliding touch is added afterwards.
"""


def publish_laws(records: Sequence[Record], folder: Path) -> None:
    """Write physics.md, and the numbers of all laws beside the pictures, each file whole."""
    write_csv(findings_table(records), folder / PICTURES / "physics.csv")
    parts = [_HEAD, *map(_line, records), *map(_section, records), _LIMITS]
    write("".join(parts), folder / "physics.md")


def findings_table(records: Sequence[Record]) -> pd.DataFrame:
    """Return a line per finding, as texts with digits that do not depend on the processor."""
    lines = [
        {
            "law": record["law"],
            "case": finding["case"],
            "ours": f"{finding['ours']:.5g}" if finding["reference"] else _error(finding),
            "reference": f"{finding['reference']:.5g}",
            "error": _error(finding),
            "tolerance": f"{finding['tolerance']:.2g}",
            "ok": "yes" if _holds(finding) else "no",
        }
        for record in records
        for finding in record["findings"]
    ]
    return pd.DataFrame(lines)


def _line(record: Record) -> str:
    """Return the line of the table, with the finding nearest to its tolerance."""
    worst = max(record["findings"], key=_excess)
    verdict = "holds" if all(map(_holds, record["findings"])) else "**fails**"
    name, cells = record["law"], f"{_error(worst)} | {worst['tolerance']:.2g} | {verdict}"
    return f"| [{name}](#{name}) | {record['source']} | {cells} |\n"


def _section(record: Record) -> str:
    misses = [finding for finding in record["findings"] if not _holds(finding)]
    notes = [f"- **missed**: {finding['case']}, error {_error(finding)}" for finding in misses]
    notes += [f"- {remark}" for remark in record["remarks"]]
    pictures = [f"![{title}]({PICTURES}/{name}.png)" for name, title in record["titles"].items()]
    parts = [f"\n## {record['law']}", record["statement"], "\n".join(notes), *pictures]
    return "\n\n".join(filter(None, parts)) + "\n"


def _excess(finding: Mapping[str, Any]) -> float:
    """Return the error, at least that of rounding, over its tolerance."""
    if math.isnan(finding["error"]):
        return math.inf
    return max(finding["error"], _rounding(finding)) / finding["tolerance"]


def _rounding(finding: Mapping[str, Any]) -> float:
    """Return a bound of rounding errors, of double precision where the tolerance is as strict."""
    return 1e-10 if finding["tolerance"] <= 1e-8 else 1e-6


def _error(finding: Mapping[str, Any]) -> str:
    bound = _rounding(finding)
    return f"< {bound:.0e}" if finding["error"] < bound else f"{finding['error']:.2g}"
