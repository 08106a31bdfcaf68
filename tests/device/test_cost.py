"""CoST on files in its exact format: what is yielded is what was written, and nobody is in two splits."""

import csv
import sqlite3
from itertools import combinations, product
from pathlib import Path

import numpy as np
import pytest
import torch

from skin.device.cost import GESTURES, VARIANTS, Cost
from skin.errors import InputError
from skin.runs.build import build_data, build_device, build_learner
from skin.runs.configuration import validate_config

SUBJECTS = (1, 2, 3, 5, 8, 13, 21, 31)
HEADER = "subject, variant, gesture, frame, " + ", ".join(f"ch{number}" for number in range(1, 65))
DOI = "10.4121/uuid:5ef62345-3b3e-479c-8e1d-c922748c9b29"
SPLITS = ("train", "validation", "holdout", "test")


def write(path: Path, gestures, repetitions: int, longest: int) -> Path:
    """Write captures in the format of CoST.csv; channels 62 to 64 hold gesture, variant and subject.

    A gesture presses a place and beats in a rhythm of its own, a rougher one presses harder.
    """
    random = np.random.default_rng(0)
    lines = [HEADER]
    channel = np.arange(64)
    for subject, variant, gesture in product(SUBJECTS, (1, 2, 3), gestures):
        for _ in range(repetitions):
            frames = int(random.integers(10, longest))
            time = np.linspace(0, 1, frames)[:, None]
            beat = np.sin(np.pi * (1 + gesture % 3) * time) ** 2
            place = np.exp(
                -((channel % 8 - 1 - gesture % 6) ** 2 + (channel // 8 - 1 - gesture // 3) ** 2) / 3
            )
            counts = 250 * variant * beat * place + random.normal(20, 5, (frames, 64))
            counts[:, 61:] = 10 * gesture, 100 * variant, 20 * subject
            head = f"{subject},{variant},{gesture}"
            for number, row in enumerate(counts.clip(0, 1023).astype(int).tolist(), start=1):
                lines.append(f"{head},{number}," + ",".join(map(str, row)))
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="module")
def corpus(tmp_path_factory) -> Path:
    """Return a file of all gestures."""
    return write(tmp_path_factory.mktemp("corpus") / "CoST.csv", range(1, 15), repetitions=2, longest=100)


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> Path:
    """Return a file of the report's gestures, with enough captures to learn from."""
    return write(tmp_path_factory.mktemp("report") / "CoST.csv", (1, 2), repetitions=10, longest=20)


def cost(path: Path, **settings) -> Cost:
    return Cost(path=str(path), strict=False, **settings)


def decoded(touches, channel: int) -> np.ndarray:
    """Return the number that a channel from 62 to 64 holds, (B,)."""
    counts = touches.readings[:, :, channel - 1].numpy() * 1023 / 10
    assert np.allclose(counts, counts[:, :1], atol=1e-3)
    return np.rint(counts[:, 0] / {62: 10, 63: 100, 64: 20}[channel]).astype(int)


def test_every_capture_is_resampled_as_numpy_does(corpus):
    captures: list[list[list[int]]] = []
    with corpus.open() as file:
        for row in list(csv.reader(file))[1:]:
            numbers = [int(text) for text in row]
            if numbers[3] == 1:
                captures.append([])
            captures[-1].append(numbers)
    device = cost(corpus, gestures="all", window=17)
    found = torch.cat([device.touches(split).readings for split in SPLITS]).numpy()
    expected = []
    for capture in map(np.array, captures):
        old, new = np.linspace(0, 1, len(capture)), np.linspace(0, 1, 17)
        expected.append([np.interp(new, old, column) for column in capture[:, 4:].T])
    expected = np.array(expected).transpose(0, 2, 1) * 10 / 1023
    keys = [np.lexsort(values.reshape(len(values), -1)[:, ::37].round(3).T) for values in (found, expected)]
    assert np.allclose(found[keys[0]], expected[keys[1]], atol=1e-4)


def test_nobody_is_in_two_splits(corpus):
    device = cost(corpus, gestures="all")
    parts = {split: set(decoded(device.touches(split), 64)) for split in SPLITS}
    assert {split: sorted(part) for split, part in parts.items()} == device.subjects
    assert set().union(*parts.values()) == set(SUBJECTS)
    assert all(not one & other for one, other in combinations(parts.values(), 2))
    assert [len(parts[split]) for split in SPLITS] == [4, 1, 1, 2]


def test_the_splits_are_drawn_from_their_seed(corpus):
    one, same, other = (cost(corpus, split_seed=seed).subjects for seed in (0, 0, 1))
    assert one == same != other


def test_chosen_subjects_are_the_test(corpus):
    for given, test in ((13, [13]), ([31, 2], [2, 31])):
        device = cost(corpus, test_subjects=given)
        assert device.subjects["test"] == test
        assert set(decoded(device.touches("test"), 64)) == set(test)
        assert sum(len(part) for part in device.subjects.values()) == len(SUBJECTS)


@pytest.mark.parametrize(
    ("gestures", "variants", "names"),
    [
        (
            "report",
            None,
            [f"{name}_{how}" for name in ("grab", "hit") for how in ("gentle", "normal", "rough")],
        ),
        ("report", False, ["grab", "hit"]),
        ("all", None, list(GESTURES)),
        (["tap", "massage"], None, ["tap", "massage"]),
        ("poke", True, ["poke_gentle", "poke_normal", "poke_rough"]),
    ],
)
def test_classes_are_named_and_numbered_as_the_file_means_them(corpus, gestures, variants, names):
    device = cost(corpus, gestures=gestures, variants=variants)
    assert (list(device.task.names), device.task.kind) == (names, "exclusive")
    for split in SPLITS:
        touches = device.touches(split)
        assert torch.equal(touches.labels.sum(1), torch.ones(len(touches)))
        for gesture, variant, label in zip(
            decoded(touches, 62), decoded(touches, 63), touches.labels.argmax(1).tolist(), strict=True
        ):
            words = [GESTURES[gesture - 1], VARIANTS[variant - 1]]
            assert "_".join(words[: 1 + ("_" in names[0])]) == names[label]


def test_touches_have_the_form_of_every_device(corpus):
    device = cost(corpus, full_scale=2.0)
    touches = device.touches("train")
    assert touches.readings.shape == (4 * 2 * 3 * 2, 30, 64)
    assert touches.readings.dtype == touches.labels.dtype == torch.float32
    assert touches.valid.all()
    assert 0 <= touches.readings.min() < touches.readings.max() <= 2.0
    assert device.size == pytest.approx((0.16, 0.16))
    assert torch.equal(touches.readings, device.touches("train", epoch=3).readings)
    assert touches.rate == device.rate


def test_the_rate_is_that_of_the_median_capture(tmp_path):
    path = write(tmp_path / "CoST.csv", (1, 2), repetitions=1, longest=11)  # 10 frames each
    assert cost(path, window=19).rate == pytest.approx(2 * 135)


def test_a_list_of_taxels_is_a_list_of_channels(corpus):
    whole = cost(corpus).touches("test")
    part = cost(corpus, taxels=[64, 1, 8, 57])
    touches = part.touches("test")
    assert torch.equal(touches.readings, whole.readings[:, :, [0, 7, 56, 63]])
    corners = [[0.01, 0.01, 0], [0.15, 0.01, 0], [0.01, 0.15, 0], [0.15, 0.15, 0]]
    assert part.sensors.positions == pytest.approx(np.array(corners))
    assert np.allclose(touches.positions, corners)


def test_a_number_of_taxels_is_spread_evenly(corpus):
    random = np.random.default_rng(0)

    def closest(places: np.ndarray) -> float:
        return min(np.linalg.norm(one - other) for one, other in combinations(places, 2))

    every = cost(corpus).sensors.positions
    at_random = max(closest(every[random.choice(64, 12, replace=False)]) for _ in range(300))
    views = [cost(corpus, taxels=12, taxel_seed=seed).sensors.positions for seed in (0, 1)]
    assert all(closest(view) > at_random for view in views)
    assert not np.array_equal(*views)
    assert np.array_equal(views[0], cost(corpus, taxels=12).sensors.positions)


def changed(line: int, column: int, value: str):
    """Return a change of one number in a file's lines, counted from 1 with the header."""

    def change(lines: list[str]) -> list[str]:
        row = lines[line - 1].split(",")
        row[column] = value
        return [*lines[: line - 1], ",".join(row), *lines[line:]]

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda lines: [], "No columns to parse"),
        (lambda lines: lines[:1], "has no rows"),
        (changed(1, 2, " Gesture"), "has no column gesture, which classes names"),
        (changed(1, 67, " ch65"), "has no column ch64, which channels.columns names"),
        (changed(9, 67, "5,5"), "Expected 68 fields in line 9, saw 69"),
        (changed(9, 10, "x"), "column ch7 has 'x' in row 8, no number"),
    ],
)
def test_an_altered_file_is_refused(report, tmp_path, change, message):
    path = tmp_path / "CoST.csv"
    path.write_text("\n".join(change(report.read_text().splitlines())))
    with pytest.raises(InputError, match=message) as refused:
        cost(path)
    assert DOI in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_missing_value_is_an_invalid_reading(report, tmp_path):
    path = tmp_path / "CoST.csv"
    path.write_text("\n".join(changed(9, 10, "")(report.read_text().splitlines())))
    valid = torch.cat([cost(path).touches(split).valid for split in SPLITS])
    assert (~valid).any(dim=(0, 1)).nonzero().flatten().tolist() == [6]


