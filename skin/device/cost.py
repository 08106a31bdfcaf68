"""The Corpus of Social Touch: people's touches on a grid of 8 x 8 taxels."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

import numpy as np
import pyarrow as pa
import pyarrow.csv
import torch
from annotated_types import Ge, Le
from pydantic import PositiveFloat

from skin.body.base import AbstractBody, Sensors
from skin.body.layout import AbstractLayout, tile_centres
from skin.core.rng import Stream, generator
from skin.core.settings import checked
from skin.device.base import AbstractDevice, Split
from skin.device.touches import Touches
from skin.errors import InputError
from skin.touch.labels import Task

# Captures of CoST.csv: read in bounded memory, checked, resampled.

SOURCE = "https://doi.org/10.4121/uuid:5ef62345-3b3e-479c-8e1d-c922748c9b29"
ROWS, CAPTURES = 1_496_855, 7805
"""Number of rows and captures of the published file."""
FULL = 1023
"""The largest count: the corpus has 10 bits."""
CHANNELS = 64
COLUMNS = ("subject", "variant", "gesture", "frame", *(f"ch{1 + number}" for number in range(CHANNELS)))

_HEAD, _FRAME = 4, 3
_BLOCK = 1 << 22
_LARGEST = {"variant": 3, "gesture": 14}


@dataclass(frozen=True)
class Captures:
    """N captures, resampled to T frames each.

    Attributes:
        counts: (N, T, 64), float32, 0 to ``FULL``.
        subject: (N,), int32, as in the file.
        variant: (N,), int32: 1 gentle, 2 normal, 3 rough.
        gesture: (N,), int32, 1 to 14.
        frames: (N,), int32: number of frames of each in the file.
    """

    counts: np.ndarray
    subject: np.ndarray
    variant: np.ndarray
    gesture: np.ndarray
    frames: np.ndarray

    def __len__(self) -> int:
        return len(self.counts)

    def __getitem__(self, index: np.ndarray) -> "Captures":
        """Return the captures that ``index`` selects."""
        return Captures(**{name: values[index] for name, values in vars(self).items()})


def format_error(path: str | Path, wrong: str, fix: str = "download it again") -> InputError:
    """Return the error for a file that is not as published, with the address of the corpus."""
    return InputError(f"{path} is not CoST.csv as published: {wrong}; {fix} from {SOURCE}")


def read_captures(path: Path, window: int) -> Captures:
    """Read the captures of a file block by block, in bounded memory.

    A capture begins where ``frame`` is 1. It is resampled by linear interpolation in time over its whole
    length, so its duration is kept only in ``frames``.

    Raises:
        InputError: the file is not in the corpus's format; the message has the number of the line.
    """
    _check_header(path)
    parts: list[Captures] = []
    begun = np.empty((0, len(COLUMNS)), np.int32)
    line = 2
    for block in _blocks(path):
        rows = np.concatenate([begun, block])
        _check(path, rows, len(begun), line)
        line += len(block)
        # The last capture may continue in the next block.
        last = np.flatnonzero(rows[:, _FRAME] == 1)[-1]
        parts.append(_resample(path, rows[:last], window, line - len(rows)))
        begun = rows[last:]
    if not len(begun):
        raise format_error(path, "it has no rows")
    parts.append(_resample(path, begun, window, line - len(begun)))
    names = [field.name for field in fields(Captures)]
    return Captures(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def _blocks(path: Path) -> Iterator[np.ndarray]:
    """Yield the rows of a file, (R, 68), int32, block by block."""
    settings = {
        "read_options": pa.csv.ReadOptions(
            column_names=COLUMNS, skip_rows=1, block_size=_BLOCK, use_threads=False
        ),
        "convert_options": pa.csv.ConvertOptions(
            column_types=dict.fromkeys(COLUMNS, pa.int32()), null_values=[]
        ),
    }
    try:
        with path.open("rb") as file, pa.csv.open_csv(file, **settings) as batches:
            for batch in batches:
                if batch.num_rows:
                    yield np.column_stack([column.to_numpy() for column in batch.columns])
    except pa.ArrowException as error:
        raise format_error(path, _explain_error(error)) from error


def _explain_error(error: Exception) -> str:
    """Return what is wrong with a line that pyarrow cannot parse."""
    text = " ".join(str(error).split())
    if match := re.search(r"column #(\d+): Row #(\d+): .*invalid value ('.*')", text):
        column, line, value = match.groups()
        return f"line {line} has {value} for {COLUMNS[int(column)]}, not a whole number"
    if match := re.search(r"Row #(\d+): Expected \d+ columns, got (\d+)", text):
        return f"line {match[1]} has {match[2]} columns, not {len(COLUMNS)}, as if cut off"
    return text


def _check_header(path: Path) -> None:
    try:
        with path.open("rb") as file:
            text = file.readline(1 << 16).decode("utf-8-sig", errors="replace")
    except OSError as error:
        raise InputError(
            f"cannot read {path}: {error.strerror}: download CoST.csv from {SOURCE} and add device.path=FILE"
        ) from error
    # The published names have a leading blank.
    names = [name.strip() for name in text.split(",")]
    if len(names) != len(COLUMNS):
        wrong = f"its first line has {len(names)} columns, not the {len(COLUMNS)}"
        raise format_error(path, f"{wrong} subject, variant, gesture, frame, ch1 ... ch64")
    for number, (name, needed) in enumerate(zip(names, COLUMNS, strict=True), start=1):
        if name != needed:
            raise format_error(path, f"column {number} is called {name!r} instead of {needed!r}")
    if not text.endswith("\n"):
        raise format_error(path, "it has no rows")


def _check(path: Path, rows: np.ndarray, checked: int, line: int) -> None:
    """Refuse values out of range, and frames that do not run 1, 2, 3, ... within one capture.

    Args:
        path: for the message.
        rows: (R, 68).
        checked: number of rows that have been checked before.
        line: number of the first unchecked row's line.
    """
    new = rows[checked:]
    for name, largest in _LARGEST.items():
        values = new[:, COLUMNS.index(name)]
        _refuse_first(path, (values < 1) | (values > largest), line, f"{name} is not 1 to {largest}")
    counts = new[:, _HEAD:]
    wild = (counts.min(axis=1) < 0) | (counts.max(axis=1) > FULL)
    _refuse_first(path, wild, line, f"a channel is not within 0 to {FULL}")
    before = rows[checked - 1 : -1] if checked else np.concatenate([np.zeros_like(rows[:1]), rows[:-1]])
    same = (new[:, :_FRAME] == before[:, :_FRAME]).all(axis=1)
    follows = same & (before[:, _FRAME] > 0) & (new[:, _FRAME] == before[:, _FRAME] + 1)
    broken = ~follows & (new[:, _FRAME] != 1)
    _refuse_first(path, broken, line, "frame neither is 1 nor follows that of the line before")


def _refuse_first(path: Path, bad: np.ndarray, line: int, wrong: str) -> None:
    if bad.any():
        raise format_error(path, f"in line {line + int(bad.argmax())} {wrong}")


def _resample(path: Path, rows: np.ndarray, window: int, line: int) -> Captures:
    """Return whole captures from their rows (R, 68), the first of which stands in ``line``."""
    starts = np.flatnonzero(rows[:, _FRAME] == 1)
    lengths = np.diff(starts, append=len(rows))
    if (lengths < 2).any():
        at = line + int(starts[(lengths < 2).argmax()])
        raise format_error(path, f"the capture in line {at} has one frame, at least 2 make a movement")
    times = np.linspace(0, 1, window) * (lengths[:, None] - 1)
    before = np.minimum(times.astype(int), lengths[:, None] - 2)
    share = (times - before)[..., None].astype(np.float32)
    frame = starts[:, None] + before
    counts = rows[:, _HEAD:].astype(np.float32)
    smooth = counts[frame] * (1 - share) + counts[frame + 1] * share
    subject, variant, gesture = rows[starts, :_FRAME].T
    return Captures(smooth, subject, variant, gesture, lengths.astype(np.int32))


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
_RATE = 135.0
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
        pairs = [f"{name}_{variant}" for name in names for variant in VARIANTS]
        self.task = Task(tuple(pairs) if variants else names, "exclusive")
        if len(self.task) < 2:
            raise InputError(f"device.gestures={self.gestures} is a single class: add device.variants=true")
        self._channels = _channels(self.taxels, self.taxel_seed)
        self.size = (_EDGE * self.pitch, _EDGE * self.pitch)
        places = tile_centres(_EDGE, _EDGE)[self._channels] * self.size
        flat = np.column_stack([places, np.zeros(len(places))])
        self.sensors = Sensors(flat, (self.pitch, self.pitch))
        self._read(Path(self.path).expanduser(), names)
        number = np.array([names.index(GESTURES[gesture - 1]) for gesture in self._captures.gesture])
        self._class = number * len(VARIANTS) + self._captures.variant - 1 if variants else number
        self.rate = float(_RATE * (self.window - 1) / (np.median(self._captures.frames) - 1))
        self.subjects = self._divide(np.unique(self._captures.subject))

    def _read(self, path: Path, names: tuple[str, ...]) -> None:
        captures = read_captures(path, self.window)
        rows = int(captures.frames.sum(dtype=np.int64))
        if self.strict and (rows, len(captures)) != (ROWS, CAPTURES):
            raise format_error(
                path,
                f"it has {rows} rows in {len(captures)} captures, the whole corpus has {ROWS} in {CAPTURES}",
                "add device.strict=false to use a part of it, or download it again",
            )
        chosen = np.isin(captures.gesture, [1 + GESTURES.index(name) for name in names])
        if not chosen.any():
            raise InputError(
                f"{path} has no capture of {', '.join(names)}: choose others, device.gestures=all"
            )
        self._captures = captures[chosen]

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
        chosen = np.isin(self._captures.subject, self.subjects[split])
        counts = torch.from_numpy(self._captures.counts[chosen][:, :, self._channels])
        readings = counts * (self.full_scale / FULL)
        labels = torch.nn.functional.one_hot(torch.from_numpy(self._class[chosen]).long(), len(self.task))
        positions = torch.from_numpy(self.sensors.positions).float()
        valid = torch.ones_like(readings, dtype=torch.bool)
        return Touches(readings, valid, positions, labels.float(), self.rate)


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
