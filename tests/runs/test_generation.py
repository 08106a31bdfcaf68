"""Data sets are generated whole, once, and as a single file would be."""

import pytest
import torch
from hydra import compose, initialize_config_dir

from skin.core.files import CONF
from skin.device.files import DataSet, read_recording
from skin.device.touches import concatenate
from skin.errors import InputError
from skin.runs.build import build_device
from skin.runs.configuration import settings_of, validate_config
from skin.runs.generation import generate_data_set, generate_file

SMALL = ["simulator=naive", "layout=grid", "layout.rows=3", "layout.columns=3", "n=80"]
SMALL += ["touch.leak=0.95"]  # few gestures may have few shapes


def composed(*overrides):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return validate_config(compose("generate", [*SMALL, *overrides]))


def generate(path, *overrides) -> str:
    config = composed(*overrides)
    write = generate_file if path.suffix else generate_data_set
    return write(build_device(config), settings_of(config), path)


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Make shards of 16 gestures."""
    monkeypatch.setattr("skin.device.simulated._BATCH", 8)
    monkeypatch.setattr("skin.device.base._PART", 2)


def contents(folder) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.glob("shards/[!.]*"))}


@pytest.mark.parametrize("stream", ["false", "true"])
def test_shards_are_the_budget(tmp_path, stream):
    said = generate(tmp_path / "touches", f"data.stream={stream}")
    assert said.startswith("80 gestures in 5 shards, ")
    found = DataSet(tmp_path / "touches")
    assert found.counts == [16] * 5
    joined = concatenate([read_recording(found.path(number)) for number in range(5)])
    whole = build_device(composed(f"data.stream={stream}")).recording(complete=False)
    for name in ("readings", "valid", "labels"):
        assert torch.equal(getattr(joined.touches, name), getattr(whole.touches, name))
    assert torch.equal(joined.force, whole.force)
    assert all(torch.equal(values, whole.parameters[name]) for name, values in joined.parameters.items())


def test_the_manifest_tells_where_the_touches_come_from(tmp_path):
    generate(tmp_path, "seed=3")
    found = DataSet(tmp_path).manifest
    assert found["seed"] == found["config"]["device"]["data_seed"] == 3
    assert len(found["source_commit"]) >= 5
    assert found["source_dirty"] in ("true", "false", "unknown")
    assert found["config"]["simulator"]["_target_"] == "skin.mechanics.simulator.naive.Naive"


def test_what_is_there_is_not_drawn_again(tmp_path, monkeypatch, capsys):
    generate(tmp_path)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("shards/*")}
    kept, gone = contents(tmp_path), tmp_path / "shards" / "00002.parquet"
    gone.rename(gone.with_name(".00002.cut_off.parquet"))  # as a killed process leaves it
    drawn = []
    draw = build_device(composed()).parts()[2].make
    with monkeypatch.context() as patch:
        patch.setattr("skin.runs.generation.write_recording", lambda *of: drawn.append(of))
        with pytest.raises(InputError, match=r"1 of 5 shards are missing"):
            generate(tmp_path)
    assert [str(path) for _, path, _ in drawn] == [str(gone)]
    assert torch.equal(drawn[0][0].touches.readings, draw().touches.readings)
    assert "64 of 80 gestures are there already" in capsys.readouterr().err
    generate(tmp_path)
    assert contents(tmp_path) == kept
    assert all(path.stat().st_mtime_ns == time for path, time in before.items() if path != gone)


@pytest.mark.parametrize(
    ("overrides", "commit", "message"),
    [
        (["seed=1"], None, r"was begun with seed=0, not 1; device.data_seed=0, not 1: repeat those settings"),
        (["n=96"], None, r"was begun with device.gestures=80, not 96"),
        (["device.noise=0.1"], None, r"was begun with device.noise=0.05, not 0.1: repeat"),
        ([], "f" * 40, r"was begun by the code of commit \w+, this is f{12}: use"),
    ],
)
def test_other_settings_and_other_code_are_refused(tmp_path, monkeypatch, overrides, commit, message):
    generate(tmp_path)
    (tmp_path / "shards" / "00001.parquet").unlink()
    before = contents(tmp_path)
    if commit:
        other = {"source_commit": commit, "source_dirty": "false"}
        monkeypatch.setattr("skin.runs.generation.source_tags", lambda: other)
    with pytest.raises(InputError, match=message):
        generate(tmp_path, *overrides)
    assert contents(tmp_path) == before


def test_other_folders_and_files_larger_than_memory_are_refused(tmp_path):
    (tmp_path / "mine").write_text("x")
    for path in (tmp_path, tmp_path / "mine"):
        with pytest.raises(InputError, match=r"exists and has no manifest\.json: add out= with a new"):
            generate(path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]
    with pytest.raises(InputError, match=r"n=100000000 in one file needs about .* GB .*: add out=FOLDER"):
        generate(tmp_path / "x.parquet", "n=100000000")


def test_a_recording_becomes_a_data_set(tmp_path):
    generate(tmp_path / "x.parquet")
    said = generate(tmp_path / "touches", "device=recording", f"device.path={tmp_path / 'x.parquet'}")
    assert said.startswith("80 gestures in 1 shards")
    whole, found = build_device(composed()).recording(), read_recording(DataSet(tmp_path / "touches").path(0))
    assert torch.equal(found.touches.readings, whole.touches.readings)
    assert torch.equal(found.parameters["peak"], whole.parameters["peak"])
