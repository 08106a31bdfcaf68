"""The Corpus of Social Touch: people's touches on a grid of 8 x 8 taxels."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from annotated_types import Ge, Le
from pydantic import PositiveFloat

from skin.body.base import AbstractBody, Sensors
from skin.body.layout import AbstractLayout, tile_centres
from skin.core.rng import Stream, generator
from skin.core.settings import checked
from skin.device.base import AbstractDevice, Split
from skin.device.conversion import convert_files
from skin.device.formats import ClassRule, read_format
from skin.device.touches import Recording, Touches
from skin.errors import InputError

SOURCE = "https://doi.org/10.4121/uuid:5ef62345-3b3e-479c-8e1d-c922748c9b29"
CAPTURES = 7805
"""Number of captures of the published file."""
FULL = 1023
"""The largest count: the corpus has 10 bits."""

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
_Channel = Annotated[int, Ge(1), Le(_EDGE**2)]
_SHARES = {"test": 0.2, "validation": 0.1, "holdout": 0.1}


@checked("device")
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
    taxels: _Channel | Sequence[_Channel] = _EDGE**2
    taxel_seed: int = 0
    window: Annotated[int, Ge(2)] = 30
    full_scale: PositiveFloat = 10.0
    pitch: PositiveFloat = 0.02
    split_seed: int = 0
    test_subjects: int | Sequence[int] | None = None
    strict: bool = True

    def __post_init__(self) -> None:
        if self.path is None:
            raise InputError(
                f"device=cost needs the file CoST.csv, which is not shipped: download it from {SOURCE} and "
                "add device.path=FILE"
            )
        names = _names(self.gestures)
        variants = self.gestures == "report" if self.variants is None else self.variants
        if not variants and len(names) < 2:
            raise InputError(f"device.gestures={self.gestures} is a single class: add device.variants=true")
        self._channels = _channels(self.taxels, self.taxel_seed)
        self.size = (_EDGE * self.pitch, _EDGE * self.pitch)
        places = tile_centres(_EDGE, _EDGE)[self._channels] * self.size
        flat = np.column_stack([places, np.zeros(len(places))])
        self.sensors = Sensors(flat, (self.pitch, self.pitch))
        recording = self._read(Path(self.path).expanduser(), names, variants)
        self.task, self.rate = recording.task, recording.touches.rate
        chosen = ~recording.touches.known_labels.isnan().any(dim=1)
        self._touches = replace(recording[chosen].touches, positions=torch.from_numpy(flat).float())
        subjects = np.array([int(name) for name in recording.metadata["groups"]["subject"]])
        self._subject = subjects[recording.parameters["group_subject"].long().numpy()][chosen.numpy()]
        self.subjects = self._divide(np.unique(self._subject))
        counts = ", ".join(f"{len(part)} {name}" for name, part in self.subjects.items())
        self.split, self.configured = f"by subject: {counts}", False

    def _read(self, path: Path, names: tuple[str, ...], variants: bool) -> Recording:
        """Return the captures of a file; those of other gestures have unknown labels."""
        stored = read_format("cost")
        classes: dict[str | int, str] = {str(1 + GESTURES.index(name)): name for name in names}
        rule = ClassRule("gesture", classes)
        if variants:
            pairs = product(classes.items(), enumerate(VARIANTS, start=1))
            rule = ClassRule(
                ("gesture", "variant"),
                {f"{number} {place}": f"{name}_{variant}" for (number, name), (place, variant) in pairs},
            )
        mapping = replace(
            stored,
            channels=replace(
                stored.channels,
                columns=[f"ch{1 + channel}" for channel in self._channels],
                scale=self.full_scale / FULL,
            ),
            segments=replace(stored.segments, frames=self.window),
            classes=rule,
        )
        try:
            recording = convert_files(mapping, path)
        except InputError as error:
            raise InputError(f"{error}; CoST.csv is at {SOURCE}") from error
        if self.strict and len(recording) != CAPTURES:
            raise InputError(
                f"{path} has {len(recording)} captures, CoST.csv of {SOURCE} has {CAPTURES}: add "
                "device.strict=false to use a part of it, or download it again"
            )
        return recording

    def _divide(self, subjects: np.ndarray) -> dict[Split, list[int]]:
        """Return the subjects of each split; the order depends on ``split_seed`` alone."""
        order = generator(Stream.SPLIT, self.split_seed).permutation(subjects).tolist()
        taken = {name: max(1, round(share * len(order))) for name, share in _SHARES.items()}
        if self.test_subjects is not None:
            numbers = _numbers(self.test_subjects, "test_subjects")
            if unknown := [number for number in numbers if number not in order]:
                raise InputError(
                    f"device.test_subjects names {unknown}, {self.path} has the subjects {subjects.tolist()} "
                    "with these gestures"
                )
            order = numbers + [number for number in order if number not in numbers]
            taken["test"] = len(numbers)
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
        return self._touches[torch.from_numpy(np.isin(self._subject, self.subjects[split]))]


def _names(gestures: str | Sequence[str]) -> tuple[str, ...]:
    """Return the names of gestures, in the order given."""
    choices = {"report": _REPORT, "all": GESTURES}
    names = choices.get(gestures, (gestures,)) if isinstance(gestures, str) else tuple(gestures)
    if len(names) != len(set(names)) or not names or not set(names) <= set(GESTURES):
        raise InputError(
            f"device.gestures must be report, all or some of {', '.join(GESTURES)}, got {gestures}: as in "
            "device.gestures=[tap,press]"
        )
    return names


def _numbers(value: int | Sequence[int], name: str) -> list[int]:
    """Return one number or several as a list without repetition."""
    numbers = [value] if isinstance(value, int) else list(value)
    if not numbers or len(set(numbers)) != len(numbers):
        raise InputError(f"device.{name} must be different whole numbers, got {value}: as in [1,8]")
    return numbers


def _channels(taxels: int | Sequence[int], seed: int) -> np.ndarray:
    """Return the indices of the taxels, (S,), from 0, in rising order.

    A number of taxels is selected by farthest-point sampling, with a random first one and random choice among
    equals.
    """
    if not isinstance(taxels, int):
        return np.sort(_numbers(taxels, "taxels")) - 1
    order = generator(Stream.POSITION, seed).permutation(_EDGE**2)
    places = tile_centres(_EDGE, _EDGE)[order]
    chosen = [0]
    while len(chosen) < taxels:
        apart = np.linalg.norm(places[:, None] - places[chosen], axis=2).min(axis=1)
        chosen.append(int(apart.argmax()))
    return np.sort(order[chosen])
