"""Models that come with the package: complete, small, unaltered, and as good as their cards say."""

import json
import os
import shutil
import subprocess

import pytest
from hypothesis import given
from hypothesis import strategies as st

import skin
from skin.core.files import ROOT
from skin.core.safe_loading import load_yaml
from skin.errors import InputError
from skin.evaluation.alarm import THRESHOLDS
from skin.evaluation.operating_point import LABEL
from skin.runs.run import CARD, CONFIG, MODELS, RECORD, SUMS, checksums, find_pretrained, is_name, model_card
from tests.damage import DAMAGED_FILES, mutated, opened

NAMES = sorted(path.name for path in (ROOT / MODELS).iterdir())


def record_of(name):
    return json.loads((ROOT / MODELS / name / RECORD).read_text())


@pytest.mark.parametrize("name", NAMES)
def test_a_model_is_one_small_file_of_weights_with_configuration_and_card(name):
    assert "default_skin" in NAMES
    folder, record = ROOT / MODELS / name, record_of(name)
    weights = record["tags"]["learned"]
    thresholds = {THRESHOLDS} if name == "any_skin" else set()  # of the default skin and that of the demo
    assert {path.name for path in folder.iterdir()} == {RECORD, CONFIG, CARD, SUMS, weights} | thresholds
    assert (folder / weights).stat().st_size <= 4e6
    assert (folder / SUMS).read_text() == checksums(folder, weights)
    assert find_pretrained(name).info.run_name == name
    assert not {"tracking", "trust"} & load_yaml(folder / CONFIG).keys()
    assert "process" not in record["tags"]
    for path in folder.iterdir():  # nothing names a folder of the machine of its training
        assert not [each for each in (b"file:/", str(ROOT).encode()) if each in path.read_bytes()], path


@pytest.mark.parametrize("name", NAMES)
def test_a_card_is_generated_and_has_every_metric(name):
    record, config = record_of(name), load_yaml(ROOT / MODELS / name / CONFIG)
    card = (ROOT / MODELS / name / CARD).read_text()
    assert card == model_card(name, record, config)
    for metric in (metric for metric in record["metrics"] if metric.count("/") == 2):
        assert f"| {metric.split('/', 1)[1]} | " in card, metric
    for text in (record["licence"], record["tags"]["source_commit"], "alarm above 0.", "## Not for"):
        assert text in card
    # Its alarm was measured on drawn devices: the recall does not compare with that of one quiet device.
    assert ("means over these devices, quiet and bad ones" in card) == ("## Devices" in card)
    quiet = {key: value for key, value in config["device"].items() if key != "skins"} | {"randomise": False}
    assert "## Devices" not in model_card(name, record, config | {"device": quiet})


@pytest.mark.slow("generates 400 touches for each shipped model")
@pytest.mark.parametrize("name", NAMES)
def test_the_weights_reproduce_the_card_on_400_touches(name, tmp_path):
    """At most a few predictions may differ: those closer to a threshold than processors round."""
    check, trained = record_of(name)["check"], skin.load_run(name, f"sqlite:///{tmp_path}/m.db")
    assert check["touches"] == 400
    assert check["tolerance"] <= 2
    touches = trained.device.touches("test")[slice(400)]
    probabilities = trained.learner.probabilities(touches)
    differ = set()
    for label, expected in check["predictions"].items():
        position = trained.labels.index(LABEL if label == "alarm" else label)
        found = probabilities[:, position] > (trained.point.threshold if label == "alarm" else 0.5)
        differ |= {number for number, bit in enumerate(expected) if bool(found[number]) != (bit == "1")}
        correct = int((found == (touches.labels[:, position] > 0.5)).sum())
        assert abs(correct - check["correct"][label]) <= check["tolerance"], label
    assert len(differ) <= check["tolerance"], differ


@pytest.fixture
def model(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / MODELS / "mine"
    shutil.copytree(ROOT / MODELS / "default_skin", folder)
    (folder / "weights.pt").write_bytes(b"weights")
    (folder / SUMS).write_text(checksums(folder, "weights.pt"))
    return folder


@pytest.mark.parametrize("name", ["weights.pt", CONFIG, RECORD, CARD])
def test_an_altered_or_missing_file_is_refused_by_name(name, model):
    content = bytearray((model / name).read_bytes())
    position = content.index(b"0") if name == RECORD else len(content) // 2
    content[position] = ord("1") if content[position] != ord("1") else ord("2")
    (model / name).write_bytes(content)
    with pytest.raises(InputError, match=rf"^{name} in .*mine differs from {SUMS}: "):
        find_pretrained("mine")
    (model / name).unlink()
    with pytest.raises(InputError, match=name):
        find_pretrained("mine")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (json.dumps({"format": 2}), "has format 2 and this version reads format 1: install"),
        *((text, r"is no (complete )?pretrained model") for text in (
            "", "[]", "{}", '{"format": 1}', '{"format": 1, "tags": {"learned": 3}}')),
    ],
)  # fmt: skip
def test_another_record_and_a_folder_without_hashes_are_refused(text, reason, model):
    (model / SUMS).unlink()
    with pytest.raises(InputError, match=SUMS):
        find_pretrained("mine")
    (model / RECORD).write_text(text)
    with pytest.raises(InputError, match=reason):
        find_pretrained("mine")


@pytest.mark.parametrize("name", ["", "latest", "25aa", "../models/default_skin", "Default", ".hidden"])
def test_what_selects_a_run_or_a_path_is_no_name(name):
    assert not is_name(name)
    assert find_pretrained(name) is None


def test_a_model_is_given_by_its_folder(model, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path / MODELS)
    for name in ("./mine", str(model)):
        assert find_pretrained(name).info.artifact_uri == model.as_uri()
    (model / CONFIG).write_text("")
    with pytest.raises(InputError, match="differs from SHA256SUMS"):
        find_pretrained("./mine")


@pytest.mark.skipif(shutil.which("sha256sum") is None, reason="needs sha256sum")
def test_sha256sum_reads_the_hashes(model):
    command = ["sha256sum", "--check", "--strict", SUMS]
    done = subprocess.run(command, cwd=model, capture_output=True, text=True, check=True)
    assert done.stdout.count(": OK") == 4


def test_a_record_of_somebody_else_works_or_is_refused(model):
    """Its checksums are right, whatever is in it."""
    content = load_yaml(model / RECORD)

    @DAMAGED_FILES
    @given(data=st.data())
    def try_it(data):
        (model / RECORD).write_text(json.dumps(data.draw(mutated(content))))
        (model / SUMS).write_text(checksums(model, "weights.pt"))
        opened(lambda: find_pretrained("mine"))

    try_it()


def test_weights_without_an_end_are_refused(model):
    (model / "weights.pt").unlink()
    os.mkfifo(model / "weights.pt")
    with pytest.raises(InputError, match="no complete pretrained model: it is not a regular file"):
        find_pretrained("mine")
    (model / "weights.pt").unlink()
    (model / "weights.pt").symlink_to("/dev/zero")
    with pytest.raises(InputError, match="it is not a regular file"):
        find_pretrained("mine")
