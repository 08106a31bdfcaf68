"""The command that calibrates: from an emulated bench to a device that trains."""

import json
from time import monotonic

import numpy as np
import pytest

from skin.calibration.known_loads import KnownLoad, base_readings
from skin.device.calibration import read_calibration
from skin.runs.build import build_skin
from skin.wire.protocol import Header, encode_header, encode_line
from tests.wire.conftest import Plug

SMALL = ["layout=grid", "layout.rows=2", "layout.columns=2"]


@pytest.mark.slow("fits and generates a data set")
def test_from_a_bench_to_touches_of_the_calibrated_device(run, tmp_path):
    session, out = tmp_path / "bench.parquet", tmp_path / "mine.yaml"
    words = [*SMALL, f"session={session}", f"out={out}", "calibrate.demo=true", "device.gain_spread=0.2"]
    done = run(tmp_path, "calibrate", *words, store=False)
    assert "Warning" not in done.stderr
    assert "8 presses" in done.stdout
    again = run(tmp_path, "calibrate", *words, store=False, code=2)
    assert "a file that does not exist" in again.stderr
    assert "RMSE on 2 held-out presses" in done.stdout
    assert len(read_calibration(out)) == 4
    touches = tmp_path / "touches.csv"
    words = [*SMALL, "n=16", f"out={touches}", f"device.calibration={out}", "device.randomise=true"]
    run(tmp_path, "generate.py", *words, store=False)
    assert touches.is_file()


@pytest.mark.slow("fits the noise of a data set")
def test_a_calibration_that_does_not_help_ends_with_1_and_writes_nothing(run, tmp_path):
    perfect = ["device.gain_spread=0", "device.offset=0", "device.clip=1000"]
    session, out = tmp_path / "bench.csv", tmp_path / "mine.yaml"
    files = f"session={session}", f"out={out}"
    done = run(tmp_path, "calibrate", *SMALL, *perfect, *files, "calibrate.demo=true", store=False, code=1)
    assert "does not reduce the error" in done.stdout
    assert not out.exists()


@pytest.mark.slow("fits a bench")
def test_a_session_with_other_axes_is_refused_until_that_is_confirmed(run, tmp_path):
    session, out = tmp_path / "bench.csv", tmp_path / "mine.yaml"
    files, demo = (f"session={session}", f"out={out}"), "calibrate.demo=true"
    done = run(tmp_path, "calibrate", *SMALL, *files, demo, "calibrate.places=mirror_y", store=False, code=2)
    assert len(done.stderr.strip().splitlines()) == 1
    assert "respond, but not to the presses near their sensors" in done.stderr
    assert "add calibrate.places=as_given" in done.stderr
    assert not out.exists()
    lines = [line.split(",") for line in session.read_text().splitlines()]
    positions = lines[0].index("y_m") if "y_m" in lines[0] else lines[0].index('"y_m"')
    for line in lines[1:]:
        line[positions] = line[positions] and str(0.16 - float(line[positions]))
        line[1], line[2] = line[2], line[1]
    session.write_text("\n".join(map(",".join, lines)) + "\n")
    wrong = ["calibrate.places=mirror_y", "calibrate.channels=[1,0,2,3]"]
    done = run(tmp_path, "calibrate", *SMALL, *files, store=False, code=2)
    assert all(f"{setting}" in done.stderr for setting in wrong)
    done = run(tmp_path, "calibrate", *SMALL, *files, *wrong, store=False)
    assert list(read_calibration(out).channels) == [1, 0, 2, 3]


SOLID = [*SMALL, "simulator=solid", "simulator.divisions=1"]
WATCHED = ["run=any_skin", "evaluation.safe_gestures=64"]


@pytest.mark.slow("chooses a threshold")
def test_eight_presses_show_a_little_and_no_more(run, tmp_path):
    run(tmp_path, "calibrate", *SOLID, "session=bench.csv", "calibrate.demo=true", store=False)
    words = ["compare", "session=bench.csv", *SOLID]
    done = run(tmp_path, *words, *WATCHED, "out=enough", "compare.miss_rate=0.5", store=False)
    page = (tmp_path / "enough" / "compare.md").read_text()
    assert "above 1.1 x the limit and on a valid sensor: 8 of 8, 0 missed" in page
    assert "- alarm above 0." in page
    assert page in done.stdout
    done = run(tmp_path, *words, *WATCHED, "out=few", "compare.miss_rate=0.05", store=False, code=2)
    assert "0 misses of 8 presses above 1.1 x the limit" in done.stderr
    assert "88 presses are needed" in done.stderr
    assert not (tmp_path / "few").exists()
    done = run(tmp_path, *words, "compare.miss_rate=0.05", store=False, code=2)
    assert "needs presses of known force, and run= with an alarm to test" in done.stderr


NAIVE = [*SMALL, "simulator=naive"]
LOAD, PERIOD = 2.8, 4.2  # s


@pytest.fixture
def port(configured):
    """Serve a skin in counts of 0.02 N, on which 1.5 kg lies on three sensors, one after the other."""
    model = build_skin(configured(*NAIVE))
    simulator = model.simulator(model.body, model.sensors)
    expected = base_readings(simulator, model.body, model.sensors, KnownLoad(1.5, 0.006))[0]
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


@pytest.mark.parametrize(("scale", "weight"), [(0.02, 1.5), (0.002, 1.5), (0.02, 0.5)])
def test_three_loads_at_a_port(run, tmp_path, monkeypatch, port, scale, weight):
    monkeypatch.setenv("SKIN_DATA", str(tmp_path / "data"))
    words = "check", *NAIVE, port, f"device.scale={scale}", f"weight={weight}", "seconds=2"
    done = run(tmp_path, *words, store=False, code=None)
    files = list((tmp_path / "data").rglob("*.json"))
    if (scale, weight) == (0.02, 1.5):
        (stored,) = [json.loads(file.read_text()) for file in files]
        assert stored["setup"]["device"] == "arm-L"
        assert list(stored["ratios"]) == ["0", "1", "2"]
        assert stored["rest"] == pytest.approx([100] * 4, abs=3)
        assert "3 of 3" in done.stderr
    else:
        assert (done.returncode, files) == (2, [])
        reason = "nothing was stored" if weight == 1.5 else "give a heavier and wider one"
        assert reason in done.stderr.splitlines()[-1]
