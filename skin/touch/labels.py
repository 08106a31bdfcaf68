"""What is learned of a touch: labels with their measures and thresholds, classes, or measured targets.

Everything about a label of simulated touches is here: its name, the name of its opposite, the measure of the
movie that decides, and the threshold. A label of one's own has the same four in ``conf/touch/NAME.yaml``
(CONTRIBUTING.md). torch is not imported here: an exported model needs no torch.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from math import inf
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Gt, Lt, MinLen
from pydantic import PositiveFloat

from skin.core.settings import ONCE, checked, configured
from skin.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

    from skin.body.base import AbstractBody
    from skin.touch.movie import Movie


@dataclass(frozen=True)
class Task:
    """Names and kind of a device's labels; they determine head width, loss, metrics and table columns.

    Attributes:
        names: one name per label, in the order of the label tensor's last axis.
        kind: ``binary`` (each label holds or not by itself), ``exclusive`` (exactly one holds) or
            ``regression`` (each is a measured target, such as x, m, or force, N).
        gate: the label without which the others are undefined (report, 4.2), such as ``touch``; None: all
            labels are always defined.
        direction: the last two labels are not binary but the cosines of a direction with x and y, -1 to 1.
            Both are 0 if a touch has no direction; they are then undefined.

    Raises:
        ValueError: an unknown gate, or labels with a gate or a direction that are not binary.
    """

    names: Annotated[tuple[str, ...], MinLen(1), ONCE]
    kind: Literal["binary", "exclusive", "regression"] = "binary"
    gate: str | None = None
    direction: bool = False

    def __post_init__(self) -> None:
        if self.gate is not None and (self.kind != "binary" or self.gate not in self.binary):
            raise ValueError(f"{self.gate} cannot gate the {self.kind} labels {self.names}")
        if self.direction and (self.kind != "binary" or len(self.names) < 3):
            raise ValueError(f"a direction must follow binary labels, got {self.kind} {self.names}")

    def __len__(self) -> int:
        return len(self.names)

    @property
    def binary(self) -> tuple[str, ...]:
        """The names of all labels but a direction's; a regression has none."""
        return () if self.kind == "regression" else self.names[: -2 if self.direction else None]

    @property
    def gated(self) -> tuple[str, ...]:
        """The names of all labels but the gate and a direction's."""
        return tuple(name for name in self.binary if name != self.gate)

    def with_labels(self, names: tuple[str, ...]) -> "Task":
        """Return this task with other labels behind those of ``TOUCH``; a gate or a direction stays last."""
        count = len(TOUCH)
        return replace(self, names=(*self.names[:count], *names, *self.names[count:]))

    def counts(self, labels: "Tensor") -> "Tensor":
        """Return the mask of the labels (B, L) that are known and defined by gate and direction, bool.

        Unknown labels are NaN.
        """
        counts = labels.new_ones(labels.shape).bool()
        if self.gate is not None:
            gate = self.names.index(self.gate)
            counts = (labels[:, gate : gate + 1] > 0.5).repeat(1, len(self))
            counts[:, gate] = True
        if self.direction:
            counts[:, -2:] &= (labels[:, -2:] != 0).any(dim=1, keepdim=True)
        return counts & ~labels.isnan()

    def fractions(self, labels: "Tensor") -> "Tensor":
        """Return labels (B, L) as the expected probabilities, 0 to 1: cosines c become (1 + c) / 2.

        The mean of c then minimises the cross-entropy, as the fraction of true cases does for a label.
        """
        if not self.direction:
            return labels
        targets = labels.clone()
        targets[:, -2:] = (1 + labels[:, -2:]) / 2
        return targets


def target_unit(name: str) -> str:
    """Return the unit of a target in recordings: m of a position, N of a force, otherwise empty."""
    return "m" if name in PLACE else "N" if name.startswith("force") else ""


PLACE = ("x", "y")
"""The targets that together are a position."""


@checked("touch.thresholds")
@dataclass(frozen=True)
class Thresholds:
    """Thresholds of the labels (report, section 2.1.1).

    Attributes:
        area: a touch is big if it covers more than this fraction of the sheet.
        duration: a touch is a press if it lasts longer than this without interruption, s.
        pressure: without ``touch.limits`` a touch is dangerous if some sensor's surface pressure exceeds this
            in some frame, Pa (cuff algometry, Jespersen et al.).
        contact: cells above this fraction of the gesture's peak cell are in contact.
        travel: a touch is dynamic if its centre of pressure moves further than this from where it began, m.
    """

    area: Annotated[float, Gt(0), Lt(1)] = 0.30
    duration: Annotated[float, Ge(0)] = 0.3
    pressure: float = 90.5e3
    contact: Annotated[float, Gt(0), Lt(1)] = 0.02
    travel: float = 1e-3


def _pressure(
    limit: PositiveFloat, unit: Literal["Pa", "kPa", "MPa", "N/cm2"], source: Annotated[str, MinLen(1)]
) -> float:
    """Return an entry of a table of limits in Pa."""
    return limit * {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "N/cm2": 1e4}[unit]


