"""Recordings and data sets in files: equal to the last bit, or refused by name."""

import json
import os
from dataclasses import replace
from functools import partial
from pathlib import Path

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from skin import InputError, read_recording
from skin.body.layout import Scattered
from skin.core.safe_loading import limited_memory
from skin.device.files import DataSet, describe_recording, read_description, write_manifest, write_recording
from skin.device.touches import Recording, Touches, concatenate
from skin.touch.labels import TOUCH, Task
from tests.damage import DAMAGED_FILES, damaged, opened
from tests.made_up import naive_skin

BATCH, TIME, SENSORS = 7, 5, 3


def recording(**changes) -> Recording:
    generator = torch.Generator().manual_seed(0)
    # From 1e-10 to 1e10: a file that rounds would show it.
    readings = torch.randn(BATCH, TIME, SENSORS, generator=generator) * 10 ** torch.linspace(-10, 10, SENSORS)
    valid = torch.ones(BATCH, TIME, SENSORS, dtype=torch.bool)
    valid[2, 1, 0], readings[2, 1, 0] = False, 0.0
    positions = torch.rand(SENSORS, 3, generator=generator)
    labels = (torch.rand(BATCH, 4, generator=generator) > 0.5).float()
    parts = {"touches": Touches(readings, valid, positions, labels, 12.5), "task": TOUCH}
    parts |= {"size": (0.16, 0.1), "footprint": (0.01, 0.02), "metadata": {"seed": 3, "note": "ü"}}
    parts |= {"force": torch.rand(BATCH, TIME, generator=generator)}
    parts |= {"displacement": torch.rand(BATCH, TIME, SENSORS, 2, generator=generator)}
    parts |= {"parameters": {"force": torch.rand(BATCH), "speed": torch.rand(BATCH)}}
    return Recording(**(parts | changes))


def same(one, other) -> bool:
    if isinstance(one, torch.Tensor):
        return torch.equal(one, other) and one.dtype == other.dtype
    if isinstance(one, dict):
        return list(one) == list(other) and all(same(one[key], other[key]) for key in one)
    if isinstance(one, Recording | Touches):
        return same(vars(one), vars(other))
    return one == other


def variants() -> dict[str, Recording]:
    full, task = recording(), Task(("dynamic", "cos", "sin"), direction=True)
    labels = torch.cat([torch.rand(BATCH, 1).round(), torch.rand(BATCH, 2) - 0.5], 1)
    return {
        "full": full,
        "readings only": recording(force=None, displacement=None, parameters={}, metadata={}),
        "unlabelled": replace(full, touches=replace(full.touches, labels=None)),
        "direction": replace(full, task=task, touches=replace(full.touches, labels=labels)),
    }


@pytest.mark.parametrize("variant", variants())
def test_reads_back_equal(tmp_path, variant):
    kept = variants()[variant]
    assert same(read_recording(write_recording(kept, tmp_path / "x.parquet")), kept)


@pytest.mark.parametrize("suffix", ["parquet", "csv"])
def test_rows_are_the_reports(tmp_path, suffix):
    """Read without this project's code."""
    kept = recording()
    path = write_recording(kept, tmp_path / f"x.{suffix}", first=5000)
    table = pa.csv.read_csv(path) if suffix == "csv" else pq.read_table(path)
    readings = [f"reading_0{number}" for number in range(SENSORS)]
    moves = [f"{name}_0{number}" for name in ("D_s", "D_t") for number in range(SENSORS)]
    ids = ["simulation", "frame", *TOUCH.names]
    assert table.column_names == [*ids, *readings, "force", *moves, "gesture_force", "gesture_speed"]
    row = table.slice(4 * TIME + 3, 1).to_pylist()[0]
    assert (row["simulation"], row["frame"]) == (5004, 3)
    assert [row[name] for name in TOUCH.names] == kept.touches.labels[4].tolist()
    assert row["reading_02"] == pytest.approx(float(kept.touches.readings[4, 3, 2]))
    assert row["D_t_01"] == pytest.approx(float(kept.displacement[4, 3, 1, 1]))
    assert table["reading_00"][2 * TIME + 1].as_py() is None
    if suffix == "parquet":
        about = json.loads(pq.read_schema(path).metadata[b"skin"])
        assert about["units"]["reading"] == "N"
        assert about["positions"] == kept.touches.positions.tolist()
        assert (about["metadata"]["seed"], read_description(path)["first"]) == (3, 5000)
        assert same(read_recording(path), kept)


def test_a_failed_write_leaves_what_was_there(tmp_path, monkeypatch):
    path = write_recording(recording(), tmp_path / "x.parquet")
    before = path.read_bytes()

    def fail(table, partial, **options):
        partial.write_bytes(b"half")
        raise OSError("disk full")

    monkeypatch.setattr("skin.device.files.write_parquet", fail)
    with pytest.raises(InputError, match=r"cannot write .*disk full"):
        write_recording(recording(force=None), path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_files_that_are_no_recordings_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"no recording .*x.parquet: skin generate"):
        read_recording(tmp_path / "x.parquet")
    with pytest.raises(InputError, match=r"a recording is a \.parquet or \.csv file, got x.txt"):
        write_recording(recording(), tmp_path / "x.txt")
    with pytest.raises(InputError, match=r"s\.csv is a table without layout and rate: give \S+s\.parquet"):
        read_recording(tmp_path / "s.csv")  # also a session of skin record
    pq.write_table(pa.table({"a": [1]}), tmp_path / "z.parquet")
    with pytest.raises(InputError, match=r"z.parquet is damaged or no recording .* its schema has no units"):
        read_recording(tmp_path / "z.parquet")
    path = write_recording(recording(), tmp_path / "cut.parquet")
    os.truncate(path, 1000)
    with pytest.raises(InputError, match=r"cut.parquet is damaged"):
        read_recording(path)


