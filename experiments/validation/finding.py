"""The result of a law: our number, the independent one, and the tolerance."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Finding:
    """One number of ours beside the one it must be.

    Attributes:
        case: what was looked at.
        ours: our number.
        reference: the independent number.
        error: how far they are apart, relative unless the law says otherwise.
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
        """Whether the law holds; an error that is no number is a failure."""
        return math.isfinite(self.error) and self.error <= self.tolerance


@dataclass(frozen=True)
class Curve:
    """One line of a picture; ``marks`` draws points in place of a line."""

    label: str
    x: Sequence[float] | np.ndarray
    y: Sequence[float] | np.ndarray
    marks: bool = False


@dataclass(frozen=True)
class Plot:
    """Where a number tells too little.

    Attributes:
        name: of the file, without its ending.
        title, x, y: above and beside it.
        curves: what is drawn.
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
    """What checking a law gave: findings, remarks for the page that are judged by nobody, and pictures."""

    findings: Sequence[Finding]
    remarks: Sequence[str] = ()
    pictures: Sequence[Plot] = ()


@dataclass(frozen=True)
class Law:
    """A law and how it is checked.

    Attributes:
        name: short, lower case; ``laws=`` takes it.
        statement: what must hold.
        reference: where the independent answer comes from.
        check: from whether to be quick (coarser meshes, fewer cases, the same tolerances) to the outcome.
    """

    name: str
    statement: str
    reference: str
    check: Callable[[bool], CheckResult] = field(repr=False)


def relative_finding(case: str, ours: float, reference: float, tolerance: float) -> Finding:
    """Return the finding whose error is relative to the reference."""
    error = abs(ours - reference) / abs(reference) if reference else abs(ours)
    return Finding(case, ours, reference, error, tolerance)
