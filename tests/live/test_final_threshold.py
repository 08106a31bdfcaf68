"""A live view whose threshold is provisional, and the real process that chooses the final one."""

from dataclasses import replace
from time import monotonic, sleep

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir

from skin.core.files import CONF
from skin.errors import InputError
from skin.evaluation.alarm import AlarmSource, choose_alarm_threshold
from skin.evaluation.decisions import LiveConditions
from skin.evaluation.operating_point import FinalThreshold
from skin.live.engine import Detection, Engine
from skin.live.loop import Display
from skin.live.verdict import Note
from skin.live.view import adopt_final
from skin.runs.build import device_on_skin
from skin.runs.configuration import validate_config
from skin.touch.labels import TOUCH

LIVE = LiveConditions(20.0, 0.1, 2.0, 0.1, 3)
PATIENCE = 100  # s, on a busy machine


class Largest:
    """Finds large readings dangerous."""

    def probabilities(self, touches):
        return torch.sigmoid(touches.readings.nan_to_num().amax((1, 2)) - 4)[:, None].expand(-1, 4)


class Broken:
    """Raises what no one expects."""

    def probabilities(self, touches):
        raise ArithmeticError


def refuse(settings):
    raise InputError("no such skin")


@pytest.fixture(scope="module")
def source():
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = validate_config(compose("train", ["simulator=naive", "evaluation.safe_gestures=100"]))
    build = device_on_skin(config, vars(config))
    return AlarmSource("run x", config.evaluation, Largest(), config.device, config.device, build=build)


def watched(source):
    """Return a view with a provisional threshold, its engine, and what chooses the final one."""
    display = Display("", "", np.zeros((25, 3)), (0.1, 0.1), 4.0)
    display.add_note(Note("provisional"))
    engine = Engine(None, TOUCH, 25, 30, 10.0, Detection(0.1))
    engine.alarm = True
    return display, engine, FinalThreshold(source, LIVE)


def until_known(display, engine, final, test=bool):
    deadline, adopted = monotonic() + PATIENCE, adopt_final(final, test, engine, display)
    while next(adopted, "done") != "done" and monotonic() < deadline:
        sleep(0.02)
    final.process.join(PATIENCE)
    return [note.text for note in display.notes]


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("SKIN_CACHE", str(tmp_path))


def test_the_final_threshold_is_adopted_and_an_alarm_stays(source):
    display, engine, final = watched(source)
    assert until_known(display, engine, final) == []
    chosen = choose_alarm_threshold(source, LIVE, say=pytest.fail)  # the process has kept it
    assert (engine.above, engine.danger, engine.alarm) == (chosen.threshold, chosen.score, True)
    assert final.process.exitcode is not None


def test_a_threshold_with_which_no_press_raises_the_alarm_is_not_adopted(source):
    display, engine, final = watched(source)
    (note,) = until_known(display, engine, final, refuse)
    assert (note[-14:], engine.above) == (": no such skin", 0.5)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({}, "the process that chooses the final one has ended"),
        ({"learner": Broken()}, "the process that chooses the final one has ended"),
        ({"build": refuse}, "no such skin"),
    ],
)
def test_a_threshold_stays_provisional_where_none_is_chosen(source, change, reason):
    display, engine, final = watched(replace(source, **change))
    if not change:
        final.process.kill()
    (note,) = until_known(display, engine, final)
    assert note.endswith(f"is provisional and raises more false alarms, and stays so: {reason}")
    assert (engine.above, engine.alarm) == (0.5, True)
