"""The command on dead sensors: pairs of trainings with a mask and without."""

import csv

import pytest

from studies.dead import publish
from studies.moving_runs import Trial

SMALL = ["data.gestures=80", "trainer.max_epochs=1", "device.test_gestures=48", "evaluation.devices=0"]
SMALL += ["evaluation.layouts=0", "evaluation.safe_gestures=64", "layout=grid"]


@pytest.mark.slow
def test_masks_are_compared_over_the_same_sensors(run, tmp_path):
    pair = ["-m", "experiment=temporal_graph", "row=dead", "representation.mask=true,false"]
    done = run(tmp_path, "train.py", *pair, "device.dead=[1,2]", "device.randomise=true", *SMALL)
    assert done.returncode == 0, done.stderr
    done = run(tmp_path, "dead.py", "out=found", "dead.counts=[0,3]", "dead.devices=2", "dead.gestures=48")
    assert done.returncode == 0, done.stderr
    with (tmp_path / "found" / "dead.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    conditions = ["0 of 25 dead", "3 of 25 dead"] * 2 + ["no mask", "mask"] * 2
    assert [line["condition"] for line in lines] == conditions
    assert {line["row"] for line in lines[:2]} == {"dead, mask, trained with 1 to 2 dead"} or {
        line["row"] for line in lines[:2]
    } == {"dead, trained with 1 to 2 dead"}
    assert all(25 < float(line["accuracy"].split()[0]) < 95 for line in lines)
    assert all(line["verdict"] in ("", "undecided") for line in lines)
    done = run(tmp_path, "dead.py", "rows=[gru]")
    assert done.returncode == 2
    assert "no finished run of gru" in done.stderr


def test_differences_are_paired_by_device_and_masks_by_training(tmp_path, capsys):
    """By hand: 3 devices lose 1, 2 and 3 per cent; 3 trainings gain 2 each by the mask."""

    def trial(row: str, dead: int, gain: float) -> Trial:
        accuracy = {f"{seed}.{n}": 80 + seed + gain - dead * (n + 1) for seed in range(3) for n in range(3)}
        return Trial(row, f"{dead} dead", accuracy)

    publish(tmp_path, [trial("a", 0, 0), trial("a", 1, 0), trial("a, mask", 0, 2), trial("a, mask", 1, 2)])
    with (tmp_path / "dead.csv").open(newline="") as file:
        lines = {(line["row"], line["condition"]): line for line in csv.DictReader(file)}
    assert lines["a", "1 dead"]["difference"] == "-2.00 ± 0.58"
    assert lines["a", "1 dead"]["verdict"] == "worse"
    assert lines["a: 1 dead", "mask"]["difference"] == "+2.00 ± 0.00"
    assert lines["a: 1 dead", "mask"]["verdict"] == "better"
    assert lines["a: 1 dead", "mask"]["seeds"] == "3"
    assert "dead.md" in capsys.readouterr().out
