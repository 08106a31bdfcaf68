"""Keep the check of a skin's scale by a second known load, and find it again at each start.

Mechanics are homogeneous: no session, and no test with simulated presses, can show a wrong scale.

torch is not imported.
"""

import hashlib
import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import platformdirs

from skin.core.files import json_line, json_text, whole
from skin.core.safe_loading import TEXT, parse_json, read_file
from skin.core.settings import configured
from skin.errors import InputError
from skin.wire.channels import AGREES, UnitConversion
from skin.wire.protocol import EMULATED, Header
from skin.wire.skin import SerialSource, Source


@dataclass(frozen=True)
class Check:
    """A comparison of a skin with a second known load.

    Attributes:
        setup: what its readings depended on, of :func:`describe_setup`.
        date: of the check, ISO 8601.
        ratios: sensor, from 0 -> measured over predicted reading.
        rest: mean value of every untouched sensor at the check, (S,), in the device's unit.
    """

    setup: dict[str, Any]
    date: str
    ratios: dict[str, float]
    rest: list[float]


@dataclass(frozen=True)
class Verification:
    """Whether a second reference confirms the conversion to N.

    Attributes:
        state: ``exempt`` (no device that anybody touches), ``checked`` (by a second load), ``declared`` (by
            ``device.sensitivity``) or ``unverified``.
        text: message for the user, or empty.
        check: that confirms it; None: none does.
    """

    state: Literal["exempt", "checked", "declared", "unverified"]
    text: str = ""
    check: Check | None = None


def describe_setup(
    port: SerialSource,
    header: Header | None,
    conversion: UnitConversion,
    positions: np.ndarray,
    size: Sequence[float],
) -> dict[str, Any]:
    """Return what the readings of a skin at a port depend on, in plain containers by its name.

    Args:
        port: of the skin.
        header: of the device; without an id in it, port and adapter stand for the device.
        conversion: of its values to N, in use.
        positions: of the sensors, (S, 2 or 3), m.
        size: of the body, m.
    """
    layers = [[layer.material.young, layer.material.poisson, layer.thickness] for layer in port.layers]
    return {
        "device": (header and header.id) or f"{port.settings.port} {port.settings.adapter}",
        # To the micrometre: an exported model has single precision.
        "layout": [np.asarray(values, float).round(6).tolist() for values in (size, positions[:, :2])],
        "channels": list(port.channels),
        "scale": conversion.scale.tolist(),
        "curves": None if conversion.curves is None else conversion.curves.to_json(),
        **({"materials": layers} if layers else {}),  # an exported model does not know them
    }


def _path(setup: dict[str, Any]) -> Path:
    """Return the file of the check of a device: below the variable SKIN_DATA, else below the user's data."""
    return (
        Path(os.environ.get("SKIN_DATA") or platformdirs.user_data_dir("skin")).expanduser()
        / "checks"
        / f"{hashlib.sha256(setup['device'].encode()).hexdigest()[:16]}.json"
    )


def store_check(check: Check) -> Path:
    """Write a check in place of the previous one of this device; return its path.

    Raises:
        InputError: measured over predicted readings are not 1 within :data:`AGREES`, or the file cannot be
            written.
    """
    if not all(abs(ratio - 1) <= AGREES for ratio in check.ratios.values()):
        raise InputError(
            "the readings are those of the load times "
            + ", ".join(f"{ratio:.3g} (sensor {sensor})" for sensor, ratio in check.ratios.items())
            + f", not within {AGREES:.0%} of 1: correct "
            f"device.scale or calibrate again; nothing was stored (usual factors or their inverse: 9.8 kg "
            "and N, 4.45 lbf, 2.2 lb, 1000 g, 2.8 a calibration with simulator=fem, below 0 polarity)"
        )
    with whole(_path(check.setup), "SKIN_DATA=FOLDER") as partial:
        partial.write_text(json_line(asdict(check)) + "\n", encoding="utf-8")
    return _path(check.setup)


def find_check(setup: dict[str, Any]) -> Check | None:
    """Return the check of a device; None without one that can be read."""
    with suppress(InputError, OSError, ValueError, TypeError):  # a damaged check confirms nothing
        return configured(Check, parse_json(read_file(_path(setup), TEXT).decode()), "check")
    return None


def verify_source(
    source: Source, conversion: UnitConversion, positions: np.ndarray, size: Sequence[float]
) -> Verification:
    """Return whether a second reference confirms the conversion of an open source, in use.

    Args:
        source: open.
        conversion: of its values to N.
        positions: of the sensors, (S, 2 or 3), m.
        size: of the body, m.

    Raises:
        InputError: the scale contradicts the check of this skin.
    """
    port, header = source.port, source.skin.header
    if port is None or (header is not None and (header.id or "").startswith(EMULATED)):
        return Verification("exempt")
    setup = describe_setup(port, header, conversion, positions, size)
    reason = "no second reference has confirmed the scale"
    if check := find_check(setup):
        differing = [name for name in setup if json_text(setup[name]) != json_text(check.setup.get(name))]
        if not differing:
            return Verification("checked", f"scale checked on {check.date[:10]}", check)
        before = np.array(check.setup.get("scale", np.nan), float)
        if differing == ["scale"] and not np.allclose(conversion.scale / before, 1, rtol=AGREES):
            raise InputError(
                f"the scale is {np.median(conversion.scale / before):.3g} times that of the check of "
                f"{check.date[:10]}: touches would be judged by a wrong force: correct device.scale or "
                "device.calibration, or repeat skin check"
            )
        reason = f"the check of {check.date[:10]} was made with another {', '.join(differing)}"
    if port.settings.sensitivity:
        return Verification("declared", "scale agrees with device.sensitivity")
    return Verification("unverified", f"unverified: {reason}; run skin check, or give device.sensitivity")
