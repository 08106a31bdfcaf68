"""Sets of LeRobot and MCAP files: what they hold, and what comes back."""

import json
import os
import signal
from collections import deque
from contextlib import suppress
from dataclasses import replace
from functools import partial
from io import BytesIO
from math import nan
from time import monotonic, time

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import torch

from skin.body.base import Sensors
from skin.device.files import read_recording, write_recording
from skin.device.resampling import Frame
from skin.device.touches import Recording, Touches
from skin.errors import InputError
from skin.live.loop import Display
from skin.live.verdict import Verdict
from skin.live.view import CHANGES, VERDICTS, write_file
from skin.robot.recordings import (
    LIVE,
    TACTILE,
    live_messages,
    read_lerobot,
    write_lerobot,
    write_mcap,
    write_messages,
)
from skin.touch.labels import Task
from skin.wire.channels import UnitConversion

CASES = ["plain", "everything"]
SQUARE = np.array([[0.02, 0.02, 0], [0.06, 0.02, 0], [0.02, 0.06, 0], [0.06, 0.06, 0]])
SENSORS = Sensors(SQUARE, (0.01, 0.01))
ROWS, INFO = "data/chunk-000/file-000.parquet", "meta/info.json"


def recording(case="everything", batch=3, frames=4, sensors=5):
    draw = torch.Generator().manual_seed(0)
    shape = batch, frames, sensors
    valid = torch.ones(shape, dtype=torch.bool)
    positions = torch.rand(sensors, 3, generator=draw) / 3  # no short decimals
    touches = Touches(torch.randn(shape, generator=draw), valid, positions, None, 10.0)
    plain = Recording(touches, Task(("big", "press")), (0.1, 0.2), (0.01, 0.01))
    if case == "plain":
        return plain
    valid[1, 2:, 3] = False
    saturated, there = (torch.rand(*size, generator=draw) > 0.5 for size in (shape, (batch, frames, 2, 1)))
    contacts = torch.where(there, torch.rand(batch, frames, 2, 5, generator=draw), nan)
    labels = torch.tensor([[1.0, 0.0], [nan, 1.0], [0.0, nan]])
    more = {"labels": labels, "rate": 33.3, "saturated": saturated, "contacts": contacts}
    touches = replace(touches, readings=touches.readings * valid, **more)
    normals = torch.nn.functional.normalize(torch.randn(sensors, 3, generator=draw), dim=1)
    return replace(
        plain,
        touches=touches,
        force=torch.rand(batch, frames, generator=draw),
        displacement=torch.rand(*shape, 2, generator=draw),
        parameters={"x": torch.tensor([0.1, nan, 0.3]), "group_person": torch.tensor([0.0, 1.0, 1.0])},
        metadata={"groups": {"person": ["anna", "ben"]}, "directions": normals.tolist()},
    )


def same(first, second):
    for name in ("readings", "valid", "positions", "labels", "saturated", "contacts", "rate"):
        np.testing.assert_array_equal(getattr(first.touches, name), getattr(second.touches, name), name)
    for name in ("force", "displacement"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), name)
    assert first.parameters.keys() == second.parameters.keys()
    for name, values in first.parameters.items():
        np.testing.assert_array_equal(values, second.parameters[name], name)
    for name in ("task", "size", "footprint", "metadata"):
        assert getattr(first, name) == getattr(second, name)


@pytest.mark.parametrize("case", CASES)
def test_a_recording_comes_back_to_the_last_bit(tmp_path, case):
    before = recording(case)
    write_lerobot(before, tmp_path / "set")
    same(read_lerobot(tmp_path / "set"), before)


