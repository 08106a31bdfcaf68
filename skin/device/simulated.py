"""A simulated skin: sampled gestures, a simulator, and device imperfections."""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import count
from typing import Annotated, Any

import numpy as np
import torch
from annotated_types import Ge
from torch import Tensor

from skin import __version__
from skin.body.base import AbstractBody, Sensors
from skin.body.layout import AbstractLayout
from skin.core.rng import Stream, generator
from skin.core.settings import checked
from skin.device.base import AbstractDevice, Split, grouped, joined, split_rows, split_slices
from skin.device.imperfection import Imperfection, ImperfectionSettings
from skin.device.resampling import check_rate
from skin.device.sampling import draw_constants, idle_excess, with_imperfections
from skin.device.touches import Part, Recording, Touches, TouchStream, draw_timeline, only_touches
from skin.errors import InputError
from skin.mechanics.contact.prescribed import Prescribed
from skin.mechanics.geometry import footprints, sensor_geometry
from skin.mechanics.relaxation import Relaxing, relaxes
from skin.mechanics.simulator.base import AbstractSimulator
from skin.touch.fingertips import read_touch
from skin.touch.labels import ALARM, TOUCH, TOUCH_OR_NOT, TOUCH_SLIDING
from skin.touch.movie import AbstractContact, AbstractSampler, Movie
from skin.touch.paths import TouchSettings

# The true sensors of a simulated device and its model of them.


