"""Check the scale of a skin with a second known load, keep the result, and find it again at each start.

Mechanics are homogeneous: no session, and no test with simulated presses, can show a wrong scale.

torch is not imported.
"""

import hashlib
import json
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np
import platformdirs

from skin.core.files import json_line, json_text, whole
from skin.core.safe_loading import TEXT, parse_json, read_file
from skin.core.settings import configured
from skin.device.resampling import Frame, StreamClock
from skin.errors import InputError
from skin.hardware.wire.channels import AGREES, UnitConversion
from skin.hardware.wire.protocol import EMULATED, Header
from skin.hardware.wire.skin import SerialSource, Source

# What was checked, and what is in use.


@dataclass(frozen=True, kw_only=True)
class Setup:
    """What a reading in N depends on.

    Attributes:
        device: id in the header of the device; without one, its port and adapter.
        layout: hash of size and positions of the sensors.
        materials: hash of the layers of the body; empty: unknown, as for an exported model.
        channels: the device's channel of every sensor; empty: the same order.
        scale: N per unit of every sensor, negative where values fall with force.
        curves: of sensors that are not linear.
    """

    device: str
    layout: str
    materials: str
    channels: list[int]
    scale: list[float]
    curves: dict[str, Any] | None = None

    def differences(self, other: "Setup") -> tuple[str, ...]:
        """Return the attributes in which another setup differs; unknown materials are equal to any."""
        return tuple(
            entry.name
            for entry in fields(Setup)
            if json_text(getattr(self, entry.name)) != json_text(getattr(other, entry.name))
            and not (entry.name == "materials" and "" in (self.materials, other.materials))
        )


@dataclass(frozen=True, kw_only=True)
class Check(Setup):
    """A setup whose scale agreed with a second reference.

    Attributes:
        date: of the check, ISO 8601.
        ratios: sensor, from 0 -> measured over predicted reading.
        rest: mean value of every untouched sensor at the check, (S,), in the device's unit.
    """

    date: str
    ratios: dict[str, float]
    rest: list[float]


@dataclass(frozen=True)
class Verification:
    """Whether a second reference confirms the conversion to N.

    Attributes:
        state: ``exempt`` (no device that anybody touches), ``checked`` (by :class:`Check`), ``declared`` (by
            ``device.sensitivity``) or ``unverified``.
        check: of this device, or else the latest of this layout; None: there is none.
        differences: what has changed since, as of :meth:`Setup.differences`.
    """

    state: Literal["exempt", "checked", "declared", "unverified"]
    check: Check | None = None
    differences: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """What to tell the user; empty if nothing."""
        date = self.check.date[:10] if self.check else ""
        changed = f"the check of {date} was made with another {', '.join(self.differences)}"
        unverified = changed if self.check else "no second reference has confirmed the scale"
        return {
            "exempt": "",
            "checked": f"scale checked on {date}",
            "declared": "scale agrees with device.sensitivity",
            "unverified": f"unverified: {unverified}; run skin check, or give device.sensitivity",
        }[self.state]


def describe_setup(
    port: SerialSource,
    header: Header | None,
    conversion: UnitConversion,
    positions: np.ndarray,
    size: Sequence[float],
) -> Setup:
    """Return what the readings of a skin at a port depend on.

    Args:
        port: of the skin.
        header: of the device.
        conversion: of its values to N, in use.
        positions: of the sensors, (S, 2 or 3), m.
        size: of the body, m.
    """
    settings = port.settings
    layers = [(layer.material.young, layer.material.poisson, layer.thickness) for layer in port.layers]
    return Setup(
        device=(header and header.id) or f"{settings.port} {settings.adapter}",
        # To the micrometre: an exported model has single precision.
        layout=_hashed([np.asarray(values, float).round(6).tolist() for values in (size, positions[:, :2])]),
        materials=_hashed(layers) if layers else "",
        channels=list(port.channels),
        scale=conversion.scale.tolist(),
        curves=None if conversion.curves is None else conversion.curves.to_json(),
    )


def _hashed(content: Any) -> str:
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()