def test_a_set_is_as_lerobot_documents_it(tmp_path):
    """Files, fields, columns and types of docs/source/lerobot-dataset-v3.mdx and of its loader."""
    before, folder = recording(), tmp_path / "set"
    write_lerobot(before, folder)
    meta = ["meta/episodes/chunk-000/file-000.parquet", INFO, "meta/stats.json", "meta/tasks.parquet"]
    assert sorted(str(path.relative_to(folder)) for path in folder.rglob("*.*")) == [ROWS, *meta]
    info = json.loads((folder / "meta/info.json").read_text(), parse_constant=pytest.fail)
    assert (info["codebase_version"], info["fps"], info["splits"]) == ("v3.0", 33.3, {"train": "0:3"})
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (3, 12, 1)
    data = pq.read_table(folder / info["data_path"].format(chunk_index=0, file_index=0))
    assert set(data.column_names) == set(info["features"])
    for name, feature in info["features"].items():
        (width,) = feature["shape"]
        kind = data.schema.field(name).type
        if width > 1:  # datasets.Sequence of fixed length; one value is a scalar
            assert kind.list_size == width
            kind = kind.value_type
        assert kind == {"float32": "float", "int64": "int64"}[feature["dtype"]]
        assert "/" not in name
    assert np.isnan(data[TACTILE].to_pylist()[6][3])  # of a sensor without a valid reading
    assert data["timestamp"].to_pylist()[:5] == pytest.approx([*np.arange(4) / 33.3, 0])
    assert data["index"].to_pylist() == [*range(12)]
    episodes = pd.read_parquet(folder / "meta/episodes")
    assert episodes["length"].tolist() == [4, 4, 4]
    assert episodes["dataset_to_index"].tolist() == [4, 8, 12]
    for episode in episodes.itertuples():
        rows = data["episode_index"].to_numpy()[episode.dataset_from_index : episode.dataset_to_index]
        assert set(rows) == {episode.episode_index}
    tasks = pd.read_parquet(folder / "meta/tasks.parquet")
    assert tasks.loc[episodes["tasks"][0][0]].task_index == 0
    stats = json.loads((folder / "meta/stats.json").read_text(), parse_constant=pytest.fail)
    readings = np.ma.masked_array(before.touches.readings, ~before.touches.valid).reshape(12, 5)
    assert stats[TACTILE]["mean"] == pytest.approx(readings.mean(axis=0).tolist(), abs=1e-6)
    assert stats["label.press"]["count"] == [12]
    shared = info["features"][TACTILE]["skin"]
    assert shared["units"]["reading"] == "N"
    assert np.float32(shared["positions"]).tolist() == before.touches.positions.tolist()
    assert shared["metadata"]["directions"] == before.metadata["directions"]


def foreign(folder, lengths=(7, 3), shape=(2, 2)):
    """Write a set of another program, whose second file holds the first episode."""
    (folder / "meta").mkdir(parents=True)
    features = {"observation.grid": {"dtype": "float32", "shape": shape}}
    (folder / "meta/info.json").write_text(json.dumps({"fps": 30, "features": features}))
    begin = 0
    for number, length in enumerate(lengths):
        values = np.arange(4.0 * length).reshape(length, *shape) + 100 * number
        path = folder / f"data/chunk-000/file-00{1 - number}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        rows = {"observation.grid": values.tolist(), "index": np.arange(begin, begin + length)}
        rows |= {"episode_index": number, "frame_index": np.arange(length)}
        pd.DataFrame(rows).to_parquet(path)
        begin += length
    return folder


@pytest.mark.parametrize(("frames", "starts"), [(None, [0, 100]), (3, [0, 12, 24, 100])])
def test_an_episode_of_another_set_is_a_touch_or_several(tmp_path, frames, starts):
    read = partial(read_lerobot, feature="observation.grid", scale=2.0, frames=frames)
    found = read(foreign(tmp_path / "set"), SENSORS, (0.08, 0.08))
    touches = found.touches
    assert touches.readings[:, 0, 0].tolist() == [2 * start for start in starts]
    assert touches.readings.shape == (len(starts), frames or 7, 4)
    assert touches.valid[-1].all(dim=1).tolist() == [True] * 3 + [False] * ((frames or 7) - 3)
    assert touches.rate == 30
    assert found.metadata["groups"] == {"episode": ["0", "1"]}
    assert found.parameters["group_episode"].tolist() == [0.0] * (len(starts) - 1) + [1.0]
    np.testing.assert_allclose(touches.positions, SENSORS.positions, rtol=1e-6)


