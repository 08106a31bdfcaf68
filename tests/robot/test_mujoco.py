"""A skin under objects of MuJoCo, and touches that it presses; ``-k spheres -rP`` prints figures."""

import sys
from time import process_time
from typing import Any

import numpy as np
import pytest
import torch

from skin import Arm, Grid, InputError, Noise, Posterior, Sheet, Solid
from skin.robot import MujocoSkin
from skin.robot.mujoco import draw_object, press_world
from skin.robot.mujoco_skin import MujocoSurface, Pressing
from skin.robot.recordings import write_mcap
from skin.runs.build import build_device
from skin.touch.labels import TOUCH
from tests.mechanics.contact.test_rigid import BODY as HALF_SPACE
from tests.mechanics.contact.test_rigid import HalfSpace

mujoco = pytest.importorskip("mujoco", reason="pip install 'tactile-skin[mujoco]'")
BODY = Sheet((0.16, 0.16), (16, 16), [{"material": "EcoFlex 00-30", "thickness": 0.015}])
LAYOUT = Grid(5, 5, depth=0.01)
OBJECTS = {
    "ball": ('type="sphere" size="0.03"', 0.03, 1.0),
    "can": ('type="cylinder" size="0.033 0.06"', 0.06, 2.0),
    "box": ('type="box" size="0.03 0.025 0.04"', 0.04, 3.0),
}
"""MuJoCo's geom, height of its middle, m, and mass, kg."""
SKIN = """<mujoco><worldbody>
<geom name="floor" type="plane" size="1 1 0.1" pos="0 0 -0.0075"/>
<body name="table"><geom type="box" size="0.08 0.08 0.0076" contype="0" conaffinity="0"/>
<geom name="pad" type="box" size="0.08 0.08 0.0075"/>
<site name="skin" pos="0 0 0.0075"/><site name="above" pos="0.5 0 0.1"/></body>
<body name="air" pos="0 0 1"><site name="free"/></body>
{objects}</worldbody></mujoco>"""


def world(*objects: tuple[str, float, float], push: float = 0.0) -> tuple[Any, Any]:
    """Return a model with objects (name, x, y) on the skin, pushed along x, N, and its data at rest."""
    bodies = "".join(
        f'<body pos="{x} {y} {OBJECTS[name][1] + 0.0075}"><freejoint/>'
        f'<geom {OBJECTS[name][0]} mass="{OBJECTS[name][2]}"/></body>'
        for name, x, y in objects
    )
    model = mujoco.MjModel.from_xml_string(SKIN.format(objects=bodies))
    data = mujoco.MjData(model)
    data.xfrc_applied[model.nbody - len(objects) :, 0] = push
    mujoco.mj_step(model, data, 1000)
    return model, data


@pytest.fixture(scope="module")
def solid() -> Solid:
    return Solid(BODY, LAYOUT.sensors(BODY), divisions=2, refinement=1)


@pytest.fixture(scope="module")
def covered(solid):
    """Return a function that puts a skin, solved once, on the pad of a model."""
    return lambda model, site="skin": MujocoSkin(model, site, BODY, LAYOUT, lambda body, sensors: solid)


@pytest.mark.parametrize("name", OBJECTS)
def test_the_pressure_sums_to_the_weight_of_an_object(covered, name):
    model, data = world((name, 0.013, -0.02))
    pressure = covered(model).pressure(data)
    assert pressure.sum() * np.prod(BODY.cell) == pytest.approx(9.81 * OBJECTS[name][2], rel=0.01)
    y, x = np.indices(BODY.shape) + 0.5
    centre = [(pressure * along).sum() / pressure.sum() * 0.01 - 0.08 for along in (x, y)]
    assert centre == pytest.approx([0.013, 0.02], abs=0.005)  # half a cell; y is down in the chart


def test_what_no_contact_shows_is_refused_or_named(covered):
    plate = '<body pos="0 0 0.099"><geom type="box" size="0.2 0.2 0.0925"/><freejoint/></body>'
    text, sleep = SKIN.format(objects=plate), '><option><flag sleep="enable"/></option>'
    model = mujoco.MjModel.from_xml_string(text.replace('0.08 0.08 0.0075"', '0.12 0.12 0.0075"'))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with pytest.warns(UserWarning, match="has contacts beside the skin, which do not count"):
        assert covered(model).read(data).max() == 0
    with pytest.raises(InputError, match="objects that sleep"):
        covered(mujoco.MjModel.from_xml_string(text.replace(">", sleep, 1)))


