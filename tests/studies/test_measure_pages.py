"""What was found on streams, read back from its files."""

import pandas as pd
import torch

from experiments.studies.measures import Streams, streams_frame
from experiments.studies.pages import publish_page
from skin.evaluation.operating_point import OperatingPoint
from skin.evaluation.streams import Alarms, Bin, WindowReport

NAMES = ("big", "dynamic", "press", "dangerous")
HALF, MORE, MOST = (dict.fromkeys(NAMES, fraction) for fraction in (0.5, 0.625, 0.9))
FOUND = WindowReport(
    bins=[Bin("0-0.2", 40, HALF, MORE), Bin("whole", 160, MOST, HALF)],
    gates={"threshold": torch.tensor([[90, 10], [20, 180]])},
    threshold=0.31,
    alarms={"none": Alarms(0.5, 3, 8, 7, 9, 1), "threshold": Alarms(0.5, 0, 8, 6, 9, 0)},
    hours=0.6,
    lengths={2.0: 0.8125, 6.0: "made for 30"},
    point=OperatingPoint(0.5, 0.02, 64, 1, 0),
)


def test_the_files_have_what_was_found(tmp_path):
    frame = streams_frame(FOUND)
    about = frame.attrs["about"]
    assert about.startswith("gate none: 6.0 (1.2")
    assert "7 of 8 dangerous touches and 1 of 9 safe ones raised the alarm" in about
    page, table = publish_page(Streams().page(frame, "rules"), "rules fem 0", tmp_path / "stream_rules")
    text = page.read_text()
    rows = ["press | 0.5000 | 0.9000", " | 40 | 160", "threshold | 180", "overall | 0.8125 | made for 30"]
    assert all(f"| {row} |" in text for row in rows)
    assert text.startswith("# rules fem 0\n\ngate none")
    values = pd.read_csv(table, dtype=str, keep_default_na=False).set_index(["measure", "name", "at"]).value
    assert values["accuracy", "press", "whole"] == "0.9000"
    assert values["idle said touched", "threshold", ""] == "10"
    assert values["alarms false", "none", ""] == "3"
    assert values["window, s", "overall", "6"] == "made for 30"
    assert {*tmp_path.iterdir()} == {page, table}
