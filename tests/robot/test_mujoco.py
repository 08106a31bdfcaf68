"""Touches that MuJoCo presses, as a device: labels, forces, splits, and a run that is tested on them."""

import numpy as np
import pytest
import torch

from skin.errors import InputError
from skin.robot.mujoco import draw_object, press_world
from skin.runs.build import build_device
from skin.touch.labels import TOUCH

from .conftest import BODY

pytest.importorskip("mujoco", reason="pip install 'tactile-skin[mujoco]'")
SMALL = (
    "device=mujoco", "body.cells=[16,16]", "+device.simulator.refinement=1", "+device.simulator.divisions=2",
    "device.gestures=20", "device.test_gestures=24",
)  # fmt: skip


@pytest.fixture(scope="module")
def device(configured):
    return build_device(configured(*SMALL))


def test_labels_are_those_of_the_true_pressure(device):
    recording = device.recording("test")
    labels, parameters = recording.touches.labels.bool(), recording.parameters
    assert (recording.task, device.task) == (TOUCH, TOUCH)
    limits = {"area": 0.3, "travel": 1e-3, "frames": 3, "pressure": 90.5e3}
    for column, (name, limit) in zip(labels.T, limits.items(), strict=True):
        assert torch.equal(column, parameters[name] > limit), name
        assert 0 < column.float().mean() < 1, name
    assert torch.equal(labels[:, 1], parameters["speed"] > 0)
    assert sorted(parameters["shape"].unique().tolist()) == [0, 1, 2, 3]


def test_forces_follow_the_controller_and_readings_the_forces(configured):
    quiet = [f"device.{name}=0" for name in ("gain_spread", "offset", "noise")]
    recording = build_device(configured(*SMALL, *quiet, "device.clip=1000")).recording("test")
    force, touches = recording.force, recording.touches
    frames = recording.parameters["duration"].long()
    for touch, first, count in zip(force, recording.parameters["onset"].long(), frames, strict=True):
        assert touch[first : first + count].max() == touch.max() > 0
        assert touch[:first].sum() == touch[first + count :].sum() == 0
    assert touches.readings[force == 0].abs().max() == 0
    assert touches.readings.isfinite().all()
    peaks = recording.parameters["pressure"] * np.prod(recording.footprint)
    strong = peaks > 2
    ratio = touches.readings.amax((1, 2))[strong] / peaks[strong]
    assert 0.5 < ratio.min() < ratio.max() < 1.5  # the layer spreads the pressure


@pytest.mark.parametrize("kind", ["ball", "rod", "box", "hand"])
def test_an_object_rests_on_its_lowest_point_and_within_its_extent(kind):
    import mujoco

    geoms, half, _ = draw_object(kind, np.array([0.3, 0.6]), 0.16)
    model = mujoco.MjModel.from_xml_string(press_world(geoms, 0.0, 0.3, BODY))
    data = mujoco.MjData(model)
    data.qpos[2] = 1e-4
    mujoco.mj_forward(model, data)
    assert data.ncon == 0
    data.qpos[2] = -1e-4
    mujoco.mj_forward(model, data)
    assert data.ncon > 0
    assert (np.abs(data.contact.pos[:, :2]) <= half + 1e-6).all()


def test_a_curved_body_and_unknown_objects_are_refused(configured):
    with pytest.raises(InputError, match=r"device\.objects"):
        build_device(configured(*SMALL, "device.objects=[foot]"))
    with pytest.raises(InputError, match="flat"):
        build_device(configured("device=mujoco", "body=arm"))


@pytest.mark.slow("loads a pretrained network and simulates for it")
def test_a_pretrained_network_is_tested_on_them(run, tmp_path):
    done = run(tmp_path, "evaluate", "run=any_skin", *SMALL, "evaluation.safe_gestures=64")
    assert done.returncode == 0, done.stderr
    assert "dangerous/alarm_recall" in done.stdout
