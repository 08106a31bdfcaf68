"""Touches that MuJoCo presses: a device whose contact mechanics no training has seen."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import torch
from annotated_types import Ge, MinLen
from torch import Tensor

from skin.body.base import AbstractBody, Sensors
from skin.body.layout import AbstractLayout
from skin.core.rng import Stream, generator
from skin.core.settings import checked, option_name
from skin.device.base import AbstractDevice, Blank, Split, split_rows
from skin.device.imperfection import Imperfection, ImperfectionSettings
from skin.device.resampling import check_rate
from skin.device.sampling import draw_constants
from skin.device.simulated import cover_surface, with_imperfections
from skin.device.touches import Recording, Touches
from skin.errors import InputError
from skin.mechanics.geometry import sensor_geometry
from skin.mechanics.simulator.base import AbstractSimulator
from skin.robot.mujoco_skin import MujocoSurface, Press, Pressing, load_mujoco
from skin.touch.fingertips import read_touch
from skin.touch.labels import TOUCH, report_labels
from skin.touch.movie import Movie, measure_gestures
from skin.touch.paths import Above0, Draws, TouchSettings, draw_motion, draw_times, fold
from skin.touch.sampler import balanced

Kind = Literal["ball", "rod", "box", "hand"]

# The objects: their lowest point is at height 0, their middle at x = y = 0. Lengths are fractions of the
# shorter side of the skin.


class Shape(NamedTuple):
    """An object.

    Attributes:
        geoms: type, size, position and axis of each of its geoms, as MuJoCo takes them; m.
        half: (2,), half extents along x and y, m.
        area: nominal, by which the force is drawn, m^2.
    """

    geoms: list[tuple[str, Sequence[float], Sequence[float], Sequence[float]]]
    half: np.ndarray
    area: float


_UP, _LENGTHWISE, _ACROSS = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)


def draw_shape(kind: Kind, random: np.ndarray, side: float) -> Shape:
    """Return an object of a kind.

    Args:
        kind: a ball, a rod that lies, a box, or a flat hand: a palm and four fingers.
        random: (2,), 0 to 1.
        side: shorter side of the skin, m.
    """
    first, second = random
    if kind == "ball":
        radius = side * (0.05 + 0.2 * first)
        return Shape([("sphere", [radius], [0, 0, radius], _UP)], np.full(2, radius), 0.8 * radius**2)
    if kind == "rod":
        radius, half = side * (0.03 + 0.05 * first), side * (0.1 + 0.25 * second)
        capsule = ("capsule", [radius, half], [0, 0, radius], _LENGTHWISE)
        return Shape([capsule], np.array([half + radius, radius]), 2 * half * radius)
    if kind == "box":
        x, y = side * (0.06 + 0.36 * random)
        return Shape([("box", [x, y, 0.1 * side], [0, 0, 0.1 * side], _UP)], np.array([x, y]), 4 * x * y)
    scale = side * (0.7 + 0.4 * first)
    palm = ("box", [0.3 * scale, 0.24 * scale, 0.06 * scale], [0, -0.17 * scale, 0.06 * scale], _UP)
    fingers = [
        ("capsule", [0.05 * scale, 0.12 * scale], [x * scale, 0.24 * scale, 0.05 * scale], _ACROSS)
        for x in (-0.225, -0.075, 0.075, 0.225)
    ]
    return Shape([palm, *fingers], scale * np.array([0.3, 0.41]), 0.35 * scale**2)


# A controller presses an object: its position follows a target.

# N/m, and kg. The damping is critical, so that an object follows its target 2 sqrt(m / k) = 18 ms later.
_STIFFNESS, _MASS = 5e4, 4.0
_LAG = 2 * np.sqrt(_MASS / _STIFFNESS)  # s
_STEP = 0.002  # s
_LIFT, _APPROACH = 0.003, 0.03  # m above the skin before and after a touch, s of the way down
# solref, s, and solimp of the contact are MuJoCo's defaults, but the impedance d begins at 0. From 0.9 on, a
# sliding object would lose contact every 30 ms. The force is m d k r / (1 - d) at an overlap r, with k of
# MuJoCo's manual.
_SOLREF, _WIDTH, _IMPEDANCE = 0.02, 0.001, 0.95
_OVERLAPS = np.linspace(0, 0.03, 3001)  # m
_REACHED = np.minimum(_OVERLAPS / _WIDTH, 1)
_RATIO = _IMPEDANCE * np.where(_REACHED < 0.5, 2 * _REACHED**2, 1 - 2 * (1 - _REACHED) ** 2)
_FORCES = _MASS / (_IMPEDANCE * _SOLREF) ** 2 * _OVERLAPS * _RATIO / (1 - _RATIO)
_WORLD = """<mujoco><option timestep="{step}" gravity="0 0 0" cone="elliptic" integrator="implicitfast"/>
<worldbody>
<body><geom name="skin" type="box" size="{x} {y} {z}"/><site name="skin" pos="0 0 {z}"/></body>
<body pos="0 0 {z}"><joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>
<joint name="z" type="slide" axis="0 0 1"/><inertial pos="0 0 0" mass="{mass}" diaginertia="1 1 1"/>
<body euler="0 0 {angle}">{geoms}</body></body></worldbody><actuator>{actuators}</actuator></mujoco>"""


def press_world(shape: Shape, angle: float, friction: float, body: AbstractBody) -> str:
    """Return the MJCF of an object above a skin, with a position controller along each axis.

    Args:
        shape: the object.
        angle: by which it is turned about the normal, rad.
        friction: coefficient of its contact with the skin.
        body: the skin.
    """
    x, y = np.array(body.size) / 2
    damping = 2 * np.sqrt(_STIFFNESS * _MASS)
    geoms = "".join(
        f'<geom type="{kind}" size="{_row(size)}" pos="{_row(position)}" zaxis="{_row(axis)}" mass="0" '
        f'friction="{friction}" priority="1" solref="{_SOLREF} 1" solimp="0 {_IMPEDANCE} {_WIDTH} 0.5 2"/>'
        for kind, size, position, axis in shape.geoms
    )
    actuators = "".join(f'<position joint="{axis}" kp="{_STIFFNESS}" kv="{damping}"/>' for axis in "xyz")
    numbers = {"step": _STEP, "mass": _MASS, "angle": np.degrees(angle)}
    return _WORLD.format(x=x, y=y, z=body.thickness / 2, geoms=geoms, actuators=actuators, **numbers)


def _row(numbers: Sequence[float]) -> str:
    return " ".join(f"{number:.9g}" for number in numbers)


@checked("device")
@dataclass(kw_only=True, eq=False)
class Mujoco(ImperfectionSettings, AbstractDevice):
    """Presses, slides and taps of rigid objects that MuJoCo moves under position control.

    An object follows a target that goes below the surface, slides at constant speed where the touch is
    dynamic, and comes up. MuJoCo gives the force, the skin's compliance the pressure
    (:class:`skin.robot.mujoco_skin.MujocoSkin`). Labels follow from the pressure, and ``dynamic`` from the
    way of the object; they are not balanced.
    Use it to test a run on touches of other mechanics than those of its training.

    Args:
        body, layout: the skin, which is flat, and the positions of its sensors.
        simulator: ``simulator(body, sensors)`` gives readings and compliance.
        touch: durations, speeds, thresholds and labels of touches (``conf/touch``).
        objects: kinds of objects, equally likely.
        pressure: wanted force over the nominal area, [least, most], Pa, on a logarithmic scale.
        friction: its coefficient, [least, most].
        gestures, test_gestures: number of touches of the budget and of ``test``.
        padded, data_seed, seed, calibration, randomise: as in :class:`skin.device.simulated.Simulated`.

    Raises:
        InputError: invalid settings, a body that is not flat, or MuJoCo is not installed.
    """

    body: AbstractBody
    layout: AbstractLayout
    simulator: Callable[[AbstractBody, Sensors], AbstractSimulator]
    touch: Mapping[str, Any] | TouchSettings | None = None
    objects: Annotated[tuple[Kind, ...], MinLen(1)] = ("ball", "rod", "box", "hand")
    pressure: Above0 = (15e3, 150e3)
    friction: Above0 = (0.1, 0.6)
    gestures: Annotated[int, Ge(10)] = 200
    test_gestures: Annotated[int, Ge(1)] = 500
    padded: bool = True
    data_seed: int = 0
    seed: int = 0
    calibration: str | None = None
    randomise: bool = False

    def __post_init__(self) -> None:
        load_mujoco()
        if not self.body.flat:
            name = option_name(self.body)
            raise InputError(f"device=mujoco presses flat skins, got body={name}: set body=sheet")
        self.size, self.sensors = self.body.size, self.layout.sensors(self.body)
        self.settings = read_touch(self.touch)
        self.task = TOUCH.with_labels(tuple(self.settings.labels))
        check_rate(self.slowest, self.settings.rate, "device.rate")
        self.imperfection = Imperfection.of(self, self.calibration)
        self._kept: dict[Split | None, Recording] = {}

    def blank(self) -> Blank:
        """Return a device with one empty touch: nothing is simulated."""
        shape = (1, self.settings.frames.window, len(self.sensors))
        positions = torch.from_numpy(self.sensors.positions).float()
        empty = torch.zeros(shape), torch.ones(shape, dtype=torch.bool), positions
        labels = torch.zeros(1, len(self.task))
        return Blank(self.task, self.size, Touches(*empty, labels, float(self.settings.rate)))

    def touches(self, split: Split, epoch: int = 0) -> Touches:
        """Return the touches of a split, which are the same in every epoch."""
        return self.recording(split).touches

    def recording(self, split: Split | None = None, epoch: int = 0, complete: bool = True) -> Recording:
        """Return the same touches with force and parameters; displacements are not computed."""
        if split not in self._kept:
            tested = split == "test"
            count = self.test_gestures if tested else self.gestures
            stream, key = (Stream.TEST, ()) if tested else (Stream.BUDGET, (self.data_seed,))
            rows = torch.arange(count)
            if split is not None and not tested:
                rows = split_rows(split, count, self.data_seed)
            true = self._simulate(self._draw(count, generator(stream, *key)), rows.tolist())
            drawn = generator(Stream.CONSTANTS, self.seed)
            rate, noise = true.touches.rate, generator(Stream.NOISE, self.seed, stream, *key)
            constants = draw_constants(self.imperfection, len(self.sensors), rate, drawn)
            self._kept[split] = with_imperfections(
                true, self.imperfection, None if self.randomise else constants, noise
            )
        return self._kept[split]

    def _draw(self, count: int, random: np.random.Generator) -> Draws:
        """Draw touches: their objects, times, paths and forces."""
        labels = balanced(count, random, ("dynamic", "press"))
        numbers = random.integers(len(self.objects), size=count)
        sizes, angle, level, friction = (random.random((count, *of)) for of in ((2,), (), (), ()))
        side = min(self.size)
        shapes = [draw_shape(self.objects[n], own, side) for n, own in zip(numbers, sizes, strict=True)]
        half, angle = np.array([shape.half for shape in shapes]), 2 * np.pi * angle
        turned = np.abs(np.cos(angle))[:, None] * half + np.abs(np.sin(angle))[:, None] * half[:, ::-1]
        fits = (2 * turned + self.settings.spare < self.size).all(axis=1)
        room = np.where(fits[:, None], turned, half) + self.settings.spare / 2
        drawn = draw_times(labels, self.settings, self.padded, random)
        drawn |= {"shape": numbers, "angle": np.where(fits, angle, 0), "low": -room, "high": room}
        motion = random.random((count, 4))
        drawn |= draw_motion(labels[:, 1], drawn, self.settings, self.size, motion)
        pressure = np.exp(np.log(self.pressure[0]) + level * np.log(self.pressure[1] / self.pressure[0]))
        drawn["force"] = pressure * [shape.area for shape in shapes]
        drawn["friction"] = self.friction[0] + friction * (self.friction[1] - self.friction[0])
        return drawn | {"sizes": sizes}

    def _simulate(self, drawn: Draws, rows: Sequence[int]) -> Recording:
        """Return the true readings of some of the drawn touches, with labels."""
        model = self.simulator(self.body, self.sensors)
        pressing, settings = Pressing(model, self.body), self.settings
        judged = self.sensors if settings.over_sensors else cover_surface(self.body, self.sensors.footprint)
        footprints = torch.from_numpy(self.body.footprints(judged)).float()
        readings, forces, labels, parameters = [], [], [], []
        for row in rows:
            touch = {name: values[row] for name, values in drawn.items()}
            pressure, felt, touch["travel"] = self._press(touch, pressing)
            movie, force = self._movie(pressure, touch, footprints)
            readings.append(felt)
            forces.append(force)
            parameters.append(movie.parameters)
            limits = report_labels(settings.thresholds, settings.rate) | dict(settings.labels)
            held = [label.measure(movie, self.body) > label.above for label in limits.values()]
            labels.append(torch.cat(held).float())
        true = torch.stack(readings)
        touches = Touches(
            true,
            torch.ones_like(true, dtype=torch.bool),
            torch.from_numpy(self.sensors.positions).float(),
            torch.stack(labels),
            float(settings.rate),
            geometry=sensor_geometry(self.body, self.sensors, model),
        )
        joined = {name: torch.cat([each[name] for each in parameters]) for name in parameters[0]}
        footprint = self.sensors.footprint
        return Recording(touches, self.task, self.size, footprint, torch.stack(forces), None, joined)

    def _press(self, touch: Draws, pressing: Pressing) -> tuple[Tensor, Tensor, np.ndarray]:
        """Return pressure (T, H, W), Pa, and true readings (T, S), N, of a touch in the middles of frames.

        The third result is the largest distance of the object in contact from where it began, m.
        """
        mujoco, window = load_mujoco(), self.settings.frames.window
        shape = draw_shape(self.objects[touch["shape"]], touch["sizes"], min(self.size))
        world = press_world(shape, float(touch["angle"]), float(touch["friction"]), self.body)
        model = mujoco.MjModel.from_xml_string(world)
        surface, data = MujocoSurface(model, "skin", self.body), mujoco.MjData(model)
        first, count = float(touch["onset"]), float(touch["duration"])
        begin, end = first / self.settings.rate, (first + count) / self.settings.rate
        times = np.arange(begin - 2 * _APPROACH, end, _STEP)
        targets = self._targets(touch, times, begin, end)
        data.qpos[:] = targets[0]
        presses, frames, path = list[Press](), list[int](), list[np.ndarray]()
        middles = (np.arange(window) + 0.5) / self.settings.rate
        shown = dict(zip(np.searchsorted(times, middles), range(window), strict=True))
        for number, target in enumerate(targets):
            data.ctrl[:] = target
            mujoco.mj_step(model, data)
            if number in shown and times[number] > begin:
                found = surface.presses(data)
                presses += found
                frames += [shown[number]] * len(found)
                path += [data.qpos[:2].copy()] * len(found)
        index, alone = torch.tensor(frames, dtype=torch.long), pressing.pressures(presses)
        felt = pressing.readings(presses, alone)
        total = torch.zeros(window, *self.body.shape).index_add(0, index, alone)
        way = np.array(path).reshape(-1, 2)
        travel = np.linalg.norm(way - way[:1], axis=1).max(initial=0.0)
        return total, torch.zeros(window, len(self.sensors)).index_add(0, index, felt), travel

    def _targets(self, touch: Draws, times: np.ndarray, begin: float, end: float) -> np.ndarray:
        """Return the target position of an object at some times, (N, 3), m: in the model, z up."""
        times = times + _LAG
        rise = (end - begin) / self.settings.ramp
        fraction = np.clip(np.minimum(times - begin, end - times) / rise, 0, 1)
        lift = _LIFT * np.clip(np.maximum(begin - times, times - end) / _APPROACH, 0, 1)
        direction = np.array([np.cos(touch["direction"]), np.sin(touch["direction"])])
        moved = touch["speed"] * self.settings.rate * np.clip(times - begin, 0, None)
        position = fold(touch["start"] + moved[:, None] * direction, touch["span"]) - touch["low"]
        depth = touch["force"] / _STIFFNESS + np.interp(touch["force"], _FORCES, _OVERLAPS)
        height = lift - fraction * depth
        return np.column_stack([position - np.array(self.size) / 2, height])

    def _movie(self, pressure: Tensor, touch: Draws, footprints: Tensor) -> tuple[Movie, Tensor]:
        """Return a touch as a movie of one, with its measures as parameters, and its force (T,), N."""
        index, scale = torch.arange(len(pressure))[None], torch.ones(1, len(pressure))
        contact, cell = self.settings.thresholds.contact, self.body.cell
        measures = measure_gestures(pressure, index, scale, footprints, cell, contact)._asdict()
        drawn = {name: value.float() for name, value in measures.items()}
        # On coarse cells the centre of pressure of a light contact jumps; the object does not.
        names = ("shape", "angle", "duration", "onset", "direction", "speed", "friction", "travel")
        drawn |= {name: torch.tensor([float(touch[name])]) for name in names}
        force = pressure.sum((1, 2)) * cell[0] * cell[1]
        drawn |= {"peak": pressure.amax()[None], "force": force.amax()[None]}
        return Movie(pressure, index, scale, torch.empty(0), drawn), force
