"""A MuJoCo model of a skin on a table, and what lies on it."""

from collections.abc import Callable
from typing import Any

import pytest

from skin import Grid, Sheet

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
<body name="table" euler="0 0 {turn}"><geom name="pad" type="box" size="0.08 0.08 0.0075"/>
<site name="skin" pos="0 0 0.0075"/><site name="above" pos="0.5 0 0.1"/></body>
<body name="air" pos="0 0 1"><site name="free"/></body>
{objects}</worldbody></mujoco>"""


@pytest.fixture(scope="session")
def world() -> Callable[..., tuple[Any, Any]]:
    """Return a function that puts objects (name, x, y) on the skin, and returns model and data at rest."""
    mujoco = pytest.importorskip("mujoco", reason="pip install 'tactile-skin[mujoco]'")

    def made(*objects: tuple[str, float, float], turn: float = 0.0, push: float = 0.0) -> tuple[Any, Any]:
        bodies = "".join(
            f'<body pos="{x} {y} {OBJECTS[name][1] + 0.0075}"><freejoint/>'
            f'<geom {OBJECTS[name][0]} mass="{OBJECTS[name][2]}"/></body>'
            for name, x, y in objects
        )
        model = mujoco.MjModel.from_xml_string(SKIN.format(turn=turn, objects=bodies))
        data = mujoco.MjData(model)
        for body in range(model.nbody - len(objects), model.nbody):
            data.xfrc_applied[body, 0] = push
        mujoco.mj_step(model, data, 1000)
        return model, data

    return made
