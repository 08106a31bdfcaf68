"""The Corpus of Social Touch: people's touches on a grid of 8 x 8 taxels."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from skin.body.base import AbstractBody
from skin.device._cost import CAPTURES, FULL, ROWS, SOURCE, format_error
from skin.device._cost_cache import cached_captures
from skin.device.base import AbstractDevice, Split
from skin.errors import InputError
from skin.labels import Task
from skin.layout._grid import grid
from skin.layout.base import AbstractLayout
from skin.recording import Touches
from skin.rng import Stream, generator
from skin.sensors import Sensors

GESTURES = (
    "grab",
    "hit",
    "massage",
    "pat",
    "pinch",
    "poke",
    "press",
    "rub",
    "scratch",
    "slap",
    "squeeze",
    "stroke",
    "tap",
    "tickle",
)
VARIANTS = ("gentle", "normal", "rough")
"""Names of the corpus's numbers, which count from 1."""

_REPORT = ("grab", "hit")
_EDGE = 8
_RATE = 135.0
_SHARES = {"test": 0.2, "validation": 0.1, "holdout": 0.1}


@dataclass(kw_only=True, eq=False)
class Cost(AbstractDevice):
    """Yields the captures of the user's ``CoST.csv``, split by subject: no subject is in two splits.

    7805 captures of 14 gestures by 31 subjects in three variants, on textile taxels around a mannequin's arm
    (Jung, Poel, Poppe, Heylen, J. Multimodal User Interfaces 11, 2017). The corpus is not part of this
    project; its licence is non-commercial. Its sensors are given, so ``body`` and ``layout`` are ignored.
    Its counts are uncalibrated, so the unit N of readings is nominal.

    Captures last 10 to 1747 frames; each is resampled to ``window`` frames over its whole length, whatever
    the fusion. The duration of a gesture is therefore lost, and ``rate`` is that of a capture of median
    length.

    Args:
        body: ignored.
        layout: ignored.
        path: ``CoST.csv``.
        gestures: ``report`` (grab and hit; report, section 3.2), ``all`` or names.
        variants: every variant of a gesture is a separate class; None: only if ``gestures`` is ``report``,
            which distinguishes "a grab and hit with various strengths".
        taxels: number of the 64 taxels, spread evenly, or the numbers of their channels from 1.
        taxel_seed: seed of their selection.
        window: frames per touch.
        full_scale: what the largest count is called, N.
        pitch: between neighbouring taxels, m. Not in the file; nothing but the features of
            ``learner=boosted_trees`` depends on more than proportions.
        split_seed: what the subjects of the splits are drawn from: about 60/10/10/20 per cent of them.
        test_subjects: number or numbers of the subjects of ``test``; None draws them.
        strict: require the complete corpus.

    Attributes:
        sensors: as ``taxels`` and ``pitch`` place them; channels 1 to 8 are the upper row, from the left.
        rate: frames per second in a capture of median length, Hz.
        subjects: split -> its subjects.

    Raises:
        InputError: invalid settings, no file, or a file that is not in the corpus's format.
    """

    body: AbstractBody | None = None
    layout: AbstractLayout | None = None
    path: str | None = None
    gestures: str | Sequence[str] = "report"
    variants: bool | None = None
    taxels: int | Sequence[int] = _EDGE**2
    taxel_seed: int = 0
    window: int = 30
    full_scale: float = 10.0
    pitch: float = 0.02
    split_seed: int = 0
    test_subjects: int | Sequence[int] | None = None
    strict: bool = True

    def __post_init__(self) -> None:
        self._check()
        names = _names(self.gestures)
        variants = self.gestures == "report" if self.variants is None else self.variants
        pairs = [f"{name}_{variant}" for name in names for variant in VARIANTS]
        self.task = Task(tuple(pairs) if variants else names, "exclusive")
        if len(self.task) < 2:
            raise InputError(f"device.gestures={self.gestures} is a single class: add device.variants=true")
        self._channels = _channels(self.taxels, self.taxel_seed)
        self.size = (_EDGE * self.pitch, _EDGE * self.pitch)
        places = grid(_EDGE, _EDGE)[self._channels] * self.size
        flat = np.column_stack([places, np.zeros(len(places))])
        self.sensors = Sensors(flat, (self.pitch, self.pitch))
        self._read(names)
        number = np.array([names.index(GESTURES[gesture - 1]) for gesture in self._captures.gesture])
        self._class = number * len(VARIANTS) + self._captures.variant - 1 if variants else number
        self.rate = float(_RATE * (self.window - 1) / (np.median(self._captures.frames) - 1))
        self.subjects = self._divide(np.unique(self._captures.subject))

    def _check(self) -> None:
        """Check the settings before a large file is read."""
        if self.path is None:
            raise InputError(
                f"device=cost needs the file CoST.csv, which is not shipped: download it from {SOURCE} and "
                "add device.path=FILE"
            )
        if type(self.window) is not int or self.window < 2:
            raise InputError(f"device.window must be a whole number of at least 2, got {self.window}")
        for name in ("full_scale", "pitch"):
            if not 0 < getattr(self, name) < np.inf:
                raise InputError(f"device.{name} must be above 0, got {getattr(self, name)}")

    def _read(self, names: tuple[str, ...]) -> None:
        path = Path(str(self.path)).expanduser()
        found = cached_captures(path, self.window)
        rows = int(found.frames.sum(dtype=np.int64))
        if self.strict and (rows, len(found)) != (ROWS, CAPTURES):
            raise format_error(
                path,
                f"it has {rows} rows in {len(found)} captures, the whole corpus has {ROWS} in {CAPTURES}",
                "add device.strict=false to use a part of it, or download it again",
            )
        wanted = np.isin(found.gesture, [1 + GESTURES.index(name) for name in names])
        if not wanted.any():
            raise InputError(
                f"{path} has no capture of {', '.join(names)}: choose others, device.gestures=all"
            )
        self._captures = found[wanted]

    def _divide(self, subjects: np.ndarray) -> dict[Split, list[int]]:
        """Return the subjects of each split; the order depends on ``split_seed`` alone."""
        order = generator(Stream.SPLIT, self.split_seed).permutation(subjects).tolist()
        taken = {name: max(1, round(share * len(order))) for name, share in _SHARES.items()}
        if self.test_subjects is not None:
            given = _numbers(self.test_subjects, "test_subjects")
            if unknown := [number for number in given if number not in order]:
                raise InputError(
                    f"device.test_subjects names {unknown}, {self.path} has the subjects {subjects.tolist()} "
                    "with these gestures"
                )
            order = given + [number for number in order if number not in given]
            taken["test"] = len(given)
        if sum(taken.values()) >= len(order):
            raise InputError(
                f"{self.path} has {len(order)} subjects with these gestures: {sum(taken.values())} for test, "
                "validation and holdout leave none to train on; give a larger file or fewer test_subjects"
            )
        edges = np.cumsum(list(taken.values()))
        test, validation, holdout, train = np.split(np.array(order), edges)
        parts = {"train": train, "validation": validation, "holdout": holdout, "test": test}
        return {name: sorted(part.tolist()) for name, part in parts.items()}  # type: ignore[misc]

    def touches(self, split: Split, epoch: int = 0) -> Touches:
        """Return the touches of a split's subjects; a file has no fresh ones."""
        chosen = np.isin(self._captures.subject, self.subjects[split])
        counts = torch.from_numpy(self._captures.counts[chosen][:, :, self._channels])
        readings = counts * (self.full_scale / FULL)
        labels = torch.nn.functional.one_hot(torch.from_numpy(self._class[chosen]).long(), len(self.task))
        positions = torch.from_numpy(self.sensors.positions).float()
        valid = torch.ones_like(readings, dtype=torch.bool)
        return Touches(readings, valid, positions, labels.float(), self.rate)


