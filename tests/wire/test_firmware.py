"""The sketch of the documentation, compiled against a stand-in for Arduino.h, is understood."""

import shutil
import subprocess

import numpy as np
import pytest

from skin.core.files import ROOT
from skin.wire.decoder import Decoder
from skin.wire.protocol import Header

SKETCH = ROOT / "docs" / "firmware" / "skin" / "skin.ino"
FIRST_US = 2**32 - 3_000_000  # the clock wraps after three seconds

# Six pins; the converter takes 100 us; pin p reads 100 p plus the tens of milliseconds that have passed.
STAND_IN = """
#include <stdint.h>
#include <stdio.h>
enum { A0, A1, A2, A3, A4, A5 };
static uint32_t clock_us = %uu;
static uint32_t micros() { return clock_us += 4; }
static uint16_t analogRead(uint8_t pin) { clock_us += 100; return 100 * pin + clock_us / 10000 %% 97; }
struct { void begin(uint32_t) {} void print(const char *text) { fputs(text, stdout); } } Serial;
"""
RUN = '#include "skin.ino"\nint main() { setup(); while (seq < 1200) loop(); }\n'


@pytest.fixture(scope="module")
def said(tmp_path_factory):
    compiler = shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        pytest.skip("no C++ compiler")
    folder = tmp_path_factory.mktemp("sketch")
    (folder / "Arduino.h").write_text(STAND_IN % FIRST_US)
    (folder / "main.cpp").write_text(RUN)
    program = folder / "sketch"
    flags = ["-Wall", "-Wno-format", f"-I{folder}", f"-I{SKETCH.parent}", "-o", str(program)]
    subprocess.run([compiler, *flags, str(folder / "main.cpp")], check=True, capture_output=True, timeout=120)
    return subprocess.run([str(program)], check=True, capture_output=True, timeout=60).stdout


def test_every_frame_of_the_sketch_is_read(said):
    assert len(SKETCH.read_text().splitlines()) < 60
    decoder = Decoder()
    frames = decoder.feed(said)
    assert decoder.sensors == 6
    assert [frame.seq for frame in frames] == list(range(1200))
    assert decoder.frame_format.check == "crc16"
    assert decoder.header == Header(1, 6, 100.0, "adc", 10, "uno")
    assert decoder.stats.bad.total() + decoder.stats.lost + decoder.stats.resets == 0
    values = np.stack([frame.values for frame in frames])
    assert values[:, 5] - values[:, 0] == pytest.approx(500, abs=97)
    steps = np.diff([frame.t for frame in frames])
    assert steps == pytest.approx(0.01, abs=2e-4)
    # The header comes each second.
    lines = said.splitlines()
    positions = [position for position, line in enumerate(lines) if line.startswith(b"# skin ")]
    assert positions[0] == 0
    assert max(np.diff([*positions, len(lines)])) <= 102
