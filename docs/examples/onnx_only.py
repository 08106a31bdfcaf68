"""Classify touches with numpy, pyserial and onnxruntime: python onnx_only.py FILE.onnx PORT N_PER_COUNT."""

import binascii
import json
import sys
from collections import deque

import numpy as np
import onnxruntime
import serial

TARE = 20  # intervals without touch at the beginning
path, port, scale = *sys.argv[1:3], float(sys.argv[3])
session = onnxruntime.InferenceSession(path)
about = json.loads(session.get_modelmeta().custom_metadata_map["tactile_skin"])
assert about["schema"] == 1, "write the file again with skin export"
window, quiet, peak, interval = deque(maxlen=about["window"]), [], None, None
with serial.Serial(port, 115200) as stream:
    while True:
        body, _, check = stream.readline().strip().rpartition(b"*")
        if body.startswith(b"#") or check != b"%04X" % binascii.crc_hqx(body, 0xFFFF):
            continue  # a comment, or a damaged line
        _, microseconds, *values = map(float, body.split(b","))
        # The model takes the maximum of each sensor over each interval.
        before, interval = interval, int(microseconds / 1e6 * about["rate"])
        if interval == before:
            peak = np.maximum(peak, values)
            continue
        if before is not None:
            (quiet if len(quiet) < TARE else window).append(peak)
        peak = np.array(values)
        if len(window) == about["window"]:
            readings = (scale * (np.stack(window) - np.median(quiet, axis=0))).astype(np.float32)[None]
            given = {"readings": readings, "valid": np.ones_like(readings, dtype=bool)}
            chances = dict(zip(about["labels"], session.run(None, given)[0][0].tolist(), strict=True))
            touched = bool(readings.max() >= about["contact"])
            alarm = touched and chances["dangerous"] > about["threshold"]
            print(json.dumps({"touched": touched, "alarm": alarm, **chances}), flush=True)