def test_readings_of_two_objects_are_the_sum_of_each_alone(covered):
    places = ("ball", -0.04, -0.04), ("box", 0.03, 0.03)
    worlds = world(*places), world(places[0]), world(places[1])
    both, first, second = (covered(model).read(data) for model, data in worlds)
    assert both == pytest.approx(first + second, abs=1e-3 * both.max())
    presses = covered(worlds[0][0]).surface.presses(worlds[0][1])
    assert sorted(press.force[2] for press in presses) == pytest.approx([9.81, 29.43], rel=0.01)


def test_friction_is_a_shear(covered, solid):
    """5 N push a box of 3 kg, which friction holds."""
    model, data = world(("box", 0.0, 0.0), push=5.0)
    skin = covered(model)
    (press,) = skin.surface.presses(data)
    assert press.force == pytest.approx([5.0, 0.0, 29.43], abs=0.1)
    pressure = torch.from_numpy(skin.pressure(data))
    shear = torch.tensor([press.force[0] / press.force[2], 0.0])
    expected = solid(pressure[None], shear[None]).readings[0].numpy()
    assert skin.read(data) == pytest.approx(expected, abs=1e-4)
    assert np.abs(skin.read(data) - solid(pressure[None]).readings[0].numpy()).max() > 0.01


@pytest.mark.slow("prepares a posterior")
def test_the_posterior_finds_the_object(covered):
    model, data = world(("ball", 0.03, -0.005))
    estimate = covered(model).contacts(data)
    (contact,) = estimate.contacts
    assert estimate.fingertip
    assert contact.position - 0.08 == pytest.approx([0.03, 0.005], abs=0.008)
    assert contact.force == pytest.approx(9.81, abs=2 * contact.force_deviation)


@pytest.mark.parametrize("turn", [0.0, 0.7, 1.3])
def test_a_ball_on_an_arm_presses_along_the_normal(turn):
    arm = Arm(cells=(32, 16), layers=BODY.layers, radius=0.05, length=0.16, angle=3.0)
    out = np.array([np.sin(turn), 0, np.cos(turn)])
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option gravity="0 0 0"/><worldbody>
        <body><geom type="cylinder" size="0.05 0.08" zaxis="0 1 0"/><site name="skin" pos="0 0 0.05"/></body>
        <body pos="{0.07 * out[0]} 0.02 {0.07 * out[2]}"><joint type="slide" axis="{out[0]} 0 {out[2]}"/>
        <geom type="sphere" size="0.02" mass="1"/></body></worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    data.xfrc_applied[2, :3] = -5 * out
    mujoco.mj_step(model, data, 500)
    (press,) = MujocoSurface(model, "skin", arm).presses(data)
    assert press.force == pytest.approx([0, 0, 5], abs=0.01)
    row, column = np.unravel_index(press.gap.argmin(), arm.shape)
    middle = [(column + 0.5) * arm.cell[0], (row + 0.5) * arm.cell[1]]
    assert middle == pytest.approx([0.075 + 0.05 * turn, 0.06], abs=0.006)
    assert np.isfinite(press.gap).sum() < 0.3 * press.gap.size  # neither the far side nor the rest


def test_a_surface_without_shear_says_that_friction_is_left_out():
    with pytest.warns(UserWarning, match="has normal forces only: friction is left out"):
        Pressing(HalfSpace(), HALF_SPACE)


@pytest.mark.slow("500 readings")
def test_a_reading_of_25_sensors_takes_at_most_5_ms():
    """Processor time of the 99th percentile on one thread, the best of five hundreds; 32 x 32 cells."""
    body = Sheet((0.16, 0.16), (32, 32), BODY.layers)
    model, data = world(("ball", 0.013, -0.02))
    solid = Solid(body, LAYOUT.sensors(body), divisions=2, refinement=1)
    skin, times = MujocoSkin(model, "skin", body, LAYOUT, lambda body, sensors: solid), []
    for _ in range(500):
        begin = process_time()
        skin.read(data)
        times.append(process_time() - begin)
    # Other processes take the cache of the processor, and so its time.
    assert np.percentile(np.reshape(times, (5, 100)), 99, axis=1).min() < 0.005


