"""The command that checks the scale of a skin at a port."""

import json
from time import monotonic

import numpy as np
import pytest

pytest.importorskip("termios", reason="pseudo-terminals need a POSIX system")

from skin.calibration.known_loads import KnownLoad, base_readings
from skin.runs.build import build_skin
from skin.wire.protocol import Header, encode_header, encode_line
from tests.wire.conftest import Plug

SKIN = ["layout=grid", "layout.rows=2", "layout.columns=2", "simulator=naive"]
LOAD, PERIOD = 2.8, 4.2  # s


@pytest.fixture
def port(configured):
    """Serve a skin in counts of 0.02 N, on which 0.5 kg lies on three sensors, one after the other."""
    model = build_skin(configured(*SKIN))
    simulator = model.simulator(model.body, model.sensors)
    expected = base_readings(simulator, model.body, model.sensors, KnownLoad(0.5, 0.006))[0]
    plug, noise = Plug(), np.random.default_rng(0)
    now, sent = 0.0, monotonic()

    def send(number):
        nonlocal now, sent
        before, sent = sent, monotonic()
        now += min(sent - before, 0.1)  # it stands still while nobody reads
        position, since = divmod(now - 12, PERIOD)
        load = expected[int(position)] if 0 <= position < 3 and since < LOAD else np.zeros(4)
        header = encode_header(Header(1, 4, 50.0, "adc", 12, "arm-L")) if number % 50 == 0 else b""
        counts = np.round(100 + (load + noise.normal(0, 0.02, 4)) / 0.02).astype(int).tolist()
        return header + encode_line(counts, number, round(1e6 * now))

    with plug.streaming(send, 1 / 50):
        yield f"device.port={plug.port}"
    plug.unplug()


@pytest.mark.parametrize("scale", [0.02, 0.002])
def test_three_loads_at_a_port(run, tmp_path, monkeypatch, port, scale):
    monkeypatch.setenv("SKIN_DATA", str(tmp_path / "data"))
    done = run(tmp_path, "check", *SKIN, port, f"device.scale={scale}", "seconds=2", store=False, code=None)
    files = list((tmp_path / "data").rglob("*.json"))
    if scale == 0.02:
        (stored,) = [json.loads(file.read_text()) for file in files]
        assert stored["setup"]["device"] == "arm-L"
        assert list(stored["ratios"]) == ["0", "1", "2"]
        assert stored["rest"] == pytest.approx([100] * 4, abs=3)
        assert "3 of 3" in done.stderr
    else:
        assert (done.returncode, files) == (2, [])
        assert "nothing was stored" in done.stderr.splitlines()[-1]