def test_a_part_of_the_corpus_must_be_asked_for(report, tmp_path):
    with pytest.raises(InputError, match=r"has 480 captures, .* has 7805: add device.strict=false"):
        Cost(path=str(report))
    for path in (None, str(tmp_path / "none.csv"), str(tmp_path)):
        with pytest.raises(InputError, match=DOI):
            Cost(path=path)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"gestures": "kick"}, "device.gestures must be report, all or some of grab, hit.*got kick"),
        ({"gestures": ["tap"]}, "a single class: add device.variants=true"),
        ({"gestures": ["tap", "poke"]}, "fewer than two of the classes tap, poke"),
        ({"taxels": 65}, "device.taxels=65 must be less than or equal to 64"),
        ({"taxels": [0, 1]}, "device.taxels=.* must be greater than or equal to 1"),
        ({"taxels": [1, 1]}, "device.taxels must be different whole numbers"),
        ({"test_subjects": 4}, r"device.test_subjects names \[4\].*has the subjects \[1, 2, 3, 5"),
        ({"test_subjects": list(SUBJECTS[:6])}, "leave none to train on"),
        ({"window": 1}, "device.window=1 must be greater than or equal to 2"),
        ({"full_scale": 0.0}, "device.full_scale=0.0 must be greater than 0"),
    ],
)
def test_settings_that_cannot_be_used_are_refused(report, settings, message):
    with pytest.raises(InputError, match=message):
        cost(report, **settings)


