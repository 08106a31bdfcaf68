"""Classify touches with numpy, pyserial and onnxruntime; PyYAML reads a calibration or an adapter.

python onnx_only.py FILE.onnx PORT N_PER_COUNT|CALIBRATION.yaml [ADAPTER.yaml]
"""

import binascii
import json
import sys
from collections import deque
from fnmatch import fnmatchcase
from time import monotonic

import numpy as np
import onnxruntime
import serial

TARE = 20  # intervals without touch at the beginning
JUDGED = 50  # lines, of which most must be readable
SILENCE = 10  # s
INVALID = {"", "-", "--", "nan", "inf", "-inf", "ovf", "err", "error", "na", "n/a", "null", "none"}
USED = {"kind", "separator", "decimal", "names", "values", "drop", "counter", "time", "time_unit", "invalid"}
UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}


def end(text):
    """End with exit code 2 and a sentence."""
    print(text, file=sys.stderr)
    sys.exit(2)


def read_yaml(path):
    """Return the settings in a file."""
    import yaml

    try:
        with open(path, encoding="utf-8") as file:
            settings = yaml.safe_load(file)
    except (OSError, ValueError, yaml.YAMLError) as error:
        end(f"{path} cannot be read: {error}")
    return settings if isinstance(settings, dict) else end(f"{path} holds no settings by name")


def read_gains(given, count):
    """Return N per count, negative where counts fall with force, channels, and what is broken, (S,) each."""
    order, broken = np.arange(count), np.zeros(count, dtype=bool)
    if not given.endswith((".yaml", ".yml")):
        return np.full(count, float(given)), order, broken
    stored = read_yaml(given)
    if (stored.get("format"), stored.get("count")) != (1, count):
        end(f"{given} is not a calibration (format: 1) of the {count} sensors of the model")
    sensors = {name: np.array(value, dtype=float) for name, value in stored["sensors"].items()}
    if stored.get("tables") or (np.nan_to_num(sensors.get("exponent", 1.0), nan=1.0) != 1).any():
        end(f"{given} has curves (tables or exponent), which this example does not apply: use skin live")
    gain = np.broadcast_to(sensors.get("gain", 1.0), count)
    gain = np.where(np.isnan(gain), np.nanmedian(gain) if np.isfinite(gain).any() else 1.0, gain)
    broken[[number for numbers in (stored.get("broken") or {}).values() for number in numbers]] = True
    # Zero and offsets do not count: the tare replaces them.
    scale = stored.get("scale", 1.0) * np.array(stored.get("polarity") or 1.0) / gain
    return scale, np.array(stored.get("channels") or order), broken


def read_adapter(path):
    """Return the settings of lines of numbers; anything else is refused."""
    adapter = read_yaml(path)
    if adapter.get("kind") != "text":
        end(f"device.adapter.kind={adapter.get('kind', 'protocol')}: this example reads text; use skin live")
    if other := sorted(adapter.keys() - USED):
        end(f"device.adapter.{other[0]}: this example reads only {', '.join(sorted(USED))}; use skin live")
    if adapter.get("time") not in (None, "auto") and adapter.get("time_unit") not in UNITS:
        end("device.adapter.time needs device.adapter.time_unit: s, ms or us")
    return adapter


def read_protocol(line):
    """Return time, s, and values (S,) of a line of our protocol, or ValueError."""
    body, _, check = line.rpartition(b"*")
    if check != b"%04X" % binascii.crc_hqx(body, 0xFFFF):
        raise ValueError("checksum")
    _, microseconds, *values = map(float, body.split(b","))
    return microseconds / 1e6, values


