"""A trained model: its interface, and the form of ``skin export``, which ONNX Runtime runs.

torch is not imported: :class:`skin.runs.build.TorchModel` is the form that needs it.
"""

import json
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Gt, MinLen
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.utils import instantiate
from numpy.typing import ArrayLike

from skin.core.files import json_line
from skin.core.safe_loading import check_content, limited_memory, read_file
from skin.core.settings import ONCE, check_groups, configured
from skin.errors import InputError
from skin.evaluation.alarm import AlarmSource
from skin.evaluation.decisions import LiveConditions
from skin.evaluation.guarantee import Guarantee
from skin.evaluation.operating_point import LABEL, DangerScore, OperatingPoint
from skin.touch.labels import Task


class Model(ABC):
    """Predicts the labels of touches of one skin.

    Args:
        identity: id of the run.
        title: name of the run.
        task: the labels.
        window: T, frames.
        rate: Hz, of the frames.
        positions: of the sensors, (S, 3), m.
        size: extent (x, y) of the skin, m.
        threshold: a window is dangerous where its probability is greater; None: not chosen, or no alarm.
        alarm: what decides where the alarm is raised.

    Attributes:
        identity, title, task, window, rate, positions, size, threshold, alarm: as above.
        contact: N above the baseline that count as touch.
        learned: whether the label ``touch`` counts as touch, too.
        longest: longest touch of the training, s.
        presses: readings of a press at the limit of ``dangerous`` on each sensor, (S, S), N; None: unknown.
    """

    contact: float
    learned: bool
    longest: float
    presses: np.ndarray | None

    def __init__(
        self,
        identity: str,
        title: str,
        task: Task,
        window: int,
        rate: float,
        positions: np.ndarray,
        size: tuple[float, float],
        threshold: float | None,
        alarm: AlarmSource,
    ) -> None:
        self.identity, self.title, self.task = identity, title, task
        self.window, self.rate, self.positions, self.size = window, rate, positions, size
        self.threshold, self.alarm = threshold, alarm

    @abstractmethod
    def probabilities(self, readings: np.ndarray, valid: np.ndarray) -> np.ndarray:
        """Return the probability of each label, (B, L), float32.

        Args:
            readings: (B, T, S), float32, N.
            valid: (B, T, S), bool.
        """

    def live_conditions(self, rate: float, patience: float, aligned: bool) -> LiveConditions:
        """Return how a live view watches a device of ``rate``, Hz, with a patience in s."""
        column = self.task.names.index(LABEL)
        return LiveConditions(rate, self.contact, self.longest, patience, column, aligned)

    @property
    def labels(self) -> tuple[str, ...]:
        """The names of the columns of :meth:`predict`."""
        return tuple(self.task.names)

    @property
    def alarms(self) -> bool:
        """Whether the model predicts danger."""
        return LABEL in self.task.names

    def predict(self, readings: ArrayLike) -> np.ndarray:
        """Return the probability of each label, (B, L), float32, for windows of readings.

        Args:
            readings: (B, T, S), N above the readings without touch, in the order of :attr:`positions`, with
                T = :attr:`window` frames at :attr:`rate`; or one window (T, S). NaN is an invalid reading.

        Returns:
            An array whose shape is (L,) for one window.

        Raises:
            InputError: the readings are no numbers, are infinite, or have another shape.
        """
        windows = self._windows(readings)
        if not windows.size:
            return np.empty((*windows.shape[:-2], len(self.labels)), np.float32)
        batch = windows.reshape(-1, *windows.shape[-2:])
        return self.probabilities(np.nan_to_num(batch), ~np.isnan(batch)).reshape(*windows.shape[:-2], -1)

    def _windows(self, readings: ArrayLike) -> np.ndarray:
        """Return readings as (B, T, S) or (T, S), float32."""
        try:
            windows = np.array(readings, dtype=np.float32)
        except (TypeError, ValueError) as error:
            raise InputError(f"readings must be an array of numbers: {error}") from error
        frames, sensors = self.window, len(self.positions)
        if windows.ndim not in (2, 3) or windows.shape[-2:] != (frames, sensors):
            raise InputError(
                f"readings must be (B, {frames}, {sensors}) or ({frames}, {sensors}), windows of {frames} "
                f"frames at {self.rate:g} Hz of {sensors} sensors, got {windows.shape}"
            )
        if np.isinf(windows).any():
            raise InputError("readings must be finite: give NaN for an invalid reading")
        return windows