def overrides(path: Path | str) -> list[str]:
    return ["device=cost", f"device.path={path}", "device.strict=false", "device.variants=false"]


@pytest.mark.parametrize(
    ("row", "setting"),
    [
        ("features", "learner.rounds=40"),
        ("temporal_graph", "trainer.max_epochs=6"),
        ("sequence_graph", "trainer.max_epochs=1"),
        ("linked_graph", "trainer.max_epochs=1"),
        ("sequence_image", "trainer.max_epochs=1"),
    ],
)
def test_rows_learn_from_a_sparse_view(configured, report, row, setting):
    config = validate_config(
        configured(
            f"experiment={row}",
            *overrides(report),
            "device.taxels=9",
            "data.batch_size=32",
            setting,
        )
    )
    device = build_device(config)
    learner = build_learner(config)
    learner.fit(build_data(config, device))
    test = device.touches("test")
    chances = learner.probabilities(test)
    assert torch.allclose(chances.sum(1), torch.ones(len(test)), atol=1e-5)
    if row in ("features", "temporal_graph"):
        assert (chances.argmax(1) == test.labels.argmax(1)).float().mean() > 0.9


def test_rules_say_that_they_know_other_labels(configured, report):
    config = configured("experiment=rules", *overrides(report))
    with pytest.raises(InputError, match=r"learner=rules knows the labels big.*got grab, hit"):
        build_learner(config).fit(build_data(config, build_device(config)))


@pytest.mark.slow("trains a network on a data set")
def test_the_command_trains_a_network_on_it(run, report, tmp_path, monkeypatch):
    settings = ["experiment=temporal_graph", "trainer.max_epochs=6", "data.batch_size=32"]
    monkeypatch.setenv("HOME", str(report.parent))
    done = run(tmp_path, "train.py", *settings, *overrides("~/CoST.csv"))
    assert done.returncode == 0, done.stderr
    database = sqlite3.connect(tmp_path / "m.db")
    tags, params, metrics = (
        dict(database.execute(f"select key, value from {table}"))
        for table in ("tags", "params", "latest_metrics")
    )
    database.close()
    assert tags["simulator"] == "cost"
    assert tags["mlflow.runName"].startswith("temporal_graph cost max_epochs=6 batch_size=32 device=cost")
    assert tags["mlflow.runName"].endswith("seed 0")
    assert params["device"] == "cost"
    assert {"simulator", "gestures"}.isdisjoint(params)
    assert {name.split("/")[0] for name in metrics if "/" in name} == {"same", "holdout"}
    assert metrics["same/overall/accuracy"] > 0.9
    assert f"{100 * metrics['same/overall/accuracy']:.1f}" in done.stdout


@pytest.mark.slow("imports all libraries anew")
def test_without_the_file_a_command_says_where_it_is(run, tmp_path):
    done = run(tmp_path, "generate.py", "device=cost", f"out={tmp_path}/x.parquet", store=False)
    assert done.returncode == 2, done.stderr
    assert DOI in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert {path.name for path in tmp_path.iterdir()} <= {"outputs"}  # Hydra's notes