def read_text(line, count, adapter):
    """Return time, s, and values (S,) of a line that an adapter describes, or ValueError.

    Without the field and unit of a clock, the time is that of the arrival. A counter and a clock that have
    no names stand before the values and are left out.
    """
    body, star, check = line.decode("ascii").rpartition("*")
    if star and check != f"{binascii.crc_hqx(body.encode(), 0xFFFF):04X}":
        raise ValueError("checksum")
    text, decimal = check if not star else body, adapter.get("decimal", ".")
    marks = [mark for mark in ",;\t" if mark != decimal and mark in text]
    mark = (adapter.get("separator") or (marks[0] if marks else "")).strip(" ") or None
    words = [word.strip() for word in text.strip(" ").removesuffix(mark or "\n").split(mark)]
    words = [word.replace(",", ".") if decimal == "," else word for word in words]
    invalid = INVALID | {str(word).lower() for word in adapter.get("invalid", [])}
    numbers = [np.nan if word.lower() in invalid else float(word) for word in words]

    def positions(fields):
        names = adapter.get("names") or [""]
        names = [names[n % len(names)] for n in range(len(words))]
        return [n for f in fields for n in range(len(words)) if n == f or fnmatchcase(names[n], str(f))]

    roles = {
        role: positions([adapter[role]])
        for role in ("counter", "time")
        if adapter.get(role) not in (None, "auto")
    }
    aside = {*positions(adapter.get("drop") or []), *(n for found in roles.values() for n in found)}
    kept = [n for n in range(len(words)) if n not in aside]
    kept = positions(adapter["values"]) if adapter.get("values") else kept
    spare = sum(
        adapter.get(role, "auto") == "auto" for role in ("counter", "time") if not adapter.get("names")
    )
    kept = kept[len(kept) - count :] if count <= len(kept) <= count + spare else kept
    time = numbers[roles["time"][0]] * UNITS[adapter["time_unit"]] if roles.get("time") else monotonic()
    return time, [numbers[n] for n in kept]


def main():
    """Print a JSON line for each interval of the model."""
    path, port, given, *files = sys.argv[1:]
    session = onnxruntime.InferenceSession(path)
    about = json.loads(session.get_modelmeta().custom_metadata_map["tactile_skin"])
    if about["schema"] != 1:
        end(f"{path} has schema {about['schema']}: write the file again with skin export")
    count = about["sensors"]
    try:
        scale, channels, broken = read_gains(given, count)
    except (LookupError, TypeError, ValueError) as error:
        end(f"{given} is neither N per count nor a calibration of {count} sensors: {error}")
    adapter = read_adapter(files[0]) if files else None
    window, quiet, peak, interval = deque(maxlen=about["window"]), [], None, None
    lines = bad = 0
    try:
        stream = serial.serial_for_url(port, 115200, timeout=SILENCE)
    except serial.SerialException as error:
        end(f"{port} cannot be opened: {error}")
    with stream:
        stream.readline()  # it may be half a line
        while line := stream.readline(16384):
            line = line.strip()
            if not line or line.startswith(b"#"):
                continue
            lines += 1
            try:
                time, values = read_text(line, count, adapter) if adapter else read_protocol(line)
                if len(values) != count:
                    raise ValueError(f"{len(values)} values instead of {count}")
                values = scale * np.array(values)[channels]
                interval, before = int(time * about["rate"]), interval
            except (ValueError, OverflowError) as error:
                bad, reason = bad + 1, error
                continue
            finally:
                if lines == JUDGED:
                    said = f"{bad} of {lines} lines cannot be read" + (f": {reason}" if bad else "")
                    if bad > JUDGED / 2:
                        end(f"{said}; give an adapter, as skin listen adapter=auto proposes it")
                    if bad:
                        print(said, file=sys.stderr)
                    lines = bad = 0
            # The model takes the maximum of each sensor over each interval.
            if interval == before:
                peak = np.fmax(peak, values)
                continue
            if before is not None:
                (quiet if len(quiet) < TARE else window).append(peak)
            peak = values
            if len(window) < about["window"]:
                continue
            newtons = np.stack(window) - np.nanmedian(quiet, axis=0)
            valid = np.isfinite(newtons) & ~broken
            readings = np.where(valid, newtons, 0).astype(np.float32)
            probabilities = session.run(None, {"readings": readings[None], "valid": valid[None]})[0][
                0
            ].tolist()
            probabilities = dict(zip(about["labels"], probabilities, strict=True))
            touched = bool(readings.max() >= about["contact"])
            alarm = touched and probabilities["dangerous"] > about["threshold"]
            print(json.dumps({"touched": touched, "alarm": alarm, **probabilities}), flush=True)
    end(f"{port} sends no line for {SILENCE} s")


if __name__ == "__main__":
    main()