def _folder() -> Path:
    """Return the folder of checks: below the variable SKIN_DATA, else below the user's data."""
    data = os.environ.get("SKIN_DATA") or platformdirs.user_data_dir("skin")
    return Path(data).expanduser() / "checks"


def store_check(check: Check) -> Path:
    """Write a check in place of the previous one of this device; return its path.

    Raises:
        InputError: the file cannot be written.
    """
    path = _folder() / f"{_hashed(check.device)[:16]}.json"
    with whole(path, "SKIN_DATA=FOLDER") as partial:
        partial.write_text(json_line(asdict(check), indent=2) + "\n", encoding="utf-8")
    return path


def find_check(setup: Setup) -> Check | None:
    """Return the check of a device, or else the latest of its layout; None without one that can be read."""
    checks = []
    for path in _folder().glob("*.json"):
        with suppress(InputError, OSError, ValueError, TypeError):  # a damaged check confirms nothing
            checks.append(configured(Check, parse_json(read_file(path, TEXT).decode()), path.name))
    alike = [check for check in checks if setup.device == check.device or setup.layout == check.layout]
    return max(alike, key=lambda check: (setup.device == check.device, check.date), default=None)


def verify_source(
    source: Source, conversion: UnitConversion, positions: np.ndarray, size: Sequence[float]
) -> Verification:
    """Return whether a second reference confirms the conversion of an open source, in use.

    Args:
        source: open.
        conversion: of its values to N.
        positions: of the sensors, (S, 2 or 3), m.
        size: of the body, m.
    """
    port, header = source.port, source.skin.header
    if port is None or (header is not None and (header.id or "").startswith(EMULATED)):
        return Verification("exempt")
    setup = describe_setup(port, header, conversion, positions, size)
    check = find_check(setup)
    differences = () if check is None else setup.differences(check)
    if check is not None and not differences:
        return Verification("checked", check)
    return Verification("declared" if port.settings.sensitivity else "unverified", check, differences)


# Loads that are put on the skin, one after the other.

_BLOCK = 0.2  # s, whose mean is one value
_REST = 5  # blocks that show the rest
_LOADED = 6.0  # standard deviations of a block, as in placements.py
_STEPS = 2.0  # counts, likewise
_SETTLE = 3  # blocks in which a load settles, or the skin after it
_ENDS = 10  # first and last blocks of a load that are compared: 2 s
_LIFTED = 0.4  # of the reading two blocks before: no baseline follows as fast as a load is lifted
_PATIENCE = 600  # blocks in which a load must appear, or be lifted
_FOLLOWS = (
    "the device seems to follow its own baseline, so a long press disappears: switch that off in its firmware"
)
_FACTORS = "9.8 kg and N, 4.45 lbf, 2.2 lb, 1000 g, 2.8 a calibration with simulator=fem, below 0 polarity"


def average_blocks(frames: Iterable[Frame], conversion: UnitConversion) -> Iterator[np.ndarray]:
    """Yield the mean readings (S,), N, of each 0.2 s of a stream."""
    clock, rows, begin = StreamClock(), list[np.ndarray](), None
    for frame in frames:
        now = clock(frame)
        begin = now if begin is None else begin
        if now - begin >= _BLOCK:
            yield np.mean(rows, axis=0)
            rows, begin = [], now
        rows.append(conversion.newtons(frame.values))


