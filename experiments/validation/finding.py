"""The result of checking a law: our number, the reference and the tolerance."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np


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
        name: short, lower case, as ``validate.laws`` takes it.
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