@pytest.mark.parametrize(
    ("package", "extra", "make"),
    [
        ("mujoco", "mujoco", lambda configured, path: MujocoSkin(None, "skin", BODY, Grid(5, 5))),
        ("mujoco", "mujoco", lambda configured, path: build_device(configured("device=mujoco"))),
        ("mcap.writer", "robot", lambda configured, path: write_mcap(None, path)),
    ],
)
def test_without_a_package_one_sentence_says_what_to_install(
    configured, monkeypatch, tmp_path, package, extra, make
):
    monkeypatch.setitem(sys.modules, package, None)
    match = rf"^{package[:4]}\S* is not installed: pip install 'tactile-skin\[{extra}\]'$"
    with pytest.raises(InputError, match=match):
        make(configured, tmp_path / "x.mcap")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("site", "said"),
    [
        ("skn", r"^the model has no site 'skn': .*'above', 'free', 'skin'"),
        ("free", "^site free of body air lies on no geom that collides: put it on the surface"),
        ("above", "^site above of body table lies on no geom"),
    ],
)
def test_what_cannot_carry_a_skin_is_refused_in_a_sentence(covered, site, said):
    with pytest.raises(InputError, match=said):
        covered(world()[0], site)


COUNT = 500
THICK = Sheet((0.16, 0.16), (32, 32), [{"material": "EcoFlex 00-30", "thickness": 0.03}])
WORLD = """<mujoco><option gravity="0 0 0"/><worldbody>
<body><geom type="box" size="0.08 0.08 0.015"/><site name="skin" pos="0 0 0.015"/></body>
<body pos="{x} {y} {z}"><joint type="slide" axis="0 0 1"/>
<geom type="sphere" size="{radius}" mass="1"/></body>
</worldbody></mujoco>"""


@pytest.mark.slow("solves a thick skin and presses 500 spheres")
def test_spheres_are_found_as_well_as_in_the_study_of_contacts():
    """Positions within 1.2 x the 1.73 mm of docs/contacts.md, 30 mm from the rim; forces within 6 %."""
    layout = Grid(5, 5, (0.01, 0.01), depth=0.0295)
    solid, random = Solid(THICK, layout.sensors(THICK)), np.random.default_rng(0)
    pressing, posterior = Pressing(solid, THICK), Posterior(solid, Noise(0.05, frames=10), THICK)
    errors, forces, inside = [], [], []
    while len(errors) < COUNT:
        position, radius = random.uniform(-0.05, 0.05, 2), random.uniform(0.01, 0.03)
        force = 5 * np.exp(0.5 * random.standard_normal())
        world = WORLD.format(x=position[0], y=-position[1], z=0.015 + radius, radius=radius)
        model = mujoco.MjModel.from_xml_string(world)
        data = mujoco.MjData(model)
        data.xfrc_applied[2, 2] = -force
        mujoco.mj_step(model, data, 300)
        presses = MujocoSurface(model, "skin", THICK).presses(data)
        readings = pressing.frames([(press, 0) for press in presses], 1)[1][0].double().numpy()
        if readings.max() > 0.15:  # a sensor responds in a frame
            estimate = posterior.estimate(readings + random.normal(0, 0.05 / 10**0.5, len(readings)))
            contact = estimate.contacts[0]
            errors.append(contact.position - 0.08 - position)
            forces.append(contact.force / force - 1)
            inside.append(contact.region(0.9).contains(position + 0.08))
    rms, off = 1e3 * np.sqrt(np.square(errors).mean()), 100 * np.median(np.abs(forces))
    print(f"{COUNT} spheres: {rms:.2f} mm per axis, force {off:.1f} %, {100 * np.mean(inside):.0f} % inside")
    assert rms < 1.2 * 1.726
    assert off < 6
    assert np.mean(inside) > 0.8


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
    others = [device.recording(split) for split in ("validation", "holdout")]
    idle = (others[0].force[0] == 0) & (others[1].force[0] == 0)
    assert not torch.equal(*(each.touches.readings[0, idle] for each in others))


def test_forces_follow_the_controller_and_readings_the_forces(configured):
    quiet = [f"device.{name}=0" for name in ("gain_spread", "offset", "noise")]
    recording = build_device(configured(*SMALL, *quiet, "device.clip=1000", "limits=cuff")).recording("test")
    force, touches = recording.force, recording.touches
    assert torch.equal(touches.labels[:, 3] > 0, recording.parameters["pressure"] > 22.8e3)
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
