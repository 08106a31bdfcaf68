"""What goes out is what the device felt; what comes back is given to no other touches."""

import json

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from experiments.peers.exchange import PeerPredictions, export_touches
from skin.build import build_device
from skin.config import Evaluation
from skin.evaluation.report import columns
from skin.recording import touches_hash
from skin.recording_file import read_recording

SETTINGS = Evaluation(devices=2, layouts=1, gestures=24, false_alarm_rate=0.02, safe_gestures=16)
NAMES = (
    "train",
    "validation",
    "alarm",
    "same_0",
    "holdout_0",
    "device_shift_0",
    "device_shift_1",
    "unseen_layout_0",
)


@pytest.fixture(scope="module")
def device(configured):
    return build_device(
        configured("simulator=naive", "data.gestures=60", "device.test_gestures=32", "device.dead=2")
    )


@pytest.fixture(scope="module")
def folder(device, tmp_path_factory):
    folder = tmp_path_factory.mktemp("exchange") / "naive"
    export_touches(device, SETTINGS, folder)
    return folder


def answer(folder, known, device):
    """Write answers of a peer that tells sets apart: everywhere the number of the set, by a hundred."""
    (folder / "peer").mkdir(exist_ok=True)
    for number, name in enumerate(known):
        count = len(read_recording(folder / "touches" / f"{name}.parquet"))
        table = {label: [number / 100] * count for label in device.task.names}
        pq.write_table(pa.table(table), folder / "peer" / f"{name}.parquet")
    (folder / "peer" / "about.json").write_text('{"seconds": 1.0, "parameters": 7}')


def test_every_set_of_learning_and_evaluating_is_written(folder):
    assert tuple(json.loads((folder / "sets.json").read_text())) == NAMES
    for kind in ("touches", "features"):
        assert {path.stem for path in (folder / kind).iterdir()} == set(NAMES)


def test_touches_read_back_as_the_device_felt_them(device, folder):
    for name, touches in (("train", device.touches("train")), ("same_0", device.touches("test"))):
        stored = read_recording(folder / "touches" / f"{name}.parquet").touches
        assert torch.equal(stored.readings, touches.readings)
        assert torch.equal(stored.valid, touches.valid)
        assert torch.equal(stored.labels, touches.labels)
    moved = read_recording(folder / "touches" / "unseen_layout_0.parquet").touches.positions
    assert (moved - device.touches("test").positions).norm(dim=1).max() > 1e-3


def test_features_have_one_row_per_touch(folder):
    table = pq.read_table(folder / "features" / "holdout_0.parquet")
    assert table.num_rows == 6
    assert table.num_columns > 100
    # a feature that is easy to compute again: the largest reading of each touch
    readings = read_recording(folder / "touches" / "holdout_0.parquet").touches.readings
    assert table["raw sensor maximum 1"].to_pylist() == readings.amax(dim=(1, 2)).tolist()


def test_answers_meet_the_touches_they_were_given_for(device, folder):
    answer(folder, NAMES, device)
    peer = PeerPredictions(folder, "peer", device.task)
    assert peer.about["parameters"] == 7
    found = {
        name: [float(peer.probabilities(touches).unique()) for touches in sets]
        for name, sets in columns(device, SETTINGS).items()
    }
    expected = {"same": [0.03], "holdout": [0.04], "device_shift": [0.05, 0.06], "unseen_layout": [0.07]}
    assert found == {name: pytest.approx(values) for name, values in expected.items()}


def test_touches_that_were_not_exported_get_no_answer(device, folder):
    answer(folder, NAMES, device)
    stranger = device.replace(seed=77).touches("test")
    with pytest.raises(LookupError, match="other touches"):
        PeerPredictions(folder, "peer", device.task).probabilities(stranger)


def test_what_lies_there_stays_and_what_changed_is_written_anew(device, tmp_path):
    export_touches(device, SETTINGS, tmp_path / "x")
    answer(tmp_path / "x", NAMES, device)
    before = (tmp_path / "x" / "touches" / "train.parquet").stat().st_mtime_ns
    export_touches(device, SETTINGS, tmp_path / "x")
    assert (tmp_path / "x" / "touches" / "train.parquet").stat().st_mtime_ns == before
    assert (tmp_path / "x" / "peer").is_dir()
    other = device.replace(seed=5)
    export_touches(other, SETTINGS, tmp_path / "x")
    known = json.loads((tmp_path / "x" / "sets.json").read_text())
    assert known["train"] == touches_hash(other.touches("train"))
    assert not (tmp_path / "x" / "peer").exists()


def test_a_digest_tells_readings_and_labels_apart(device):
    touches = device.touches("test")
    again = device.replace().touches("test")
    assert touches_hash(touches) == touches_hash(again)
    assert (
        len({touches_hash(touches), touches_hash(touches[:31]), touches_hash(device.touches("train"))}) == 3
    )