def unlike(path):
    info = json.loads(path.read_text())
    info["features"][TACTILE]["skin"]["positions"] = [[0.0, 0.0, 0.0]]
    path.write_text(json.dumps(info))


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        (ROWS, lambda path: path.write_bytes(path.read_bytes()[:-20]), "is damaged"),
        (ROWS, lambda path: pq.write_table(pq.read_table(path)[:11], path), "11 rows, not 3 touches of 4"),
        (INFO, unlike, "is damaged"),
        (INFO, lambda path: path.write_text("[1"), "is damaged"),
    ],
)
def test_a_damaged_set_is_one_sentence(tmp_path, name, damage, message):
    write_lerobot(recording(), tmp_path / "set")
    damage(tmp_path / "set" / name)
    with pytest.raises(InputError, match=message) as refused:
        read_lerobot(tmp_path / "set")
    assert "\n" not in str(refused.value)


def test_a_set_without_positions_says_how_to_give_a_layout(tmp_path):
    read = partial(read_lerobot, foreign(tmp_path / "set"))
    with pytest.raises(InputError, match=r"layout=file layout\.path=FILE\.csv body\.size=") as refused:
        read(feature="observation.grid")
    assert "\n" not in str(refused.value)
    with pytest.raises(InputError, match=r"has no feature observation\.tactile: give one"):
        read()
    with pytest.raises(InputError, match="readings of 4 sensors, positions are 3"):
        read(Sensors(SENSORS.positions[:3], (0.01, 0.01)), (0.08, 0.08), "observation.grid")


def test_the_command_writes_and_reads_them(run, tmp_path):
    write_recording(recording(), tmp_path / "x.parquet")
    convert = partial(run, tmp_path, "convert", store=False)
    assert convert("from=x.parquet", "out=set").stdout.startswith("set: 3 touches of 4 frames at 33.3 Hz")
    convert("from=set", "out=back.parquet")
    same(read_recording(tmp_path / "back.parquet"), read_recording(tmp_path / "x.parquet"))
    foreign(tmp_path / "other")
    words = ["from=other", "options={feature: observation.grid}", "out=other.parquet"]
    refused = convert(*words)
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    assert "layout=file layout.path=FILE.csv" in refused.stderr
    (tmp_path / "layout.csv").write_text("x_m,y_m\n.02,.02\n.06,.02\n.02,.06\n.06,.06\n")
    convert(*words, "layout=file", "layout.path=layout.csv", "body.size=[0.08,0.08]")
    assert read_recording(tmp_path / "other.parquet").metadata["positions"] == "layout"


@pytest.fixture
def read():
    """Return a function that returns the messages of a file, (topic, ns, content), by the reader of mcap."""
    reader = pytest.importorskip("mcap.reader", reason="pip install 'tactile-skin[robot]'")

    def messages(path):
        with path.open("rb") as file:
            opened = reader.make_reader(file, validate_crcs=True)
            for channel in opened.get_summary().channels.values():
                schema = opened.get_summary().schemas[channel.schema_id]
                assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
                plain(json.loads(schema.data))
            (metadata,) = opened.iter_metadata()
            layout = {name: json.loads(text) for name, text in metadata.metadata.items()}
            parse = partial(json.loads, parse_constant=pytest.fail)
            sent = [(channel.topic, message) for _, channel, message in opened.iter_messages()]
        return [(topic, message.log_time, parse(message.data)) for topic, message in sent], layout

    return messages


def plain(schema):
    """Assert that a schema has what Foxglove reads: one type each, items of arrays, fields of objects."""
    if schema["type"] == "object":
        [plain(field) for field in schema["properties"].values()]
    elif schema["type"] == "array":
        assert schema["items"]["type"] != "array"
        plain(schema["items"])
    else:
        assert schema["type"] in ("number", "string", "boolean")


@pytest.mark.parametrize("case", CASES)
def test_a_recording_is_read_back_by_the_reader_of_mcap(tmp_path, read, case):
    before = recording(case)
    write_mcap(before, tmp_path / "x.mcap")
    messages, layout = read(tmp_path / "x.mcap")
    times = [when for topic, when, _ in messages if topic == "/skin/readings"]
    assert times == [round(1e9 * row / before.touches.rate) for row in range(12)]
    sent = [content["newtons"] for topic, _, content in messages if topic == "/skin/readings"]
    valid = before.touches.valid.flatten(0, 1)
    readings = before.touches.readings.flatten(0, 1).where(valid, nan)
    np.testing.assert_array_equal(np.array(sent, float), readings)
    assert np.float32(layout["positions"]).tolist() == before.touches.positions.tolist()
    assert layout["units"]["reading"] == "N"
    touch = [content for topic, _, content in messages if topic == "/skin/touch"]
    if case == "everything":
        assert [row["press"] for row in touch[::4]] == [0, 1, None]
        np.testing.assert_allclose([row["force"] for row in touch], before.force.flatten())
        assert len(touch[0]["saturated"]) == 5