def _names(gestures: str | Sequence[str]) -> tuple[str, ...]:
    """Return the names of gestures, in the order given."""
    known = {"report": _REPORT, "all": GESTURES}
    names = known.get(gestures, (gestures,)) if isinstance(gestures, str) else tuple(gestures)
    if len(names) != len(set(names)) or not names or not set(names) <= set(GESTURES):
        raise InputError(
            f"device.gestures must be report, all or some of {', '.join(GESTURES)}, got {gestures}: as in "
            "device.gestures=[tap,press]"
        )
    return names


def _numbers(given: int | Sequence[int], name: str) -> list[int]:
    """Return one number or several as a list without repetition."""
    numbers = [given] if isinstance(given, int) else list(given)
    if not numbers or len(set(numbers)) != len(numbers) or any(type(one) is not int for one in numbers):
        raise InputError(f"device.{name} must be different whole numbers, got {given}: as in [1,8]")
    return numbers


def _channels(taxels: int | Sequence[int], seed: int) -> np.ndarray:
    """Return the indices of the taxels, (S,), from 0, in rising order.

    A number of taxels is selected by farthest-point sampling, with a random first one and random choice among
    equals.
    """
    count = _EDGE**2
    if isinstance(taxels, int):
        if not 1 <= taxels <= count or isinstance(taxels, bool):
            raise InputError(f"device.taxels must be 1 to {count} or a list of channels, got {taxels}")
        order = generator(Stream.POSITION, seed).permutation(count)
        places = grid(_EDGE, _EDGE)[order]
        chosen = [0]
        while len(chosen) < taxels:
            apart = np.linalg.norm(places[:, None] - places[chosen], axis=2).min(axis=1)
            chosen.append(int(apart.argmax()))
        return np.sort(order[chosen])
    numbers = np.array(_numbers(taxels, "taxels"))
    if numbers.min() < 1 or numbers.max() > count:
        raise InputError(f"device.taxels names channels 1 to {count}, got {list(taxels)}: as in [1,8,57,64]")
    return np.sort(numbers) - 1
