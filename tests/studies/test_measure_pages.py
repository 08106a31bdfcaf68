"""What was found on streams, read back from its files."""

import csv

import pytest
import torch
from PIL import Image

from experiments.studies.measures import Streams, streams_frame
from experiments.studies.pages import publish_page
from skin.evaluation.operating_point import OperatingPoint
from skin.evaluation.streams import Alarms, Bin, WindowReport

NAMES = ("big", "dynamic", "press", "dangerous")
FOUND = WindowReport(
    bins=[
        Bin("0-0.2", 40, dict.fromkeys(NAMES, 0.5), dict.fromkeys(NAMES, 0.625)),
        Bin("whole", 160, dict.fromkeys(NAMES, 0.9), dict.fromkeys(NAMES, 0.5)),
    ],
    gates={"threshold": torch.tensor([[90, 10], [20, 180]])},
    threshold=0.31,
    alarms={"none": Alarms(0.5, 3, 8, 7, 9, 1), "threshold": Alarms(0.5, 0, 8, 6, 9, 0)},
    hours=0.6,
    lengths={2.0: 0.8125, 6.0: "made for 30"},
    streamed=False,
    point=OperatingPoint(0.5, 0.02, 64, 1, 0),
)


def test_the_line_says_what_matters():
    about = streams_frame(FOUND).attrs["about"]
    assert about.startswith(
        "accuracy 50.0 % at share 0-0.2; accuracy 90.0 % at share whole; gate none: 6.0 (1.2"
    )
    assert "7 of 8 dangerous touches and 1 of 9 safe ones raised the alarm" in about


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return publish_page(
        Streams().page(streams_frame(FOUND), "rules fem 0"),
        "rules fem 0",
        tmp_path_factory.mktemp("results") / "stream_rules",
    )


def test_a_person_reads_the_same(files):
    text = files[0].read_text()
    rows = ["press | 0.5000 | 0.9000", " | 40 | 160", "threshold | 180", "overall | 0.8125 | made for 30"]
    assert all(f"| {row} |" in text for row in rows)
    assert text.startswith("# rules fem 0\n\naccuracy 50.0 %")
    assert "trained on whole touches" in text


def test_a_program_reads_the_same(files):
    with files[1].open(newline="") as file:
        values = {(one["measure"], one["name"], one["at"]): one["value"] for one in csv.DictReader(file)}
    assert values["accuracy", "press", "whole"] == "0.9000"
    assert values["idle said touched", "threshold", ""] == "10"
    assert values["alarms false", "none", ""] == "3"
    assert values["window, s", "overall", "6"] == "made for 30"


def test_the_picture_is_whole(files):
    with Image.open(files[2]) as picture:
        picture.load()
        assert picture.width > 600
    assert sorted(path.name for path in files[2].parent.iterdir()) == sorted(path.name for path in files)