def frame(number, newtons):
    unit = UnitConversion(np.ones(2), np.zeros(2), np.zeros(2, bool))
    valid = np.array([True, number % 2 == 0])
    sent = Frame(number, 0.01 * number, monotonic(), np.array(newtons), valid)
    return unit.convert(sent._replace(saturated=np.array([number > 2, False])))


def test_a_live_view_is_recorded_as_it_happens(tmp_path, read):
    writer = pytest.importorskip("mcap.writer")
    path, shown = tmp_path / "live.mcap", Display("run", "port", np.zeros((2, 3)), (0.1, 0.1), 4.0)
    shown.add(frame(0, [0.0, 0.0]))  # nobody takes it
    shown.recent = deque(maxlen=100)
    epoch = time() - monotonic()

    def form(file, verdicts):
        write_messages(writer, {"unit": "N"}, LIVE, file, live_messages(verdicts, shown.recent, epoch))

    recorded = partial(write_file, shown, path, "xb", VERDICTS | CHANGES, form, "live.record=FILE.mcap")
    before = time()
    with recorded():
        for number in range(1, 4):
            shown.add(frame(number, [number, 0.5]))
        labels = {"big": True, "dangerous": True}
        probabilities = {"big": 0.75, "dangerous": nan}
        shown.set_verdict(Verdict(0.03, monotonic(), probabilities, True, labels, True), monotonic())
        shown.add(frame(4, [4.0, 0.5]))
    messages, _ = read(path)
    readings = [(when, content) for topic, when, content in messages if topic == "/skin/readings"]
    assert [content["newtons"] for _, content in readings] == [[1, None], [2, 0.5], [3, None], [4, 0.5]]
    assert [content["saturated"][0] for _, content in readings] == [False, False, True, True]
    assert [content["device_time"] for _, content in readings] == pytest.approx([0.01, 0.02, 0.03, 0.04])
    assert all(before - 1 < when / 1e9 < time() + 1 for _, when, _ in messages)
    verdicts = [content for topic, _, content in messages if topic == "/skin/verdict"]
    assert [content["event"] for content in verdicts] == ["started", "resumed", "alarm", "ended"]
    assert verdicts[2]["alarm"] is True
    assert verdicts[2]["probabilities"] == {"big": 0.75, "dangerous": None}
    contacts = [content for topic, _, content in messages if topic == "/skin/contacts"]
    assert {content["state"] for content in contacts} == {"unknown"}
    with pytest.raises(InputError, match=r"File exists.*live\.record=FILE\.mcap"), recorded():
        pass


def test_messages_of_a_live_view_keep_their_order():
    times = ("2026-01-01T00:00:00.002Z", "2026-01-01T00:00:00.001Z", "2026-01-01T00:00:00.003Z")
    verdicts = [{"time": text, "contacts": {}} for text in times]
    moments = [moment for topic, moment, _ in live_messages(verdicts, deque(), 0.0) if topic == "verdict"]
    assert [moment // 1_000_000 % 1000 for moment in moments] == [2, 2, 3]


def test_a_killed_process_leaves_all_complete_chunks(tmp_path):
    writer = pytest.importorskip("mcap.writer")
    from mcap.exceptions import EndOfFile
    from mcap.records import Message
    from mcap.stream_reader import StreamReader

    path = tmp_path / "live.mcap"

    def messages():
        for number in range(500):
            yield "readings", number, {"newtons": [0.123456789] * 25}
        os.kill(os.getpid(), signal.SIGKILL)

    if not (child := os.fork()):
        with path.open("xb") as file:
            write_messages(writer, {"unit": "N"}, LIVE, file, messages())
    assert os.waitpid(child, 0)[1] == signal.SIGKILL
    records, numbers = StreamReader(BytesIO(path.read_bytes())).records, list[int]()
    with suppress(EndOfFile):  # there is no footer
        numbers.extend(record.log_time for record in records if isinstance(record, Message))
    assert numbers == [*range(len(numbers))]
    assert len(numbers) > 450  # a chunk has 50 of them
