"""The result of checking a law: our number, the reference and the tolerance; and the page of all results."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from experiments.studies.pages import csv_text
from skin.core.files import json_line, whole, write
from skin.plot.figures import MARKS


@dataclass(frozen=True)
class Finding:
    """One number and its reference.

    Attributes:
        case: what was computed.
        ours: our number.
        reference: the independent number.
        error: of our number, relative unless the law says otherwise.
        tolerance: the largest error that passes.
    """

    case: str
    ours: float
    reference: float
    error: float
    tolerance: float

    def __post_init__(self) -> None:
        for name in ("ours", "reference", "error"):
            object.__setattr__(self, name, float(getattr(self, name)))

    @property
    def ok(self) -> bool:
        """Whether the error is within the tolerance; an error that is not finite is not."""
        return math.isfinite(self.error) and self.error <= self.tolerance


@dataclass(frozen=True)
class Curve:
    """One line of a plot; ``marks`` draws points instead of a line."""

    label: str
    x: Sequence[float] | np.ndarray
    y: Sequence[float] | np.ndarray
    marks: bool = False


@dataclass(frozen=True)
class Plot:
    """A plot of a check.

    Attributes:
        name: of the file, without its suffix.
        title, x, y: title and axis labels.
        curves: the lines.
        log: whether both axes are logarithmic.
    """

    name: str
    title: str
    x: str
    y: str
    curves: Sequence[Curve]
    log: bool = False


@dataclass(frozen=True)
class CheckResult:
    """The result of checking a law: findings, and remarks and plots for the page, which have no verdict."""

    findings: Sequence[Finding]
    remarks: Sequence[str] = ()
    plots: Sequence[Plot] = ()


@dataclass(frozen=True)
class Law:
    """A law and how it is checked.

    Attributes:
        name: short, lower case, as ``laws=`` takes it.
        statement: what must hold.
        reference: source of the independent solution.
        check: takes whether to be quick (coarser meshes, fewer cases, the same tolerances) and returns the
            result.
    """

    name: str
    statement: str
    reference: str
    check: Callable[[bool], CheckResult] = field(repr=False)


def relative_finding(case: str, ours: float, reference: float, tolerance: float) -> Finding:
    """Return a finding whose error is relative to the reference."""
    error = abs(ours - reference) / abs(reference) if reference else abs(ours)
    return Finding(case, ours, reference, error, tolerance)


Results = Sequence[tuple[Law, CheckResult]]

_HEAD = """# Physics, verified

Written by `make physics`, which exits with code 1 if a law does not hold: each is checked against an
independent solution; the table has the error nearest to its tolerance.
[Its numbers](results/physics/physics.csv) have the digits that are the same on every processor; rounding
errors are an upper bound. `results/physics.json` holds all digits of one machine.
`pytest tests/mechanics` checks what small examples can show: balance and reciprocity, `solid` against
scikit-fem, `fem` against PyNite, relaxation, `naive`, and contact.

| law | reference | error | tolerance | |
|---|---|---|---|---|
"""

# Rounding errors in double and in single precision; the tolerance of a finding tells which applies.
_DOUBLE, _SINGLE = 1e-10, 1e-6
_LINES = ("-", "--", "-.", ":")  # curves differ without colour

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


def publish_physics(folder: Path, json_path: Path, results: Results) -> None:
    """Write physics.md, its numbers and plots into a folder, and findings as JSON, each file atomically."""
    write(as_json(results), json_path)
    write(csv_text(_table(results)), folder / "results" / "physics" / "physics.csv")
    for _, outcome in results:
        for plot in outcome.plots:
            draw(plot, folder / "results" / "physics" / f"{plot.name}.png")
    write(physics_page(results), folder / "physics.md")


def as_json(results: Results) -> str:
    """Return the findings as a list of {law, case, ours, reference, error, tolerance, ok}."""
    lines = [
        {"law": law.name} | asdict(finding) | {"ok": finding.ok}
        for law, outcome in results
        for finding in outcome.findings
    ]
    return json_line(lines, indent=1) + "\n"


def physics_page(results: Results) -> str:
    """Return the page: a table with one line per law, then one section per law."""
    return _HEAD + "".join(map(_line, results)) + "".join(map(_section, results)) + _LIMITS


def _line(result: tuple[Law, CheckResult]) -> str:
    law, outcome = result
    worst = max(outcome.findings, key=_excess)
    verdict = "holds" if all(finding.ok for finding in outcome.findings) else "**fails**"
    return (
        f"| [{law.name}](#{law.name}) | {law.reference} | {_error(worst)} | "
        f"{worst.tolerance:.2g} | {verdict} |\n"
    )


def _section(result: tuple[Law, CheckResult]) -> str:
    law, outcome = result
    missed = [finding for finding in outcome.findings if not finding.ok]
    notes = [f"- **missed**: {finding.case}, error {_error(finding)}" for finding in missed]
    notes += [f"- {remark}" for remark in outcome.remarks]
    pictures = [f"![{plot.title}](results/physics/{plot.name}.png)" for plot in outcome.plots]
    parts = [f"\n## {law.name}", law.statement, "\n".join(notes), *pictures]
    return "\n\n".join(filter(None, parts)) + "\n"


def _table(results: Results) -> Iterator[Sequence[str]]:
    """Yield the header and a line per finding, with digits that do not depend on the processor."""
    yield "law", "case", "ours", "reference", "error", "tolerance", "ok"
    for law, outcome in results:
        for finding in outcome.findings:
            ours = f"{finding.ours:.5g}" if finding.reference else _error(finding)
            numbers = f"{finding.reference:.5g}", _error(finding), f"{finding.tolerance:.2g}"
            yield law.name, finding.case, ours, *numbers, "yes" if finding.ok else "no"


def _excess(finding: Finding) -> float:
    """Return the error, at least that of rounding, over its tolerance."""
    if math.isnan(finding.error):
        return math.inf
    return max(finding.error, _rounding(finding)) / finding.tolerance


def _rounding(finding: Finding) -> float:
    return _DOUBLE if finding.tolerance <= 1e-8 else _SINGLE


def _error(finding: Finding) -> str:
    bound = _rounding(finding)
    return f"< {bound:.0e}" if finding.error < bound else f"{finding.error:.2g}"


def draw(plot: Plot, path: Path) -> None:
    """Write a plot as PNG."""
    figure = Figure(figsize=(5.6, 3.4), layout="constrained")
    axes = figure.add_subplot()
    for curve, mark, line in zip(plot.curves, cycle(MARKS), cycle(_LINES), strict=False):
        if curve.marks:
            axes.plot(curve.x, curve.y, mark, markersize=3.5, label=curve.label)
        else:
            axes.plot(curve.x, curve.y, line, linewidth=1.2, label=curve.label)
    if plot.log:
        axes.set(xscale="log", yscale="log")
    axes.set(xlabel=plot.x, ylabel=plot.y, title=plot.title)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    with whole(path) as partial:
        figure.savefig(partial, dpi=100)
