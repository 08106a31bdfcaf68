"""The results of the laws as a page, pictures and JSON."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from experiments.validation.finding import CheckResult, Finding, Law, Plot
from skin.files import whole, write

Results = Sequence[tuple[Law, CheckResult]]

_HEAD = """# Physics, proved

Written by `make physics` (`skin validate`). Every law is checked against an answer
that is not the simulator's own; one that does not hold ends the command with exit code 1. Only digits that
are the same on every processor are printed; errors of rounding stand as an upper bound. All digits of this
machine, for programs: `results/physics.json`.

| law | against | numbers | worst error | tolerance | |
|---|---|---|---|---|---|
"""

# Errors below this are rounding, in double and in single precision; the tolerance tells which of them it is.
_DOUBLE, _SINGLE = 1e-10, 1e-6

_LIMITS = """
## What this does not prove

- **It is the linear theory that is proved.** Most default gestures strain the skin beyond it; see
  [results](results.md#what-the-numbers-are-worth).
- **Motion of the surface converges slowly where the skin is thin and nearly incompressible.** What goes down
  under a wide object has to flow out sideways, and elements as long as the skin is thick hinder it,
  above all beside its edge: see `mesh` for the default mesh, a finer one and coarser ones. Readings suffer
  less, because what is pressed on has to come out below.
  Beside an edge, though, an error of 1 % of the reading under the object can be much of a small reading.
- **The thick block ends** at 60 half sides, so that its surface moves about 2 % less than a half-space does.
  No refinement mends that.
- **A sensor just at the joint of two layers** takes a line between the stresses above and below. What a
  tilted one feels of the stress along the layers jumps there; it reads a mean.
- **A footprint is cut out of the chart.** Deep in an arm it covers a shorter arc than the sensor does (10 %
  less for the default sleeve); the reading is the mean stress there times the sensor's full area.
- **Objects find their pressure without friction;** the drag of a sliding touch is added afterwards.
"""


def publish_physics(folder: Path, json_path: Path, results: Results) -> None:
    """Write physics.md and its pictures into a folder, and the findings as JSON, each whole."""
    write(as_json(results), json_path)
    for _, outcome in results:
        for picture in outcome.pictures:
            draw(picture, folder / "results" / "physics" / f"{picture.name}.png")
    write(page(results), folder / "physics.md")


def as_json(results: Results) -> str:
    """Return the findings as a list of {law, case, ours, reference, error, tolerance, ok}."""
    lines = [
        {"law": law.name} | asdict(finding) | {"ok": finding.ok}
        for law, outcome in results
        for finding in outcome.findings
    ]
    return json.dumps(_finite(lines), indent=1, allow_nan=False) + "\n"


def _finite(lines: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return lines with null for what is no number: JSON knows none."""
    return [
        {
            key: None if isinstance(value, float) and not math.isfinite(value) else value
            for key, value in line.items()
        }
        for line in lines
    ]


def page(results: Results) -> str:
    """Return the page: one line per law, then its figures."""
    return _HEAD + "".join(map(_line, results)) + "".join(map(_section, results)) + _LIMITS


def _line(result: tuple[Law, CheckResult]) -> str:
    law, outcome = result
    worst = max(
        outcome.findings,
        key=lambda one: math.inf if math.isnan(one.error) else max(one.error, _rounding(one)) / one.tolerance,
    )
    verdict = "holds" if all(one.ok for one in outcome.findings) else "**fails**"
    return (
        f"| [{law.name}](#{law.name}) | {law.reference} | {len(outcome.findings)} | {_error(worst)} | "
        f"{worst.tolerance:.0e} | {verdict} |\n"
    )


def _section(result: tuple[Law, CheckResult]) -> str:
    law, outcome = result
    lines = [f"\n## {law.name}\n\n{law.statement}\n\n"]
    lines.append("| | ours | reference | error | tolerance | |\n|---|---|---|---|---|---|\n")
    for one in outcome.findings:
        ours = f"{one.ours:.5g}" if one.reference else _error(one)
        lines.append(
            f"| {one.case} | {ours} | {one.reference:.5g} | {_error(one)} | {one.tolerance:.0e} | "
            f"{'ok' if one.ok else '**missed**'} |\n"
        )
    lines += [f"\n- {remark}" for remark in outcome.remarks]
    lines += [f"\n\n![{picture.title}](results/physics/{picture.name}.png)" for picture in outcome.pictures]
    return "".join(lines).rstrip("\n") + "\n"


def _rounding(finding: Finding) -> float:
    return _DOUBLE if finding.tolerance <= 1e-8 else _SINGLE


def _error(finding: Finding) -> str:
    bound = _rounding(finding)
    return f"< {bound:.0e}" if finding.error < bound else f"{finding.error:.2g}"


def draw(picture: Plot, path: Path) -> None:
    """Write a picture as a PNG."""
    figure = Figure(figsize=(5.6, 3.4), layout="constrained")
    axes = figure.add_subplot()
    for curve in picture.curves:
        style = {"marker": "o", "markersize": 3.5, "linestyle": "none"} if curve.marks else {"linewidth": 1.2}
        axes.plot(curve.x, curve.y, label=curve.label, **style)
    if picture.log:
        axes.set(xscale="log", yscale="log")
    axes.set(xlabel=picture.x, ylabel=picture.y, title=picture.title)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    with whole(path) as partial:
        figure.savefig(partial, dpi=100)
