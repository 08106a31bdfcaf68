"""What is learned of a touch: labels and their thresholds, classes, or measured targets.

torch is not imported here: an exported model needs no torch.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from annotated_types import Ge, Gt, Lt, MinLen

from skin.core.settings import ONCE, checked

if TYPE_CHECKING:
    from torch import Tensor


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
        ValueError: the gate is no label, or labels with a gate or a direction are not binary.
    """

    names: Annotated[tuple[str, ...], MinLen(1), ONCE]
    kind: Literal["binary", "exclusive", "regression"] = "binary"
    gate: str | None = None
    direction: bool = False

    def __post_init__(self) -> None:
        if self.gate is not None and (self.kind != "binary" or self.gate not in self.binary):
            raise ValueError(f"{self.gate} is no gate of the {self.kind} labels {self.names}")
        if self.direction and (self.kind != "binary" or len(self.names) < 3):
            raise ValueError(f"a direction stands behind binary labels, got {self.kind} {self.names}")

    def __len__(self) -> int:
        return len(self.names)

    @property
    def binary(self) -> tuple[str, ...]:
        """The names of all labels but a direction's; targets of a regression are no labels."""
        if self.kind == "regression":
            return ()
        return self.names[:-2] if self.direction else self.names

    @property
    def gated(self) -> tuple[str, ...]:
        """The names of all labels but the gate and a direction's."""
        return tuple(name for name in self.binary if name != self.gate)

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

    def shares(self, labels: "Tensor") -> "Tensor":
        """Return labels (B, L) as what a probability should be on average, 0 to 1: cosines c as (1 + c) / 2.

        The mean of c has the least cross-entropy then, as the share of true cases has it of a binary label.
        """
        if not self.direction:
            return labels
        shares = labels.clone()
        shares[:, -2:] = (1 + labels[:, -2:]) / 2
        return shares


def target_unit(name: str) -> str:
    """Return the unit of a target in recordings: m of a place, N of a force, and none of others."""
    return "m" if name in PLACE else "N" if name.startswith("force") else ""


PLACE = ("x", "y")
"""The targets that are a place together."""

TOUCH = Task(("big", "dynamic", "press", "dangerous"))
"""The four binary labels of the report, section 2.1.1."""

TOUCH_OR_NOT = Task((*TOUCH.names, "touch"), gate="touch")
"""The same with the report's fifth label (section 4.2); where it is 0 the other four are 0 too."""

TOUCH_SLIDING = Task((*TOUCH.names, "slide_x", "slide_y"), direction=True)
"""The four binary labels and the direction of sliding, as :func:`skin.touch.movie.sliding` gives it."""


CONTACT = ("x", "y", "radius", "force", "peak")
"""Columns of contacts: centre and radius (m), force (N) and highest pressure (Pa)."""

RELEASE = 0.3
"""s without a rise that end a contact; so long a touch that has ended is still judged."""

OPPOSITE = {"big": "small", "dynamic": "static", "press": "tap", "dangerous": "safe"}
"""Label -> name of its opposite."""


@checked("touch.thresholds")
@dataclass(frozen=True)
class Thresholds:
    """Thresholds of the labels (report, section 2.1.1).

    Attributes:
        area: a touch is big if it covers more than this share of the sheet.
        duration: a touch is a press if it lasts longer than this without interruption, s.
        pressure: a touch is dangerous if some sensor's surface pressure exceeds this in some frame, Pa
            (cuff algometry, Jespersen et al.).
        contact: cells above this share of the gesture's peak cell are in contact.
        travel: a touch is dynamic if its centre of pressure moves further than this from where it began, m.
    """

    area: Annotated[float, Gt(0), Lt(1)] = 0.30
    duration: Annotated[float, Ge(0)] = 0.3
    pressure: float = 90.5e3
    contact: Annotated[float, Gt(0), Lt(1)] = 0.02
    travel: float = 1e-3
