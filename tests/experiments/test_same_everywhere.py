"""The commands of a skin at a port, end to end: emulate, record, play back, evaluate."""

import re
import signal
import socket
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import torch

from skin.body.base import Sheet
from skin.body.layout import Grid
from skin.device.files import read_recording
from skin.record.serial import Serial

NINE = ["layout=grid", "layout.rows=3", "layout.columns=3", "simulator=naive"]
TRAINED = ["data.gestures=1000", "device.test_gestures=96", "evaluation.devices=1"]
TRAINED += ["evaluation.layouts=1", "evaluation.safe_gestures=64"]
COUNT = 8


@pytest.mark.slow("starts an emulator and waits for a signal")
def test_ctrl_c_ends_the_emulator_well(begin, tmp_path):
    link = tmp_path / "skin"
    with begin(tmp_path, "emulate", *NINE, f"link={link}") as process:
        lines = process.lines()
        assert next(lines) == str(link)
        assert "device.scale=0.0390625" in next(lines)
        process.send_signal(signal.SIGINT)
        assert process.wait() == 0
    assert not link.is_symlink()


def stream(begin, folder):
    """Return the bytes that an emulated skin sends for some gestures, and its N per count."""
    fast = ["port=0", "emulate.speed=20", f"gestures={COUNT}"]
    with begin(folder, "emulate", *NINE, *fast) as process:
        lines = process.lines()
        port = next(lines)
        scale = re.search(r"device\.scale=(\S+)", next(lines))[1]
        with socket.create_connection(("127.0.0.1", int(port.rpartition(":")[2])), timeout=300) as skin:
            pieces = iter(lambda: skin.recv(65536), b"")
            data = b"".join(pieces)
        process.wait()
    return data, scale


def answers(folder, said):
    files = sorted(Path(folder).glob("a/**/predictions.parquet"), key=lambda path: path.stat().st_mtime)
    assert "evaluation" in said
    return pq.read_table(files[-1]).to_pydict()


@pytest.mark.slow("trains a run and starts a live view")
def test_a_skin_at_a_port_and_its_recording_are_judged_alike(run, begin, played, tmp_path):
    def tell(script, *overrides):
        return run(tmp_path, script, *overrides, store=script != "record.py").stdout

    tell("train.py", "experiment=rules", *NINE, *TRAINED)
    data, scale = stream(begin, tmp_path)
    assert data.count(b'# {"number"') == COUNT
    port = played(lambda reader, stop: reader.sendall(data))
    there = [f"device.port={port}", f"device.scale={scale}", f"device.gestures={COUNT}"]
    live = answers(tmp_path, tell("evaluate.py", "device=serial", *there, f"out={tmp_path}/live"))
    said = tell("record.py", *NINE, "out=s", "device.labels=announced", *there)
    assert said == f"s.parquet: {COUNT} gestures\n"
    sheet = Sheet((0.16, 0.16), (32, 32), [{"material": "EcoFlex 00-30", "thickness": 0.005}])
    direct = Serial(body=sheet, layout=Grid(3, 3), port=port, scale=float(scale), gestures=COUNT)
    felt = direct.touches("test")
    stored = read_recording(tmp_path / "s.parquet").touches
    assert torch.equal(felt.readings, stored.readings)
    assert torch.equal(felt.valid, stored.valid)
    assert torch.equal(felt.labels, stored.labels)
    file = ["device=recording", "device.path=s.parquet", "device.test=all"]
    again = answers(tmp_path, tell("evaluate.py", *file, f"out={tmp_path}/played"))
    assert len(next(iter(live.values()))) == COUNT
    assert again == live
    text = tell("compare", *NINE, "session=s", "run=latest", f"out={tmp_path}")
    assert text.startswith("# The same gestures, simulated and recorded")
    ratio = float(re.search(r"median: (\d\.\d+)", text)[1])
    assert ratio == pytest.approx(1.0, abs=0.1)
    assert f"of {COUNT} gestures, and is right on" in text
    assert text.startswith((tmp_path / "compare.md").read_text())
    assert (tmp_path / "compare.png").stat().st_size > 10_000