def _force(limit: PositiveFloat, unit: Literal["N"], source: Annotated[str, MinLen(1)]) -> float:
    """Return an entry of a table of limits in N."""
    return float(limit)


@dataclass(frozen=True)
class Limits:
    """Limits above which a touch is dangerous, in place of ``Thresholds.pressure``; infinite: no limit.

    Attributes:
        pressure: of lasting contact, of a press: mean over a sensor's footprint, Pa.
        force: of lasting contact, all that touches at a time, N.
        tap_pressure: of transient contact, of a tap, Pa.
        tap_force: of transient contact, N.
        human_force: the largest force that a person exerts, N. Touches of larger force are not drawn.
    """

    pressure: float = inf
    force: float = inf
    tap_pressure: float = inf
    tap_force: float = inf
    human_force: float = inf

    @classmethod
    def of(cls, table: "Mapping[str, Any] | Limits | None") -> "Limits | None":
        """Return the limits of a table (``conf/limits``); None if it is empty.

        Args:
            table: name of a limit -> limit, unit and source. Without limits of its own, a tap has those of a
                press.

        Raises:
            InputError: an entry without unit or source, an unknown one, neither pressure nor force, or forces
                alone that no person exerts.
        """
        if isinstance(table, Limits) or not table:
            return table if isinstance(table, Limits) else None
        if not isinstance(table, Mapping) or {"pressure", "force"}.isdisjoint(table):
            raise InputError(
                f"limits must give pressure, force or both, got {table}: "
                "as in pressure: {limit: 22.8, unit: kPa, source: title or address}"
            )
        values = {
            name: configured(_force if str(name).endswith("force") else _pressure, entry, f"limits.{name}")
            for name, entry in table.items()
        }
        taps = {f"tap_{name}": values[name] for name in ("pressure", "force") if name in values}
        limits = configured(cls, taps | values, "limits")
        if "pressure" not in values and limits.human_force <= max(limits.force, limits.tap_force):
            raise InputError(
                f"limits.human_force={limits.human_force:g} N must be above the limits of force, or no touch "
                "is dangerous: leave it out, or give limits.pressure, too"
            )
        return limits

    def of_contact(self, press: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the limits of pressure, Pa, and force, N, of presses and taps (B,), bool."""
        return np.where(press, self.pressure, self.tap_pressure), np.where(press, self.force, self.tap_force)

    def excess(self, pressure: np.ndarray, force: np.ndarray, press: np.ndarray) -> np.ndarray:
        """Return the largest ratio of pressure (B,), Pa, and force (B,), N, to their limits, (B,)."""
        return np.maximum(*map(np.divide, (pressure, force), self.of_contact(press)))


@dataclass(frozen=True)
class Label:
    """A binary label of simulated touches: it holds where a measure of the movie is above a threshold.

    Attributes:
        opposite: name of a touch without the label.
        measure: ``measure(movie, body)`` of a :class:`skin.touch.movie.Movie` (B) on a body gives a tensor
            (B,). In a configuration: ``{_target_: module.function, _partial_: true}``.
        above: the threshold, in the unit of the measure.
    """

    opposite: str
    measure: Any
    above: float


def _parameter(movie: "Movie", body: "AbstractBody", name: str) -> "Tensor":
    """Return a measure that is one of the parameters of a movie."""
    return movie.parameters[name]


ALARM = "dangerous"
"""The label that raises the alarm."""


def report_labels(thresholds: Thresholds, rate: float, limits: Limits | None = None) -> dict[str, Label]:
    """Return the four labels of the report (section 2.1.1) by name, in the order of ``TOUCH``.

    Args:
        thresholds: of the labels.
        rate: frames per second of the movie, Hz: the duration of a touch is counted in frames.
        limits: that decide what is dangerous; None: the pressure of the thresholds.
    """
    name, above = ("excess", 1.0) if limits else ("pressure", thresholds.pressure)
    return {
        "big": Label("small", partial(_parameter, name="area"), thresholds.area),
        "dynamic": Label("static", partial(_parameter, name="travel"), thresholds.travel),
        "press": Label("tap", partial(_parameter, name="frames"), round(thresholds.duration * rate)),
        ALARM: Label("safe", partial(_parameter, name=name), above),
    }


OPPOSITE = {name: label.opposite for name, label in report_labels(Thresholds(), 1.0).items()}
"""Label -> name of its opposite."""

TOUCH = Task(tuple(OPPOSITE))
"""The four binary labels of the report, section 2.1.1."""

TOUCH_OR_NOT = Task((*TOUCH.names, "touch"), gate="touch")
"""The same with the report's fifth label (section 4.2); where it is 0 the other four are 0 too."""

TOUCH_SLIDING = Task((*TOUCH.names, "slide_x", "slide_y"), direction=True)
"""The four binary labels and the direction of sliding, as :func:`skin.touch.movie.sliding` gives it."""

CONTACT = ("x", "y", "radius", "force", "peak")
"""Columns of contacts: centre and radius (m), force (N) and highest pressure (Pa)."""

RELEASE = 0.3
"""Seconds without a rise that end a contact; a touch that ended within them is still classified."""
