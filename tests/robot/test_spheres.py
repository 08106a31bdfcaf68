"""The posterior, which knows discs, finds the spheres that MuJoCo presses on a skin of 30 mm.

``pytest tests/robot -k spheres -rP`` prints the figures of docs/robots.md.
"""

import numpy as np
import pytest

from skin import Grid, Noise, Posterior, Sheet, Solid
from skin.robot.mujoco_skin import MujocoSurface, Pressing

mujoco = pytest.importorskip("mujoco", reason="pip install 'tactile-skin[mujoco]'")
COUNT = 500
BODY = Sheet((0.16, 0.16), (32, 32), [{"material": "EcoFlex 00-30", "thickness": 0.03}])
WORLD = """<mujoco><option gravity="0 0 0"/><worldbody>
<body><geom type="box" size="0.08 0.08 0.015"/><site name="skin" pos="0 0 0.015"/></body>
<body pos="{x} {y} {z}"><joint type="slide" axis="0 0 1"/>
<geom type="sphere" size="{radius}" mass="1"/></body>
</worldbody></mujoco>"""


@pytest.mark.slow("solves a thick skin and presses 500 spheres")
def test_spheres_are_found_as_well_as_in_the_study_of_contacts():
    """Positions within 1.2 x the 1.73 mm of docs/contacts.md, 30 mm from the rim; forces within 6 %."""
    layout = Grid(5, 5, (0.01, 0.01), depth=0.0295)
    solid, random = Solid(BODY, layout.sensors(BODY)), np.random.default_rng(0)
    pressing, posterior = Pressing(solid, BODY), Posterior(solid, Noise(0.05, frames=10), BODY)
    errors, forces, inside = [], [], []
    while len(errors) < COUNT:
        position, radius = random.uniform(-0.05, 0.05, 2), random.uniform(0.01, 0.03)
        force = 5 * np.exp(0.5 * random.standard_normal())
        world = WORLD.format(x=position[0], y=position[1], z=0.015 + radius, radius=radius)
        model = mujoco.MjModel.from_xml_string(world)
        data = mujoco.MjData(model)
        data.xfrc_applied[2, 2] = -force
        mujoco.mj_step(model, data, 300)
        presses = MujocoSurface(model, "skin", BODY).presses(data)
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