# The form of skin export.


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
        kind, gate, direction: as in :class:`skin.touch.labels.Task`.
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
        scores: rate of a device, Hz -> ``odds``, ``level`` and ``offset`` of what is compared with the
            threshold for touches (:class:`skin.evaluation.operating_point.DangerScore`); None: the network's
            probability is.
        limits: above which a touch is dangerous: pressures, Pa, and forces, N, without those that are none;
            None if unknown.
        guarantees: rate of a device, Hz -> the attributes of what its threshold guarantees
            (:class:`skin.evaluation.guarantee.Guarantee`); None: it was not chosen for that.
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
    scores: dict[str, tuple[float, float, float]] | None = None
    limits: dict[str, float] | None = None
    guarantees: dict[str, dict[str, Any]] | None = None

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
            content = json.loads(entries[KEY])
            schema, _ = content.pop("schema"), content.pop("sensors")
        except (ValueError, KeyError, AttributeError, TypeError) as error:
            raise InputError(f"{path} has a damaged description: {again}") from error
        if schema != SCHEMA:
            raise InputError(f"{path} has schema {schema}, this version reads {SCHEMA}: {again}")
        return configured(cls, content, f"description of {path}")


_BYTES = 1 << 28  # of a file: ten times the largest network of this package


def _libraries() -> tuple[ModuleType, ModuleType]:
    """Return onnx and onnxruntime."""
    try:
        import onnx
        import onnxruntime
    except ModuleNotFoundError as error:
        raise InputError(
            "an ONNX model needs onnx and onnxruntime: pip install onnx onnxruntime, or "
            "'tactile-skin[export]'"
        ) from error
    return onnx, onnxruntime


def inspect(path: Path) -> tuple[bytes, ModelMetadata]:
    """Return the content of an ONNX file and the description of its network.

    Raises:
        InputError: the file was not written by ``skin export``, is damaged, or has other inputs or outputs.
    """
    onnx, _ = _libraries()
    from google.protobuf.message import DecodeError  # onnx needs it

    try:
        content = read_file(path, _BYTES)
        model = onnx.ModelProto.FromString(content)
    except (OSError, ValueError, DecodeError) as error:
        raise InputError(
            f"cannot read the model {path}: {error}: skin export run=latest out={path} writes one"
        ) from error
    entries = {entry.key: entry.value for entry in model.metadata_props}
    metadata = ModelMetadata.parse(entries, str(path))
    shape, types = [metadata.window, len(metadata.positions)], onnx.TensorProto
    tensors = {value.name: value.type.tensor_type for value in model.graph.input}
    inputs = {
        name: (tensor.elem_type, [axis.dim_value for axis in tensor.shape.dim][1:])
        for name, tensor in tensors.items()
    }
    wanted = {"readings": (types.FLOAT, shape), "valid": (types.BOOL, shape)}
    if inputs != wanted or [value.name for value in model.graph.output] != ["probabilities"]:
        raise InputError(
            f"{path} has inputs {inputs}, not readings (float) and valid (bool) of {shape}, or other outputs "
            "than probabilities: export it again"
        )
    try:
        check_content(content)
    except ValueError as error:
        raise InputError(f"{path}: {error}: export it again") from error
    return content, metadata


