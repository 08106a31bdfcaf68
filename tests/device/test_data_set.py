"""A data set is complete and of one piece, or refused by name."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import torch

from skin.body.layout import Scattered
from skin.body.sheet import Sheet
from skin.device.files import DataSet, Manifest, describe_recording, write_recording
from skin.device.simulated import Simulated
from skin.device.touches import concatenate
from skin.errors import InputError
from skin.mechanics.simulator.naive import Naive

SOURCE = {"seed": 0, "source_commit": "abc", "source_dirty": "false", "config_hash": "123", "config": {}}
BODY = Sheet([0.16, 0.16], [16, 16], [{"material": "EcoFlex 00-30", "thickness": 0.005}])


@pytest.fixture(scope="module")
def budget():
    device = Simulated(body=BODY, layout=Scattered(seed=0), simulator=Naive, gestures=50)
    return device.recording(complete=False)


@pytest.fixture
def folder(budget, tmp_path) -> Path:
    """Return a data set of shards of 20, 20 and 10 gestures."""
    position, counts = tmp_path / "touches", [20, 20, 10]
    manifest = Manifest.of(describe_recording(budget), counts, **SOURCE)
    manifest.write(position)
    for number, first in enumerate(manifest.firsts):
        shard = replace(budget[first : first + counts[number]], metadata={"config_hash": "123"})
        write_recording(shard, manifest.path(position, number), first)
    return position


def altered(folder: Path, **changes) -> Path:
    path = folder / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    return folder


def test_shards_are_the_whole(folder, budget):
    found = DataSet(folder)
    assert found.counts == [20, 20, 10]
    joined = concatenate([found.read(number) for number in range(3)])
    assert torch.equal(joined.touches.readings, budget.touches.readings)
    assert torch.equal(joined.touches.labels, budget.touches.labels)
    assert torch.equal(joined.parameters["peak"], budget.parameters["peak"])
    assert found.read(1, complete=False).parameters == {}


def test_the_manifest_tells_columns_units_and_source(folder):
    about = json.loads((folder / "manifest.json").read_text())
    tables = [pq.read_table(path) for path in sorted(folder.glob("shards/*"))]
    assert about["columns"] == {field.name: str(field.type) for field in tables[0].schema}
    assert about["units"]["reading"] == "N"
    assert about["version"] == 1
    assert (about["gestures"], about["frames"], about["rate"]) == (50, 30, 10.0)
    assert (about["seed"], about["source_commit"]) == (0, "abc")
    assert [n for table in tables for n in table["simulation"].unique().to_pylist()] == list(range(50))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": 2}, r"has schema version 2, this program reads version 1: use the program"),
        ({"version": None}, r"version=None must be"),
        ({"shards": [20, 30]}, r"00001.parquet is not the shard that manifest.json describes: delete it"),
        ({"shards": []}, r"manifest.json.shards=\[\]"),
        ({"gestures": 51}, r"its units or counts are not those that were written"),
        ({"units": {"reading": "kgf"}}, r"its units or counts are not those that were written"),
        ({"config_hash": "456"}, r"00000.parquet is not the shard"),
        ({"other": 1}, r"has no setting other"),
    ],
)
def test_another_manifest_is_refused(folder, changes, message):
    with pytest.raises(InputError, match=message) as refused:
        DataSet(altered(folder, **changes))
    assert "\n" not in str(refused.value)


def remove(path: Path) -> None:
    path.unlink()


def cut_off(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


def exchange(path: Path) -> None:
    other = path.with_name("00001.parquet")
    content = path.read_bytes()
    path.write_bytes(other.read_bytes())
    other.write_bytes(content)


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("manifest.json", remove, r"touches is no data set, because it has no manifest.json: give"),
        *(
            ("manifest.json", partial(Path.write_text, data=text), r"manifest.json")
            for text in ("", "{", "[]", "3", "null")
        ),
        ("shards/00001.parquet", remove, r"1 of 3 shards are missing, as 00001.parquet is: repeat"),
        ("shards/00002.parquet", cut_off, r"00002.parquet is damaged .*: delete it, and repeat"),
        ("shards/00000.parquet", exchange, r"00000.parquet is not the shard"),
    ],
)
def test_a_damaged_data_set_is_refused_before_anything_is_read(folder, name, change, message):
    change(folder / name)
    with pytest.raises(InputError, match=message):
        DataSet(folder)


def test_damaged_rows_are_refused_when_they_are_read(folder):
    flip(folder / "shards" / "00002.parquet")
    with pytest.raises(InputError, match=r"00002.parquet is damaged .*: delete it, and repeat"):
        DataSet(folder).read(2)