def changed(path: Path, change=None, rows=None) -> Path:
    table = pq.read_table(path)
    about = json.loads(table.schema.metadata[b"skin"])
    text = json.dumps(change(about) if change else about)
    table = table if rows is None else table.take(rows)
    pq.write_table(table.replace_schema_metadata({"skin": text}), path)
    return path


@pytest.mark.parametrize(
    ("change", "rows", "message"),
    [
        (None, [*range(34)], r"34 rows, not 7 touches of 5 frames"),
        (None, [*range(7), 8, 7, *range(9, 35)], r"row 8: frame is 3, expected 2"),
        (lambda about: about | {"parameters": ["force", "size"]}, None, r"no recording.*gesture_size"),
        (lambda about: about | {"units": {"reading": "kgf"}}, None, r"has the units .*kgf"),
        (lambda about: about | {"format": 2}, None, r"has format 2, this version reads format 1"),
        (lambda about: about | {"gestures": 0}, None, r"description.gestures=0 must be greater than or equ"),
    ],
)
def test_other_rows_or_units_are_refused(tmp_path, change, rows, message):
    path = changed(write_recording(recording(), tmp_path / "x.parquet"), change, rows)
    with pytest.raises(InputError, match=message):
        read_recording(path)


def test_recordings_from_before_directions_are_read(tmp_path):
    path = write_recording(kept := recording(), tmp_path / "x.parquet")
    task = lambda about: {name: value for name, value in about["task"].items() if name != "direction"}  # noqa: E731
    assert same(read_recording(changed(path, lambda about: about | {"task": task(about)})), kept)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    return write_recording(recording(parameters={}), tmp_path_factory.mktemp("recording") / "x.parquet")


@DAMAGED_FILES
@given(data=st.data())
def test_damage_never_passes_for_readings(written, data):
    path = written.with_name("damaged.parquet")
    path.write_bytes(data.draw(damaged(written.read_bytes())))
    with limited_memory(1 << 30):
        known = opened(lambda: read_recording(path))
    assert known is None or same(known, recording(parameters={}))


@pytest.fixture(scope="module")
def whole():
    return naive_skin(layout=Scattered(seed=0), gestures=50).recording()


def write_data_set(recording: Recording, folder: Path, counts: tuple[int, ...] = (20, 20, 10)) -> Path:
    source = {"seed": 0, "source_commit": "a", "source_dirty": "false", "config_hash": "1", "config": {}}
    write_manifest(folder, describe_recording(recording), counts, **source)
    data_set = DataSet(folder, complete=False)
    for number, (first, count) in enumerate(zip(data_set.firsts, counts, strict=True)):
        shard = replace(recording[first : first + count], metadata={"config_hash": "1", "summary": {}})
        write_recording(shard, data_set.path(number), first)
    return folder


@pytest.fixture
def folder(whole, tmp_path) -> Path:
    """Return a data set of shards of 20, 20 and 10 gestures."""
    return write_data_set(whole, tmp_path / "touches")


def test_shards_are_the_whole(folder, whole):
    found = DataSet(folder)
    assert found.counts == [20, 20, 10]
    joined = concatenate([read_recording(found.path(n)) for n in range(3)])
    assert same(joined.touches, replace(whole.touches, geometry=None))
    part = read_recording(found.path(1), complete=False)
    assert (part.force, part.displacement, part.parameters) == (None, None, {})
    about = json.loads((folder / "manifest.json").read_text())
    tables = [pq.read_table(path) for path in sorted(folder.glob("shards/*"))]
    assert about["columns"] == {field.name: str(field.type) for field in tables[0].schema}
    assert (about["units"]["reading"], about["version"]) == ("N", 1)
    assert (about["gestures"], about["frames"], about["rate"]) == (50, 30, 10.0)
    assert [n for table in tables for n in table["simulation"].unique().to_pylist()] == list(range(50))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": 2}, r"has version 2, not 1: use the version of this program that wrote it"),
        ({"shards": [20, 30]}, r"00001.parquet is not the shard that manifest.json describes: delete it"),
        ({"gestures": 51}, r"has gestures 51, not 50"),
        ({"units": {"reading": "kgf"}}, r"has units {'reading': 'kgf'}, not"),
        ({"config_hash": "456"}, r"00000.parquet is not the shard"),
    ],
)
def test_another_manifest_is_refused(folder, changes, message):
    path = folder / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    with pytest.raises(InputError, match=message) as refused:
        DataSet(folder)
    assert "\n" not in str(refused.value)


def exchange(path: Path) -> None:
    other = path.with_name("00001.parquet")
    path.rename(path.with_name("x"))
    other.rename(path)
    path.with_name("x").rename(other)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("manifest.json", Path.unlink, r"touches is no data set, because it has no manifest.json: give"),
        *(
            ("manifest.json", partial(Path.write_text, data=text), r"manifest.json")
            for text in ("", "{", "[]", "3", "null")
        ),
        ("shards/00001.parquet", Path.unlink, r"1 of 3 shards are missing, as 00001.parquet is: repeat"),
        ("shards/00002.parquet", lambda path: os.truncate(path, 1000), r"2.parquet is damaged .*: delete it"),
        ("shards/00000.parquet", exchange, r"00000.parquet is not the shard"),
    ],
)
def test_a_damaged_data_set_is_refused_before_anything_is_read(folder, name, change, message):
    change(folder / name)
    with pytest.raises(InputError, match=message):
        DataSet(folder)