class OnnxModel(Model):
    """A network that ``skin export`` wrote.

    Args:
        path: of the file.

    Attributes:
        path: as above.
        metadata: its description.

    Raises:
        InputError: ONNX or ONNX Runtime is missing, the file cannot be used or is damaged, or it takes more
            memory than a network needs.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path).expanduser()
        content, metadata = inspect(self.path)
        self.metadata, positions, threshold = metadata, np.array(metadata.positions), metadata.threshold
        scores, promises = metadata.scores or {}, metadata.guarantees or {}
        points = {
            rate: OperatingPoint(
                above,
                score=DangerScore(*scores[rate]) if rate in scores else None,
                guarantee=configured(Guarantee, promises[rate], f"guarantee of {self.path}")
                if rate in promises
                else None,
            )
            for rate, above in (metadata.thresholds or {}).items()
        }
        single = None if threshold is None else OperatingPoint(threshold)
        alarm = AlarmSource(str(self.path), exported=single, points=points)
        facts = metadata.run, metadata.title, metadata.task, metadata.window, metadata.rate
        super().__init__(*facts, positions, metadata.size, threshold, alarm)
        self.contact, self.learned, self.longest = metadata.contact, metadata.learned, metadata.longest
        self.presses = None if metadata.presses is None else np.array(metadata.presses)
        self._try(content)

    def probabilities(self, readings: np.ndarray, valid: np.ndarray) -> np.ndarray:
        """Return the probability of each label, (B, L), float32.

        Args:
            readings: (B, T, S), float32, N.
            valid: (B, T, S), bool.
        """
        return self._session.run(["probabilities"], {"readings": readings, "valid": valid})[0]  # type: ignore[return-value]

    def _try(self, content: bytes) -> None:
        """Load a file and classify a window of zeros, in bounded memory."""
        _, runtime = _libraries()  # imported before memory is limited
        options = runtime.SessionOptions()
        # One thread: a window alone is too small to be shared among threads.
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4  # its errors are reported by the caller
        shape = (1, self.window, len(self.positions))
        try:
            with limited_memory(1 << 30):  # bytes; a window takes some MB
                self._session = runtime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
                result = self.probabilities(np.zeros(shape, np.float32), np.ones(shape, bool))
        except Exception as error:  # those of ONNX Runtime share no other base
            raise InputError(f"ONNX Runtime cannot load {self.path}: export it again") from error
        wanted = result.shape == (1, len(self.labels)) and result.dtype == np.float32
        if not wanted or not np.isfinite(result).all():
            raise InputError(
                f"{self.path} does not give probabilities of its {len(self.labels)} labels: export it again"
            )


GROUPS = ("body", "layout", "simulator", "touch", "evaluation")
"""Groups of settings that describe the skin of a network and how its threshold was chosen."""

# What an exported network leaves to the command line.
_FREE = ("device", "live", "web", "seconds", "run", "trust", "tracking", "hydra")


def describe_skin(settings: Mapping[str, Any], positions: np.ndarray) -> dict[str, Any] | None:
    """Return the settings of the skin of a network, for its file.

    Args:
        settings: configuration of the run with the skin that it is exported for, in plain containers.
        positions: of its sensors, (S, 3), m.

    Returns:
        The groups :data:`GROUPS`; None if the sensors are not those of the configuration, such as those of a
        recording.
    """
    check_groups({name: settings.get(name, {}) for name in ("body", "layout")})
    described = instantiate(settings["layout"]).sensors(instantiate(settings["body"])).positions
    # 1e-6 m: positions in the file are single precision.
    if described.shape != positions.shape or not np.allclose(described, positions, rtol=0, atol=1e-6):
        return None
    return {name: value for name, value in settings.items() if name in GROUPS}


def check_overrides(path: str, overrides: Sequence[str]) -> None:
    """Check that overrides leave the skin and the network of an exported file as they are.

    Args:
        path: of the file, for the message.
        overrides: of the command line.

    Raises:
        InputError: an override describes something that the file fixes.
    """
    for word in OverridesParser.create().parse_overrides(list(overrides)):
        if word.key_or_group.split(".")[0].split("/")[0] not in _FREE:
            raise InputError(
                f"{word.input_line} has no effect on {path}, a network for one skin: leave it out, or export "
                "the run again with it"
            )
