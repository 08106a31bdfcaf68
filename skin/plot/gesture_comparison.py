"""Gestures of a session beside their simulation (report, figures 11 and 12)."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
import torch

from skin.device.base import AbstractSimulated
from skin.errors import InputError
from skin.hardware.emulator.gestures import Gesture, emulated_gestures, gestures_with_labels
from skin.hardware.record.recorder import check_session
from skin.hardware.record.session import read_session
from skin.labels import TOUCH
from skin.recording import Touches
from skin.rng import Stream, generator
from skin.wire.segmentation import label_text

_IDLE = 30  # frames before a simulated gesture, which give its baseline


@dataclass(frozen=True)
class Pair:
    """One gesture, simulated and recorded.

    Attributes:
        number: of the gesture.
        labels: name -> 0 or 1.
        applied: force on the simulated skin, (T,), N.
        simulated: (T, S), N.
        recorded: (T, S), N; 0 where invalid.
        valid: (T, S), bool: which of the recorded ones mean something.
    """

    number: int
    labels: Mapping[str, int]
    applied: np.ndarray
    simulated: np.ndarray
    recorded: np.ndarray
    valid: np.ndarray

    @property
    def sensor(self) -> int:
        """The sensor that answers most in simulation."""
        return int(np.where(self.valid, self.simulated, -np.inf).max(axis=0).argmax())

    @property
    def peaks(self) -> tuple[float, float]:
        """Largest reading of any sensor, simulated and recorded, N."""
        return float(self.simulated[self.valid].max()), float(self.recorded[self.valid].max())

    @property
    def rmse(self) -> float:
        """Over all readings, N."""
        return float(np.sqrt(np.mean((self.simulated - self.recorded)[self.valid] ** 2)))

    @property
    def slope(self) -> float:
        """Recorded over simulated readings of ``sensor``, through 0."""
        on = self.valid[:, self.sensor]
        x, y = self.simulated[on, self.sensor], self.recorded[on, self.sensor]
        return float(x @ y / (x @ x))


@dataclass(frozen=True)
class Gestures:
    """A session's gestures.

    Attributes:
        pairs: one by one.
        same: the very same gestures are simulated, not only such of the same labels.
        positions: (S, 3), m.
        rate: of the model, Hz.
    """

    pairs: Sequence[Pair]
    same: bool
    positions: np.ndarray
    rate: float


def marked(path: str) -> bool:
    """Return whether a session marks gestures, as those of skin record do."""
    beside = Path(path).expanduser().with_name(Path(path).name + ".json")
    try:
        about = json.loads(beside.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(about, dict) and "window" in about


def read_gestures(device: AbstractSimulated, path: str, seed: int) -> Gestures:
    """Return the gestures of a session beside their simulation.

    Announced gestures are those of an emulator: the same ones are simulated, on the device that is given.
    What a person did is not known but for its labels: gestures of the same labels are simulated.

    Args:
        device: with its imperfections, or its calibration.
        path: x.csv of skin record.
        seed: of the emulator, or of the gestures of the same labels.

    Raises:
        InputError: no session, no labels in it, another layout, window or rate, or another emulator's.
    """
    stored = read_session(Path(path).expanduser())
    now = {"positions": device.sensors.positions.tolist(), "window": device.window, "rate": device.model_rate}
    check_session(Path(path), stored.about, now)
    takes = [entry for _, entry in sorted(stored.gestures.items()) if entry[0].labels is not None]
    if not takes:
        raise InputError(f"{path} has no gesture with labels: record it with device.labels=prompted")
    same = stored.about.get("labels") == "announced"
    numbers, labels = [take.number for take, _ in takes], [dict(take.labels or {}) for take, _ in takes]
    if same:
        played = list(islice(emulated_gestures(device, seed), max(numbers) + 1))
        drawn = [played[number] for number in numbers]
        _are(drawn, numbers, labels)
    else:
        drawn = gestures_with_labels(
            device, np.array([[one[name] for name in TOUCH.names] for one in labels]), seed
        )
    felt = _felt(device, drawn)
    recorded = [
        conversion(take.resampled.values, take.resampled.valid)
        for take, conversion in takes
        if take.resampled
    ]
    working = ~device.constants.dead.numpy()
    pairs = [
        Pair(number, known, one.applied, simulated, values.astype(float), valid & working)
        for number, known, one, simulated, (values, valid) in zip(
            numbers, labels, drawn, felt, recorded, strict=True
        )
    ]
    seen = [pair for pair in pairs if pair.valid.any(axis=0).any() and pair.simulated.any()]
    return Gestures(seen, same, device.sensors.positions, device.model_rate)


def _are(drawn: Sequence[Gesture], numbers: Sequence[int], labels: Sequence[Mapping[str, int]]) -> None:
    for number, one, said in zip(numbers, drawn, labels, strict=True):
        if any(said.get(name, on) != on for name, on in one.labels.items()):
            raise InputError(
                f"gesture {number} of the session is {label_text(said)}, the simulated one is "
                f"{label_text(one.labels)}: give the emulator's settings and its emulate.seed as compare.seed"
            )


def _felt(device: AbstractSimulated, drawn: Sequence[Gesture]) -> np.ndarray:
    """Return what a device says of gestures above what it says before them, (B, T, S), N."""
    true = torch.from_numpy(np.stack([one.force for one in drawn])).float()
    true = torch.nn.functional.pad(true, (0, 0, _IDLE, 0))
    said = device.imperfection.raw(
        true, device.constants, generator(Stream.NOISE, device.seed, Stream.TEST, 6)
    )
    said = said.double()
    return (said[:, _IDLE:] - said[:, :_IDLE].median(dim=1, keepdim=True).values).numpy()


def gesture_touches(found: Gestures) -> tuple[Touches, Touches]:
    """Return both sides as a model sees them, simulated and recorded."""
    valid = torch.from_numpy(np.stack([pair.valid for pair in found.pairs]))
    places = torch.from_numpy(found.positions).float()
    sides = []
    for name in ("simulated", "recorded"):
        values = torch.from_numpy(np.stack([getattr(pair, name) for pair in found.pairs])).float()
        sides.append(Touches(values * valid, valid, places, None, found.rate))
    return sides[0], sides[1]