def misplace(
    sensors: Sensors, size: tuple[float, float], error: float, seed: int, footprint_error: float = 0.0
) -> Sensors:
    """Return sensors beside their positions, with footprints of another size.

    Args:
        sensors: as touches report them.
        size: extent (x, y) of the sheet, m, on which they stay.
        error: standard deviation along x and along y, m.
        seed: of the device.
        footprint_error: standard deviation of the logarithm of the factor on the sides of all footprints.
    """
    drawn = generator(Stream.POSITION, seed)
    moves = drawn.standard_normal((len(sensors) // sensors.axes, 2)).repeat(sensors.axes, axis=0)
    positions = sensors.positions.copy()
    positions[:, :2] = np.clip(positions[:, :2] + error * moves, 0, size)
    if not footprint_error:
        return replace(sensors, positions=positions)
    factor = float(np.exp(footprint_error * drawn.standard_normal()))
    footprint = (sensors.footprint[0] * factor, sensors.footprint[1] * factor)
    return replace(sensors, positions=positions, footprint=footprint)


def cover_surface(body: AbstractBody, footprint: tuple[float, float], rounding: float = 1e-9) -> Sensors:
    """Return a sensor at each cell of a body whose footprint lies wholly on it.

    Their footprints are the areas over which a pressure can be dangerous anywhere.
    """
    margins = [max(extent, cell) / 2 for extent, cell in zip(footprint, body.cell, strict=True)]
    cells = [(np.arange(count) + 0.5) * cell for count, cell in zip(body.cells, body.cell, strict=True)]
    x, y = (
        centres[(centres >= margin - rounding) & (centres <= size - margin + rounding)]
        for centres, size, margin in zip(cells, body.size, margins, strict=True)
    )
    positions = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    return Sensors(np.column_stack([positions, np.zeros(len(positions))]), footprint)


def build_model(
    simulator: Callable[[AbstractBody, Sensors], AbstractSimulator],
    body: AbstractBody,
    sensors: Sensors,
    rate: float,
) -> AbstractSimulator:
    """Return the simulator of a body with sensors; in time, at ``rate`` in Hz, where a material relaxes."""
    return Relaxing(simulator, body, sensors, rate) if relaxes(body) else simulator(body, sensors)


# Metadata of simulated recordings.


_VERSIONS = {"skin": __version__, "torch": torch.__version__, "numpy": np.__version__}


def describe(device: "Simulated", recording: Recording, split: Split | None, epoch: int) -> dict[str, Any]:
    """Return how a recording was made, and a summary of its touches.

    Args:
        device: that made it.
        recording: the touches.
        split: None: the whole budget.
        epoch: of ``train``.
    """
    return {
        "source": "simulated",
        "simulator": type(device.model).__name__,
        "split": split or "budget",
        "epoch": epoch,
        "device_seed": device.seed,
        "data_seed": device.data_seed,
        "shapes": list(device.sampler.shapes.names),
        "summary": summarise(only_touches(recording), device.body),
        "versions": _VERSIONS,
        **({"limits": str(limits)} if (limits := device.sampler.settings.limits) else {}),
    }


# Leakage of labels by the shape of the touching body.


def check_label_leakage(device: AbstractDevice, recording: Recording | None = None) -> None:
    """Warn if the shape alone predicts a label of the gestures that a simulated device is trained on.

    A label leaks if the balanced accuracy of the prediction is above ``touch.leak`` by more than two standard
    errors; the margin keeps small data sets from warnings by chance.

    Args:
        device: the device; nothing is done unless it is simulated.
        recording: its gestures; None: its training budget.
    """
    if device.simulation is None:
        return
    sampler = device.simulation.sampler
    recording = only_touches(recording or device.recording(None, complete=False))
    shape = recording.parameters["shape"].numpy().astype(int)
    labels = dict(zip(recording.task.names, recording.touches.known_labels.numpy().T > 0.5, strict=True))
    scores = {name: accuracy_from_shape(shape, labels[name]) for name in sampler.labels if name in labels}
    leaking = [
        f"{name} ({score:.0%})" for name, (score, error) in scores.items() if score - 2 * error > sampler.leak
    ]
    if leaking:
        warnings.warn(
            f"the shape alone predicts {' and '.join(leaking)} of these gestures, more than "
            f"touch.leak={sampler.leak:g} allows: a model may learn the shape instead of the label; give "
            "touch.shapes of one kind, raise touch.stretch, or give touch.leak=0.5, which fits every shape "
            "to the sheet",
            RuntimeWarning,
            stacklevel=2,
        )


def accuracy_from_shape(shape: np.ndarray, holds: np.ndarray) -> tuple[float, float]:
    """Return the balanced accuracy of predicting a label from the shape, and its standard error.

    The prediction is leave-one-out: each touch is assigned to the class in which its shape is more frequent
    among all other touches. The accuracy is 0.5 if a class has fewer than two touches.

    Args:
        shape: (B,), whole numbers from 0.
        holds: (B,), bool; the label.
    """
    counts = np.array([np.bincount(shape[holds == side], minlength=shape.max() + 1) for side in (0, 1)])
    totals = counts.sum(axis=1, keepdims=True)
    if totals.min() < 2:
        return 0.5, 0.0
    others, against = (counts - 1) / (totals - 1), (counts / totals)[::-1]
    right = np.where(np.isclose(others, against), 0.5, others > against)
    rates = (counts * right).sum(axis=1) / totals[:, 0]
    return float(rates.mean()), float(np.sqrt((rates * (1 - rates) / totals[:, 0]).sum()) / 2)


# Summary of a data set in one line: forces, strains, clipped readings, accepted draws.


def summarise(recording: Recording, body: AbstractBody) -> dict[str, Any]:
    """Return what a simulated data set is like, as fractions of 1 and SI units.

    The strain is the largest of the top layer by the linear solution or, where a recording has none, its
    highest pressure by its modulus. Linear theory is good to about 0.3; beyond 1 a linear layer would be
    squeezed to nothing. The report's thresholds are kept all the same.

    Returns:
        gestures; acceptance (fraction of draws kept); force (N: quantiles .05, .5, .95 and the largest);
        strain_over_30_percent and strain_over_100_percent; strain_solved (else pressure by modulus);
        clipped and clipped_dangerous (gestures in which a sensor passes the clip, of all and of the dangerous
        ones); unconverged (frames whose pressure was not found, so that their gestures were drawn again),
        where it had to be.
    """
    parameters, labels = recording.parameters, recording.touches.labels
    assert labels is not None
    strain = parameters.get("strain", parameters["peak"] / body.layers[-1].material.young)
    force = torch.quantile(parameters["force"], torch.tensor([0.05, 0.5, 0.95, 1.0]))
    dangerous = labels[:, recording.task.names.index(ALARM)] > 0.5
    return {
        "gestures": len(recording),
        "acceptance": len(recording) / float(parameters["draws"].sum()),
        "force": dict(zip(("q05", "q50", "q95", "largest"), force.tolist(), strict=True)),
        "strain_over_30_percent": float((strain > 0.3).float().mean()),
        "strain_over_100_percent": float((strain > 1).float().mean()),
        "strain_solved": "strain" in parameters,
        "clipped": float(parameters["clipped"].mean()),
        "clipped_dangerous": float(parameters["clipped"][dangerous].mean()) if dangerous.any() else 0.0,
        **{name: int(parameters[name].sum()) for name in ("unconverged",) if name in parameters},
    }


def summary_line(summary: dict[str, Any]) -> str:
    """Return a summary in one line."""
    force = summary["force"]
    strain = "strain" if summary.get("strain_solved") else "pressure by modulus"
    solved = f"; {summary['unconverged']} frames not solved" if "unconverged" in summary else ""
    return (
        f"{summary['gestures']} gestures, {summary['acceptance']:.0%} of draws kept; force median "
        f"{force['q50']:.0f} N (5 to 95 %: {force['q05']:.0f} to {force['q95']:.0f} N, largest "
        f"{force['largest']:.0f} N); {strain} over 30 % in {summary['strain_over_30_percent']:.0%}, "
        f"over 100 % in {summary['strain_over_100_percent']:.0%}; clipped {summary['clipped']:.0%} "
        f"({summary['clipped_dangerous']:.0%} of dangerous){solved}"
    )


_BATCH = 1024


@checked("device")
@dataclass(kw_only=True, eq=False)
class Simulated(ImperfectionSettings, AbstractDevice):
    """Yields simulated gestures, measured by a device with imperfections.

    Training, validation and holdout are 80/10/10 of one budget of gestures; test gestures come from a stream
    of randomness that no training seed can select, and are the same for all seeds.

    Args:
        body, layout: the sheet, and the positions of its sensors.
        simulator: ``simulator(body, sensors)`` gives the map from pressure to true readings.
        contact: ``contact(body, simulator)`` gives the pressure of a gesture.
        touch: kind and difficulty of the touches (``conf/touch``).
        gestures, test_gestures: number of gestures of the budget and of ``test``.
        padded: gestures begin at a random frame of the window, not at its first.
        fresh: ``train`` draws new gestures, with new noise, in every epoch.
        stream: touches are windows of streams of gestures with idle gaps between them: a window contains part
            of a gesture, a whole one or none, and also has the label ``touch``. Splits have other streams.
        direction: the direction of sliding is a label too, as its cosines
            (``skin.touch.movie.sliding``).
        data_seed: seed of the budget.
        seed: seed of the device's constants and noise; each seed is another device.
        gain_spread, offset, noise, ... rate: :class:`skin.device.imperfection.ImperfectionSettings`. The rate
            is the one of the sensors; touches are resampled to ``touch.rate``.
        calibration: file of skin calibrate, which replaces all these but dead, tare and rate.
        randomise: measure every gesture with another device.
        position_error: standard deviation of the true sensor positions from the reported ones, m.
        footprint_error: standard deviation of the logarithm of the true over the reported side of footprints.
        described: ``described(body, sensors)``, the simulator that :attr:`geometry` reports the responses of;
            None: ``simulator``.

    Attributes:
        sensors: S sensors, at the positions that touches report.
        model: maps pressure to the true readings of the sensors at their true positions.
        sampler: draws the touches.
        window: frames per touch.
        model_rate: frames per second of touches, Hz.
        imperfection: distribution of the imperfections of such devices.
        constants: imperfections of this device.

    Raises:
        InputError: invalid settings.
    """

    body: AbstractBody
    layout: AbstractLayout
    simulator: Callable[[AbstractBody, Sensors], AbstractSimulator]
    contact: Callable[[AbstractBody, AbstractSimulator], AbstractContact] = Prescribed
    touch: Mapping[str, Any] | TouchSettings | None = None
    gestures: Annotated[int, Ge(10)] = 4038
    test_gestures: Annotated[int, Ge(1)] = 4000
    padded: bool = True
    fresh: bool = False
    stream: bool = False
    direction: bool = False
    data_seed: int = 0
    seed: int = 0
    calibration: str | None = None
    randomise: bool = False
    position_error: Annotated[float, Ge(0)] = 0.0
    footprint_error: Annotated[float, Ge(0)] = 0.0
    described: Callable[[AbstractBody, Sensors], AbstractSimulator] | None = None

    def __post_init__(self) -> None:
        settings = read_touch(self.touch)
        if self.direction and (self.stream or settings.ongoing):
            raise InputError(
                "data.direction=true needs whole gestures: leave out data.stream=true and touch.ongoing"
            )
        if self.stream and relaxes(self.body):
            raise InputError(
                "a skin that relaxes is simulated touch by touch from rest, where it stays, got "
                "data.stream=true: leave that out, or the materials' relaxation"
            )
        self.size, self.sensors = self.body.size, self.layout.sensors(self.body)
        self.true_sensors = misplace(
            self.sensors, self.size, self.position_error, self.seed, self.footprint_error
        )
        task = TOUCH_OR_NOT if self.stream else TOUCH_SLIDING if self.direction else TOUCH
        self.task = task.with_labels(tuple(settings.labels))
        self.window, self.model_rate = settings.frames.window, float(settings.rate)
        check_rate(self.slowest, self.model_rate, "device.rate")
        self.model = build_model(self.simulator, self.body, self.true_sensors, self.model_rate)
        self.sampler = self._sampler(self.body, self.true_sensors, self.model)
        if self.sampler.settings.shear:
            self.model.refuse_shear()
        self.imperfection = Imperfection.of(self, self.calibration, self.sensors.axes)
        drawn = generator(Stream.CONSTANTS, self.seed)
        self.constants = draw_constants(self.imperfection, len(self.sensors), self.model_rate, drawn)
        self._kept: dict[str, Recording] = {}

    def _sampler(self, body: AbstractBody, sensors: Sensors, model: AbstractSimulator) -> AbstractSampler:
        contact, settings = self.contact(body, model), read_touch(self.touch)
        judged = sensors if settings.over_sensors else cover_surface(body, sensors.footprint)
        moments = footprints(body, judged) if model.smooth else None
        return settings.sampler(body, body.footprints(judged), contact, self.padded, moments)

    @cached_property
    def geometry(self) -> Tensor:
        """Where the sensors are and what they respond to, (S, G), :data:`skin.device.touches.GEOMETRY`."""
        same = self.position_error == self.footprint_error == 0 and self.described is None
        simulator = self.described or self.simulator
        model = self.model if same else build_model(simulator, self.body, self.sensors, self.model_rate)
        return sensor_geometry(self.body, self.sensors, model)

    @property
    def simulation(self) -> "Simulated":
        """This device."""
        return self

    @property
    def idle(self) -> Tensor:
        """What the untouched skin reads on average, (S,), N; 0 for dead sensors."""
        excess = idle_excess(self.constants, self.model_rate)
        level = self.constants.offset - self.constants.baseline + excess
        return level.masked_fill(self.constants.dead, 0.0)

    def blank(self) -> "Simulated":
        """Return a device with few gestures: to restore a run, only their shape matters."""
        return self.replace(gestures=10, fresh=False)

    def replace(self, **changes: Any) -> "Simulated":
        """Return a device with other settings, such as ``seed=3`` for another device of the same kind."""
        return replace(self, **changes)

    def touches(self, split: Split, epoch: int = 0) -> Touches:
        """Return the touches of a split; those that do not depend on the epoch are cached."""
        return self._split(split, epoch, complete=False).touches

    def fresh_touches(self, count: int) -> Touches:
        """Return touches that belong to no split, for choosing a threshold after the training."""
        return self.draw(Stream.ALARM, count, self.data_seed)

    @torch.no_grad()
    def press_readings(self, covered: float = 0.03) -> Tensor:
        """Return the true readings (S, S), N, of a press at the limit of ``dangerous`` on each sensor.

        Row i is of a disc of even pressure around sensor i.

        Args:
            covered: fraction of the sheet under a press: small, and larger than any footprint.
        """
        (width, height), footprint = self.size, np.hypot(*self.sensors.footprint)
        radius = max(np.sqrt(covered * width * height / np.pi), footprint / 2)
        rows, columns = self.body.shape
        y, x = np.indices((rows, columns)) + 0.5
        positions = np.stack([x * width / columns, y * height / rows])
        away = self.true_sensors.positions[:, :2, None, None] - positions
        discs = torch.from_numpy(np.hypot(*away.swapaxes(0, 1)) <= radius).float()
        danger = self.sampler.settings.danger
        return self.model(min(danger.pressure, danger.force / (np.pi * radius**2)) * discs).readings

    def draw(self, stream: Stream, count: int, *key: int) -> Touches:
        """Return touches of a stream of randomness at a key."""
        return joined(self._batches(False, stream, count, *key)).touches

    def recording(self, split: Split | None = None, epoch: int = 0, complete: bool = True) -> Recording:
        """Return the same touches with the applied force and the gestures' parameters.

        Args:
            split: None takes the whole budget.
            epoch: used by ``train`` with fresh gestures.
            complete: include the displacements and the largest strains.
        """
        recording = self._split(split, epoch, complete)
        return replace(recording, metadata=describe(self, recording, split, epoch))

    def strips(self, seconds: float = 600.0) -> Iterator[Touches]:
        """Yield test streams of so many seconds each, without end."""
        for number in count():
            yield self.simulate_stream(max(1, round(seconds * self.model_rate)), number=number).whole.touches

    def _split(self, split: Split | None, epoch: int, complete: bool) -> Recording:
        if split == "train" and self.fresh:
            count = split_slices(self.gestures)["train"].stop
            return joined(self._batches(complete, Stream.FRESH, count, self.data_seed, epoch))
        name = "test" if split == "test" else "budget"
        recording = None if complete else self._kept.get(name)
        if recording is None:
            tested = self._batches(complete, Stream.TEST, self.test_gestures) if split == "test" else None
            recording = joined(self._budget(complete) if tested is None else tested)
            self._kept |= {} if complete else {name: recording}
        if split in ("test", None):
            return recording
        # Windows of a stream overlap, so each split has streams of its own.
        rows = split_slices(self.gestures)[split] if self.stream else None
        return recording[split_rows(split, self.gestures, self.data_seed) if rows is None else rows]

    def parts(self, split: Split | None = None) -> list[Part] | None:
        """Return the budget in parts, together ``recording(complete=False)``; None for a split.

        Each part is drawn on one thread, with metadata of its own.
        """
        return (
            grouped(self._budget(False), lambda touches: describe(self, touches, None, 0))
            if split is None
            else None
        )

    def _budget(self, complete: bool) -> list[Part]:
        """Return the batches of the budget."""
        draw = partial(self._batches, complete, Stream.BUDGET)
        if not self.stream:
            return draw(self.gestures, self.data_seed)
        counts = [len(range(self.gestures)[rows]) for rows in split_slices(self.gestures).values()]
        return [batch for n, count in enumerate(counts) for batch in draw(count, self.data_seed, n)]

    def _batches(self, complete: bool, stream: Stream, count: int, *key: int) -> list[Part]:
        """Return the batches of gestures or windows; ``complete`` adds the displacements."""
        cuts = [slice(first, min(first + _BATCH, count)) for first in range(0, count, _BATCH)]
        if self.stream:
            jobs = [partial(self._windows, cut, complete, stream, (*key, n)) for n, cut in enumerate(cuts)]
        else:
            labels = self.sampler.balanced(count, generator(stream, *key, 0))
            jobs = [
                partial(self._batch, labels[cut], complete, stream, (*key, 1 + n))
                for n, cut in enumerate(cuts)
            ]
        return [Part(cut.stop - cut.start, job) for cut, job in zip(cuts, jobs, strict=True)]

    @torch.no_grad()
    def _batch(self, labels: np.ndarray, complete: bool, stream: Stream, key: tuple[int, ...]) -> Recording:
        movie = self.sampler.sample(len(labels), generator(stream, *key), labels)
        return self._apply_imperfections(
            self._simulate_true(movie, complete), generator(Stream.NOISE, self.seed, stream, *key)
        )

    @torch.no_grad()
    def _windows(self, part: slice, complete: bool, stream: Stream, key: tuple[int, ...]) -> Recording:
        """Cut as many windows from a stream as ``part`` is long."""
        draw, noise = generator(stream, *key), generator(Stream.NOISE, self.seed, stream, *key)
        frames, count = self.sampler.settings.frames, part.stop - part.start
        starts = np.cumsum(draw.integers(*frames.stride, count, endpoint=True)) - frames.stride[0]
        length = int(starts[-1]) + self.window
        timeline = draw_timeline(self.sampler, length, frames.gap, draw)
        true = TouchStream.of(timeline, self._simulate_true(timeline.movie, complete))
        if self.randomise:
            return self._apply_imperfections(true.cut(torch.from_numpy(starts), self.window), noise)
        return TouchStream(timeline, self._apply_imperfections(true.whole, noise)).cut(
            torch.from_numpy(starts), self.window
        )

    @torch.no_grad()
    def simulate_stream(self, frames: int, gap: Sequence[int] | None = None, number: int = 0) -> TouchStream:
        """Return a test stream in one piece, to be cut as one likes; one device feels all of it.

        Args:
            frames: its length, frames.
            gap: [least, most] idle frames between two touches; None: ``touch.gap``.
            number: of the stream; each number gives other gestures.
        """
        if self.randomise:
            return self.replace(randomise=False).simulate_stream(frames, gap, number)
        key = Stream.TEST, 1, number
        gap = gap or self.sampler.settings.frames.gap
        timeline = draw_timeline(self.sampler, frames, gap, generator(*key))
        true = TouchStream.of(timeline, self._simulate_true(timeline.movie, complete=False))
        return TouchStream(
            timeline, self._apply_imperfections(true.whole, generator(Stream.NOISE, self.seed, *key))
        )

    def _simulate_true(self, movie: Movie, complete: bool) -> Recording:
        """Return the true readings of gestures; ``complete`` adds displacements and strains."""
        readings, displacement = self.model.respond(movie, displacement=complete)
        positions = torch.from_numpy(self.sensors.positions).float()
        valid = torch.ones_like(readings, dtype=torch.bool)
        labels = torch.cat([movie.labels, movie.slides], dim=1) if self.direction else movie.labels
        touches = Touches(
            readings,
            valid,
            positions,
            labels,
            self.model_rate,
            geometry=self.geometry,
            contacts=movie.contacts,
        )
        strain = self.model.strain(movie.frames, movie.shear) if complete else None
        true_values = {} if strain is None else {"strain": (strain[movie.index] * movie.scale).amax(1)}
        # Windows of streams get the label touch, too.
        task = TOUCH.with_labels(tuple(self.sampler.settings.labels)) if self.stream else self.task
        return Recording(
            touches,
            task,
            self.size,
            self.sensors.footprint,
            movie.force,
            displacement,
            movie.parameters | true_values,
        )

    def _apply_imperfections(self, true: Recording, noise: np.random.Generator) -> Recording:
        """Return true readings with the imperfections of the device."""
        return with_imperfections(
            true,
            self.imperfection,
            None if self.randomise else self.constants,
            noise,
            ongoing=self.sampler.settings.ongoing > 0,
        )
