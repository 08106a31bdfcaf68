"""The description of a network in its ONNX file."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Annotated, Any, Literal

from annotated_types import Ge, Gt, MinLen

from skin.errors import InputError
from skin.files import json_line
from skin.labels import Task
from skin.settings import ONCE, configured

KEY = "tactile_skin"
"""Key of the description, JSON, in the metadata of the file."""

SCHEMA = 1
"""Version of the description and of the inputs and outputs."""


@dataclass(frozen=True)
class ModelMetadata:
    """What a program must know to use an exported network.

    Attributes:
        run: id of the run.
        title: name of the run.
        version: of this package.
        labels: names of the outputs.
        kind, gate, direction: as in :class:`skin.labels.Task`.
        rate: Hz, of the frames in a window.
        window: T, frames.
        positions: of the sensors, (x, y, z), m.
        size: extent (x, y) of the sheet, m.
        saturation: largest force that the sensors of the training measured, N; None if unknown.
        threshold: a touch is dangerous where its probability is greater; None without that label.
        contact: N above the baseline that count as touch.
        learned: whether the label ``touch`` counts as touch, too.
        longest: s, longest touch of the training.
        skin: settings of the body, the layout, the simulator, the touches and the evaluation that the network
            was exported with; None if unknown, as in files of earlier versions.
        thresholds: rate of a device, Hz -> threshold at which safe touches raise the alarm of the live view
            as seldom as wanted; None: only ``threshold``, chosen for single windows.
        presses: (S, S), N, readings of a press at the limit of ``dangerous`` on each sensor; None if unknown.
    """

    run: str
    title: str
    version: str
    labels: Annotated[list[str], MinLen(1), ONCE]
    kind: Literal["binary", "exclusive"]
    gate: str | None
    direction: bool
    rate: Annotated[float, Gt(0)]
    window: Annotated[int, Ge(1)]
    positions: Annotated[list[tuple[float, float, float]], MinLen(1)]
    size: tuple[float, float]
    saturation: float | None
    threshold: float | None
    contact: Annotated[float, Gt(0)]
    learned: bool
    longest: Annotated[float, Gt(0)]
    skin: dict[str, Any] | None = None
    thresholds: dict[str, float] | None = None
    presses: list[list[float]] | None = None

    @property
    def task(self) -> Task:
        """The labels."""
        return Task(tuple(self.labels), self.kind, self.gate, self.direction)

    def text(self) -> str:
        """Return the description as JSON, with its schema and the number of sensors."""
        return json_line({"schema": SCHEMA, "sensors": len(self.positions), **asdict(self)})

    @classmethod
    def parse(cls, entries: Mapping[str, str], path: str) -> "ModelMetadata":
        """Return the description in the metadata of a file.

        Args:
            entries: the metadata.
            path: of the file, for messages.

        Raises:
            InputError: the description is missing, of another schema, or damaged.
        """
        again = "write it again with skin export"
        if KEY not in entries:
            raise InputError(f"{path} was not written by skin export: it describes no labels and no sensors")
        try:
            known = json.loads(entries[KEY])
            schema, sensors = known.pop("schema"), known.pop("sensors")
        except (ValueError, KeyError, AttributeError, TypeError) as error:
            raise InputError(f"{path} has a damaged description: {again}") from error
        if schema != SCHEMA:
            raise InputError(f"{path} has schema {schema}, this version reads {SCHEMA}: {again}")
        found = configured(cls, known, f"description of {path}")
        if len(found.positions) != sensors:
            raise InputError(f"{path} has {len(found.positions)} positions for {sensors} sensors: {again}")
        return found