def measure_load(
    blocks: Iterator[np.ndarray],
    rest: Sequence[np.ndarray],
    limits: np.ndarray,
    count: int,
    say: Callable[[str], None],
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Wait for a load and until it is lifted; return its readings (S,), N, and blocks of the rest behind it.

    Args:
        blocks: of :func:`average_blocks`.
        rest: blocks before.
        limits: change of a block that is neither noise nor a count, (S,), N.
        count: blocks for which the load must lie.
        say: called with each message for the user.

    Raises:
        InputError: no load appears, or its reading decays.
    """
    recent = deque(rest, maxlen=_REST + 2)
    for _, values in zip(range(_PATIENCE), blocks, strict=False):
        recent.append(values)
        level = np.median(np.array(recent)[:-2], axis=0)
        if (np.abs(np.array(recent)[-2:] - level) > limits).all(axis=0).any():
            break
    else:
        raise InputError(f"no load within {_PATIENCE * _BLOCK:.0f} s: give a heavier one, as in weight=1")
    say(f"hold it for {count * _BLOCK:.0f} s")
    held = [next(blocks) - level for _ in range(_SETTLE)]
    sensor = int(np.abs(held[-1]).argmax())
    for _ in range(count - _SETTLE):
        held.append(next(blocks) - level)
        now, before = (held[place][sensor] for place in (-1, -3))
        if abs(now) < _LIFTED * abs(before):
            say("it was lifted too early: put it down again")
            return measure_load(blocks, [next(blocks) for _ in range(_REST)], limits, count, say)
    steady = np.array(held[_SETTLE:])
    first, last = (np.median(part[:, sensor]) for part in (steady[:_ENDS], steady[-_ENDS:]))
    if last / first < 1 - AGREES:
        raise InputError(
            f"sensor {sensor} fell from {first:.3g} to {last:.3g} N in a constant load: {_FOLLOWS}"
        )
    say("ok, lift it")
    for _, values in zip(range(_PATIENCE), blocks, strict=False):
        if abs((values - level)[sensor]) < abs(last) / 2:
            break
    after = [next(blocks) for _ in range(_SETTLE + _REST)][_SETTLE:]
    change = np.median(after, axis=0)[sensor] - level[sensor]
    if change / last < -AGREES:
        raise InputError(
            f"sensor {sensor} rests {abs(change):.3g} N lower behind a load of {abs(last):.3g} N: {_FOLLOWS}"
        )
    return np.median(steady, axis=0), after


def measure_ratios(
    frames: Iterable[Frame],
    first: Sequence[Frame],
    conversion: UnitConversion,
    expected: np.ndarray,
    seconds: float,
    say: Callable[[str], None],
) -> dict[str, float]:
    """Return measured over predicted reading of three loaded sensors, or of all if there are fewer.

    Args:
        frames: of the skin, from now on.
        first: frames of the untouched skin before.
        conversion: of values to N.
        expected: readings (S, S), N, under the load on each sensor.
        seconds: for which each load must lie.
        say: called with each message for the user.

    Raises:
        InputError: no load appears, or the device follows its own baseline.
    """
    blocks, rest = average_blocks(frames, conversion), list(average_blocks(first, conversion))
    whole = all((frame.values % 1 == 0).all() for frame in first)
    limits = np.maximum(_LOADED * np.std(rest, axis=0), _STEPS * whole * np.abs(conversion.scale))
    shapes = expected / np.linalg.norm(expected, axis=1, keepdims=True)
    ratios, enough = dict[str, float](), min(3, len(expected))
    while len(ratios) < enough:
        measured, rest = measure_load(blocks, rest[-_REST:], limits, round(seconds / _BLOCK), say)
        # The pattern tells the sensor, whatever the scale and its sign.
        sensor = int(np.abs(shapes @ measured).argmax())
        prediction = expected[sensor, sensor]
        ratios[str(sensor)] = float(measured[sensor] / prediction)
        say(
            f"sensor {sensor}: {measured[sensor]:.3g} N, predicted {prediction:.3g} N; {len(ratios)} of "
            f"{enough} sensors" + ", next one" * (len(ratios) < enough)
        )
    return ratios


def require_agreement(ratios: dict[str, float]) -> None:
    """Raise InputError unless measured over predicted readings are 1 within :data:`AGREES`."""
    values = np.array(list(ratios.values()))
    if (np.abs(values - 1) <= AGREES).all():
        return
    text = ", ".join(f"{ratio:.3g} (sensor {sensor})" for sensor, ratio in ratios.items())
    raise InputError(
        f"the readings are those of the load times {text}, not within {AGREES:.0%} of 1: correct "
        f"device.scale or calibrate again; nothing was stored (usual factors or their inverse: {_FACTORS})"
    )
