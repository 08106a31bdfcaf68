"""Touches that MuJoCo presses: a device whose contact mechanics no training has seen."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args

import numpy as np
import torch
from annotated_types import Ge, MinLen
from torch import Tensor

from skin.body.base import AbstractBody, Sensors
from skin.body.layout import AbstractLayout
from skin.core.rng import Stream, generator
from skin.core.settings import checked
from skin.device.base import AbstractDevice, Blank, Split, split_rows
from skin.device.imperfection import Imperfection, ImperfectionSettings
from skin.device.resampling import check_rate
from skin.device.sampling import draw_constants, with_imperfections
from skin.device.simulated import cover_surface
from skin.device.touches import Recording, Touches
from skin.errors import InputError
from skin.mechanics.geometry import sensor_geometry
from skin.mechanics.simulator.base import AbstractSimulator
from skin.robot.mujoco_skin import MujocoSurface, Press, Pressing, load_package
from skin.touch.fingertips import read_touch
from skin.touch.labels import TOUCH, report_labels
from skin.touch.movie import Movie, balanced, measure_gestures
from skin.touch.paths import Above0, Draws, TouchSettings, draw_motion, draw_times, fold

Kind = Literal["ball", "rod", "box", "hand"]
_PARAMETERS = ("shape", "angle", "duration", "onset", "direction", "speed", "friction")


def draw_object(kind: Kind, random: np.ndarray, side: float) -> tuple[str, np.ndarray, float]:
    """Return an object whose lowest point is at height 0 and whose middle is at x = y = 0.

    Args:
        kind: a ball, a rod that lies, a box, or a flat hand: a palm and four fingers.
        random: (2,), 0 to 1.
        side: shorter side of the skin, m, to which sizes are relative.

    Returns:
        Its geoms as MJCF, its half extents (2,) along x and y, m, and a nominal area of contact, m^2.
    """
    first, second = random
    if kind == "ball":
        radius = side * (0.05 + 0.2 * first)
        return _geom("sphere", [radius]), np.full(2, radius), 0.8 * radius**2
    if kind == "rod":
        radius, half = side * (0.03 + 0.05 * first), side * (0.1 + 0.25 * second)
        return _geom("capsule", [radius, half], "1 0 0"), np.array([half + radius, radius]), 2 * half * radius
    if kind == "box":
        x, y = side * (0.06 + 0.36 * random)
        return _geom("box", [x, y, 0.1 * side]), np.array([x, y]), 4 * x * y
    scale = side * (0.7 + 0.4 * first)
    palm, finger = scale * np.array([0.3, 0.24, 0.06]), scale * np.array([0.05, 0.12])
    geoms = _geom("box", palm, y=-0.17 * scale) + "".join(
        _geom("capsule", finger, "0 1 0", x * scale, 0.24 * scale) for x in (-0.225, -0.075, 0.075, 0.225)
    )
    return geoms, scale * np.array([0.3, 0.41]), 0.35 * scale**2


def _geom(kind: str, size: Any, axis: str = "0 0 1", x: float = 0.0, y: float = 0.0) -> str:
    place = f"{x} {y} {size[0] if kind == 'capsule' else size[-1]}"
    return f'<geom type="{kind}" size="{" ".join(map(str, size))}" pos="{place}" zaxis="{axis}"/>'


# A controller presses an object: its position follows a target.


# N/m, and kg. The damping is critical, so that an object follows its target 2 sqrt(m / k) = 18 ms later.
_STIFFNESS, _MASS, _LAG = 5e4, 4.0, 0.018
# s of a step; m above the skin before and after a touch, s of the way down.
_STEP, _LIFT, _APPROACH = 0.002, 0.003, 0.03
# The contact is MuJoCo's default, but its impedance begins at 0: from 0.9 on, a sliding object would lose
# contact every 30 ms. Objects overlap with the skin by about 1 mm (force / 60 N)^(1/3).
_OVERLAP, _NOMINAL = 0.001, 60.0
_WORLD = f"""<mujoco><option timestep="{_STEP}" gravity="0 0 0" cone="elliptic" integrator="implicitfast"/>
<default><geom mass="0" friction="{{friction}}" solimp="0 0.95 {_OVERLAP} 0.5 2"/>
<position kp="{_STIFFNESS}" kv="{2 * (_STIFFNESS * _MASS) ** 0.5}"/></default><worldbody>
<body><geom type="box" size="{{x}} {{y}} {{z}}"/><site name="skin" pos="0 0 {{z}}"/></body>
<body pos="0 0 {{z}}"><joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>
<joint name="z" type="slide" axis="0 0 1"/><inertial pos="0 0 0" mass="{_MASS}" diaginertia="1 1 1"/>
<body euler="0 0 {{angle}}">{{geoms}}</body></body></worldbody>
<actuator><position joint="x"/><position joint="y"/><position joint="z"/></actuator></mujoco>"""


def press_world(geoms: str, angle: float, friction: float, body: AbstractBody) -> str:
    """Return the MJCF of an object above a skin, with a position controller along each axis.

    Args:
        geoms: of the object, as MJCF.
        angle: by which it is turned about the normal, rad.
        friction: coefficient of its contact with the skin.
        body: the skin.
    """
    x, y, z = np.array([*body.size, body.thickness]) / 2
    return _WORLD.format(x=x, y=y, z=z, geoms=geoms, angle=np.degrees(angle), friction=friction)


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
        load_package("mujoco", "mujoco")
        if not self.body.flat:
            raise InputError("device=mujoco presses flat skins: set body=sheet")
        self.size, self.sensors = self.body.size, self.layout.sensors(self.body)
        self.settings = read_touch(self.touch)
        self.task = TOUCH.with_labels(tuple(self.settings.labels))
        check_rate(self.slowest, self.settings.rate, "device.rate")
        self.imperfection = Imperfection.of(self, self.calibration, self.sensors.axes)
        self._kept: dict[Split | None, Recording] = {}

    def blank(self) -> Blank:
        """Return a device with one touch: few are simulated for it."""
        return Blank.of(self.task, self.size, self.touches("holdout"))

    def touches(self, split: Split, epoch: int = 0) -> Touches:
        """Return the touches of a split, which are the same in every epoch."""
        return self.recording(split).touches

    def recording(self, split: Split | None = None, epoch: int = 0, complete: bool = True) -> Recording:
        """Return the same touches with force and parameters; displacements are not computed."""
        if split not in self._kept:
            stream, key = (Stream.TEST, []) if split == "test" else (Stream.BUDGET, [self.data_seed])
            count = self.test_gestures if split == "test" else self.gestures
            rows = slice(None) if split in ("test", None) else split_rows(split, count, self.data_seed)
            drawn = self._draw(count, generator(stream, *key))
            true = self._simulate({name: values[rows] for name, values in drawn.items()})
            constants = draw_constants(
                self.imperfection,
                len(self.sensors),
                true.touches.rate,
                generator(Stream.CONSTANTS, self.seed),
            )
            self._kept[split] = with_imperfections(
                true,
                self.imperfection,
                None if self.randomise else constants,
                # Each split has noise of its own.
                generator(Stream.NOISE, self.seed, stream, *key, [None, *get_args(Split)].index(split)),
            )
        return self._kept[split]

    def _draw(self, count: int, random: np.random.Generator) -> Draws:
        """Draw touches: their objects, times, paths and forces."""
        # Size and danger follow from what is pressed: only dynamic and press, bits 1 and 2, are drawn.
        labels, side = balanced(count, random, range(0, 8, 2)), min(self.size)
        least, most = self.pressure
        kinds, sizes = random.choice(self.objects, count), random.random((count, 2))
        geoms, half, area = zip(*map(draw_object, kinds, sizes, [side] * count), strict=True)
        # Turned as far as there is room.
        angle, extents, spare = 2 * np.pi * random.random(count), np.array(half), self.settings.spare
        turned = np.abs(np.cos(angle))[:, None] * extents + np.abs(np.sin(angle))[:, None] * extents[:, ::-1]
        fits = (2 * turned + spare < self.size).all(axis=1)
        room = np.where(fits[:, None], turned, extents) + spare / 2
        drawn = draw_times(labels, self.settings, self.padded, random) | {
            "shape": np.array([self.objects.index(kind) for kind in kinds]),
            "geoms": np.array(geoms),
            "angle": np.where(fits, angle, 0),
            "low": -room,
            "high": room,
            "force": np.exp(random.uniform(np.log(least), np.log(most), count)) * area,
            "friction": random.uniform(*self.friction, count),
        }
        return drawn | draw_motion(labels[:, 1], drawn, self.settings, self.size, random.random((count, 4)))

    def _simulate(self, drawn: Draws) -> Recording:
        """Return the true readings of touches, with labels."""
        pressing, settings = Pressing(self.simulator(self.body, self.sensors), self.body), self.settings
        pressures, readings, travels = zip(
            *(
                self._press({name: values[row] for name, values in drawn.items()}, pressing)
                for row in range(len(drawn["force"]))
            ),
            strict=True,
        )
        frames, window = torch.cat(pressures), settings.frames.window
        index, scale = torch.arange(len(frames)).view(-1, window), torch.ones(len(pressures), window)
        force = frames.sum((1, 2))[index] * float(np.prod(self.body.cell))
        footprints = self.body.footprints(
            self.sensors if settings.over_sensors else cover_surface(self.body, self.sensors.footprint)
        )
        measures = measure_gestures(
            frames,
            index,
            scale,
            torch.from_numpy(footprints).float(),
            self.body.cell,
            settings.thresholds.contact,
        )
        # On coarse cells the centre of pressure of a light contact jumps; the object does not.
        parameters = {
            **{name: torch.from_numpy(drawn[name]).float() for name in _PARAMETERS},
            **{name: value.float() for name, value in measures._asdict().items()},
            "travel": torch.tensor(travels).float(),
            "force": force.amax(1),
            "peak": frames.flatten(1).amax(1)[index].amax(1),
            "excess": torch.from_numpy(
                settings.danger.excess(
                    *map(
                        np.asarray,
                        (measures.pressure, force.amax(1), measures.frames > settings.frames.duration),
                    )
                )
            ).float(),
        }
        movie = Movie(frames, index, scale, torch.empty(0), parameters)
        limits = report_labels(settings.thresholds, settings.rate, settings.limits) | dict(settings.labels)
        labels = [label.measure(movie, self.body) > label.above for label in limits.values()]
        true = torch.stack(readings)
        return Recording(
            Touches(
                true,
                torch.ones_like(true, dtype=torch.bool),
                torch.from_numpy(self.sensors.positions).float(),
                torch.stack(labels, dim=1).float(),
                float(settings.rate),
                geometry=sensor_geometry(self.body, self.sensors, pressing.simulator),
            ),
            self.task,
            self.size,
            self.sensors.footprint,
            force,
            parameters=parameters,
        )

    def _press(self, touch: Draws, pressing: Pressing) -> tuple[Tensor, Tensor, float]:
        """Return pressure (T, H, W), Pa, and true readings (T, S), N, of a touch in the middles of frames.

        The third result is the largest distance of the object's target from that of the first frame, m.
        """
        mujoco, window, rate = (
            load_package("mujoco", "mujoco"),
            self.settings.frames.window,
            self.settings.rate,
        )
        model = mujoco.MjModel.from_xml_string(
            press_world(str(touch["geoms"]), -float(touch["angle"]), float(touch["friction"]), self.body)
        )
        surface, data = MujocoSurface(model, "skin", self.body), mujoco.MjData(model)
        begin, end = (float(frame) / rate for frame in touch["onset"] + np.array([0, touch["duration"]]))
        times = np.arange(begin - 2 * _APPROACH, end - 0.5 / rate, _STEP)
        targets = self._targets(touch, times + _LAG, begin, end)
        data.qpos[:] = targets[0]
        pressed = list[tuple[Press, int]]()
        frames = int(touch["onset"]) + np.arange(int(touch["duration"]))
        middles = np.searchsorted(times, (frames + 0.5) / rate)
        for frame, part in zip(frames, np.split(targets, middles[:-1]), strict=True):
            for target in part:
                data.ctrl[:] = target
                mujoco.mj_step(model, data)
            pressed += [(press, int(frame)) for press in surface.presses(data)]
        way = targets[middles - 1, :2]
        return *pressing.frames(pressed, window), float(np.linalg.norm(way - way[0], axis=1).max())

    def _targets(self, touch: Draws, times: np.ndarray, begin: float, end: float) -> np.ndarray:
        """Return the target position of an object at some times, (N, 3), m: in the model, with y and z up."""
        fraction = np.clip(np.minimum(times - begin, end - times) * self.settings.ramp / (end - begin), 0, 1)
        lift = _LIFT * np.clip(np.maximum(begin - times, times - end) / _APPROACH, 0, 1)
        moved = touch["speed"] * self.settings.rate * np.clip(times - begin, 0, None)
        along = np.column_stack([moved * np.cos(touch["direction"]), moved * np.sin(touch["direction"])])
        position = fold(touch["start"] + along, touch["span"]) - touch["low"]
        depth = touch["force"] / _STIFFNESS + _OVERLAP * np.cbrt(touch["force"] / _NOMINAL)
        return np.column_stack([(position - np.array(self.size) / 2) * [1, -1], lift - fraction * depth])
