"""The lines of docs/data.md read a data set; each library finds the same in it."""

import re

import pytest
import torch
from hydra import compose, initialize_config_dir

from skin.core.files import CONF, ROOT
from skin.device.files import DataSet, read_recording
from skin.runs.build import build_device
from skin.runs.configuration import settings_of, validate_config
from skin.runs.generation import generate_data_set

PAGE = (ROOT / "docs" / "data.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, re.S)
LINES = {re.search(r"import (\w+)", block)[1]: block for block in BLOCKS}


@pytest.fixture(scope="module")
def position(tmp_path_factory):
    position = tmp_path_factory.mktemp("data")
    with initialize_config_dir(str(CONF), version_base="1.3"), pytest.MonkeyPatch.context() as patch:
        patch.setattr("skin.device.simulated._BATCH", 16)
        patch.setattr("skin.device.base._PART", 1)
        config = validate_config(compose("generate", ["simulator=naive", "n=48", "device.dead=1"]))
        generate_data_set(build_device(config), settings_of(config), position / "touches")
    return position


def peaks(folder) -> dict[int, float]:
    """Return the highest first reading of each dangerous gesture, by its number."""
    data, found = DataSet(folder), {}
    for number, first in enumerate(data.firsts):
        shard = read_recording(data.path(number))
        dangerous = shard.touches.labels[:, shard.task.names.index("dangerous")] == 1
        for row in torch.nonzero(dangerous).flatten().tolist():
            found[first + row] = float(shard.touches.readings[row, :, 0].max())
    return found


@pytest.mark.parametrize("library", sorted(LINES))
def test_a_library_reads_a_data_set_by_the_lines_of_the_page(library, position, monkeypatch):
    pytest.importorskip(library)
    monkeypatch.chdir(position)
    names = {}
    exec(LINES[library], names)
    found = names["peaks"]
    if library == "pandas":
        found = found.to_dict()
    else:
        found = dict(zip(found["simulation"].to_list(), found["reading_00"].to_list(), strict=True))
    expected = peaks(position / "touches")
    assert 10 < len(expected) < 48
    assert list(found) == sorted(expected)
    assert found == expected


def first_column(table: str) -> list[str]:
    """Return what is in code in the first column of a table."""
    return re.findall(r"`(\w+)`", " ".join(row.split("|")[1] for row in table.splitlines() if "|" in row))


def test_the_page_names_the_keys_of_the_manifest_and_the_columns(position):
    table = PAGE[PAGE.index("| key |") : PAGE.index("`touches/shards/00000.parquet` and so on")]
    named = first_column(table)
    assert sorted(named) == sorted(DataSet(position / "touches").manifest)
    table = PAGE[PAGE.index("| column |") : PAGE.index("## Training")]
    named = first_column(table)
    known = DataSet(position / "touches").manifest["columns"]
    assert {name for name in named if not name.endswith("_")} <= set(known)
    own = {name for name in known if not name.startswith(("reading_", "saturated_", "gesture_"))}
    assert own <= set(named)
