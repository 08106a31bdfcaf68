"""Contacts in the live view: where, how hard and how sure, estimated in a process of their own.

No verdict waits for them: the loop hands over the newest readings once the process has answered, and
continues. The process ends with its present estimate when the pipe to it is closed, however the command ends.
torch is not imported here, but in that process.
"""

import os
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from skin.device.resampling import INWARDS
from skin.errors import InputError
from skin.evaluation.decisions import DECISIONS, DRIFT
from skin.evaluation.operating_point import start_beside
from skin.inference.mechanics import QUIET, Mechanics
from skin.live.verdict import Verdict
from skin.wire.channels import NewtonFrame, UnitConversion
from skin.wire.tare import Tare

if TYPE_CHECKING:
    from skin.inference.noise import Noise
    from skin.inference.posterior import Posterior

# What is known of contacts, as JSON data.


def unknown_contacts(reason: str) -> dict[str, Any]:
    """Return the message that nothing is known of contacts, with the reason."""
    names = "device_time", "number", "probability", "probabilities", "fit", "large", "thickness"
    return {"state": "unknown", "reason": reason, **dict.fromkeys(names), "contacts": [], "changed": []}


def contact_text_lines(message: dict[str, Any]) -> list[str]:
    """Return what is known of contacts in words, a line for each."""
    state, number, contacts = message["state"], message["number"], [*map(_words, message["contacts"])]
    if state == "unknown":
        return [f"contacts unknown: {message['reason']}"]
    head = (
        f"{number or 'no'} contact{'s' * ((number or 0) > 1)} ({100 * (message['probability'] or 0):.0f} %)"
    )
    if state == "not a fingertip":
        head = f"{state} (fit {message['fit']:.2g}, a larger contact {100 * message['large']:.0f} %)"
        contacts = [f"best: {words}" for words in contacts]
    if message["thickness"]:
        fits, described = (1e3 * thickness for thickness in message["thickness"])
        contacts.append(f"readings fit {fits:.3g} mm better than the described {described:.3g} mm")
    return [head, *contacts, *filter(None, [message["reason"]])]


def _words(contact: dict[str, Any]) -> str:
    x, y, *near = (1000 * contact[name] for name in ("x", "y", "x_deviation", "y_deviation"))
    low, high = (pressure / 1000 for pressure in contact["peak_interval"])
    return (
        f"({x:.0f}, {y:.0f}) ± {max(near):.0f} mm, {contact['force']:.1f} ± "
        f"{contact['force_deviation']:.1f} N, {low:.0f} to {high:.0f} kPa"
    )


# What is sent to the process.


class MeanReadings(NamedTuple):
    """The mean readings of a moment.

    Attributes:
        values: (S,), N above the untouched skin: the mean of some frames.
        valid, saturated: (S,), bool.
        noise: standard deviation of a frame, N; None: unknown.
        frames: number of frames.
        step: of the converter, N; 0: none.
        time, host: s, the clocks of the device and of the host at the latest frame.
        tare: identity of the tare or calibration that they follow.
    """

    values: np.ndarray
    valid: np.ndarray
    saturated: np.ndarray
    noise: float | None
    frames: int
    step: float
    time: float
    host: float
    tare: int = 0


def average_readings(
    stream: Sequence[NewtonFrame],
    conversion: UnitConversion,
    masked: Sequence[int],
    baseline: np.ndarray,
    whole: bool,
) -> MeanReadings:
    """Return the mean of readings, the latest last.

    Args:
        stream: of a moment.
        conversion: of the values to N.
        masked: sensors without a valid reading.
        baseline: (S,), N, what the untouched skin reads by now.
        whole: the device sends whole numbers.
    """
    newtons, frame = np.stack([readings.newtons for readings in stream]), stream[-1].frame
    usable = [readings.usable for readings in stream]
    works = np.logical_and.reduce(usable) & ~np.isin(np.arange(len(usable[0])), masked)
    # The zero is that of largest values of intervals, which noise raises above the mean.
    rest = baseline if conversion.rest is None else baseline + conversion.rest
    noise = None if conversion.noise is None or not works.any() else conversion.noise[works]
    return MeanReadings(
        newtons.mean(axis=0, dtype=float) - rest,
        works,
        np.any([readings.saturated for readings in stream], axis=0) & works,
        None if noise is None else float(np.sqrt(np.mean(noise**2))),
        len(stream),
        float(np.median(np.abs(conversion.scale))) if whole else 0.0,
        frame.t,
        frame.t_host,
    )


def estimate_contacts(posterior: "Posterior", nominal: "Noise", readings: MeanReadings) -> dict[str, Any]:
    """Return the contacts estimated from readings, as JSON data.

    Args:
        posterior: of the skin.
        nominal: noise of such devices: its gains and positions hold for this one, too.
        readings: of a moment.
    """
    if not readings.valid.any():
        return unknown_contacts("no sensor has a valid reading")
    rounding = readings.step / 12**0.5
    # Without a tare, the device's offsets are unknown, too.
    frame, offset = (nominal.frame, nominal.offset) if readings.noise is None else (readings.noise, rounding)
    # Of a channel along the surface, it is unknown at which of its two limits it is.
    inwards = np.arange(1, 1 + len(readings.values)) % posterior.candidates.axes == 0
    limits = readings.values[readings.saturated & inwards]
    # A sensor at its limit says that it would read more: than the least of them, if there are several.
    clip = max(float(limits.min()), QUIET) if len(limits) else np.inf
    posterior.noise = replace(
        nominal, frame=max(frame, rounding, QUIET), frames=readings.frames, offset=offset, clip=clip
    )
    estimate = posterior.estimate(readings.values, readings.valid, readings.saturated)
    assert not isinstance(estimate, list)
    return estimate.to_json(readings.time)


# The process.


def serve(mechanics: Mechanics, pipe: Connection) -> None:
    """Prepare the mechanics, then answer readings with messages until the pipe is closed."""
    from skin.inference.likelihood import Observation
    from skin.inference.watch import Thickness, Watch

    if hasattr(os, "nice"):
        os.nice(5)  # below what shows verdicts
    os.dup2(2, 1)  # what a library prints is no JSON line
    threadpool_limits(1)  # of BLAS and of torch, which the mechanics have loaded
    posterior, tare, thickness = mechanics.posterior(), -1, None
    with suppress(EOFError, OSError):  # the command has ended
        while True:
            readings = pipe.recv()
            if readings.tare != tare:
                watch, tare = Watch(posterior.candidates, posterior.prior, mechanics.noise), readings.tare
            try:
                thickness = thickness or Thickness(mechanics, posterior)
                message = estimate_contacts(posterior, thickness.noise, readings)
                watch.look(readings.values, readings.valid & ~readings.saturated, posterior.noise)
                thickness.look(
                    Observation.of(readings.values, readings.valid, readings.saturated, posterior.noise),
                    message["number"],
                )
            except (ArithmeticError, ValueError, AssertionError, InputError) as error:
                message = unknown_contacts(f"the estimate failed: {error}")
            pipe.send(message | {"changed": [*watch.changed], "thickness": thickness and thickness.doubt})


class LiveContacts:
    """The latest estimate of the contacts, and the process that makes it.

    Args:
        reason: why nothing is known before :meth:`start`.
        stale: s after its readings from which an estimate is unknown.
        span: s of which the readings are averaged.

    Attributes:
        changed: sensors that have changed since the latest tare.
        three: tare of all channels, where readings are those inwards of sites with three axes; else None.
        tangential: (S, 2), N along x and y at the latest frame of such a skin; None: unknown.
    """

    three: Tare | None = None
    tangential: np.ndarray | None = None
    _conversion: UnitConversion | None = None

    def __init__(
        self, reason: str = "this view estimates none", stale: float = 0.5, span: float = 0.1
    ) -> None:
        self.stale, self._span = stale, span
        self._recent: deque[NewtonFrame] = deque(maxlen=1000)
        self._pipe: Connection | None = None
        self.changed: tuple[int, ...] = ()
        self._asked_at: float | None = None  # the host's time, s, of readings that are not answered yet
        self.explain(reason)

    def explain(self, reason: str) -> None:
        """Set why nothing is known, until there is an estimate."""
        self._latest = unknown_contacts(reason), np.inf  # with the host's time of its readings, s

    def start(self, mechanics: Mechanics, whole: Callable[[], bool]) -> None:
        """Start the process, which needs some seconds. To be called in the main thread.

        Args:
            mechanics: of the skin.
            whole: tells whether the device sends whole numbers.
        """
        self._whole = whole
        self.explain("being prepared")
        self.process, self._pipe = start_beside(serve, "skin-contacts", mechanics)

    def close(self) -> None:
        """End the process."""
        if self._pipe is not None:
            self.process.kill()
            self.process.join()
            self._pipe.close()

    def look(
        self,
        stream: Sequence[NewtonFrame],
        conversion: UnitConversion,
        verdicts: Sequence[Verdict],
        baseline: np.ndarray,
    ) -> None:
        """Take new readings, and the answer of the process; if there is a verdict, ask it again.

        It returns at once: the process is asked only after it has answered.

        Args:
            stream: the readings.
            conversion: of the values to N.
            verdicts: on them.
            baseline: (S,), N, what the untouched skin reads by now.
        """
        masked: Sequence[int] = verdicts[-1].masked if verdicts else ()
        if self.three is not None:
            stream = [each.three for each in stream if each.three is not None]
            conversion, masked = self.three.conversion or conversion, [3 * number + 2 for number in masked]
            if stream:
                baseline = self._rest_of_axes(stream[-1].newtons, conversion, verdicts, baseline)
        self._conversion = conversion  # kept, so that the next one has another identity
        if self._pipe is None or not stream:
            return
        self._recent.extend(stream)
        last = stream[-1].frame
        while (first := self._recent[0].frame).segment != last.segment or not (
            0 <= last.t - first.t < self._span - 1e-6
        ):
            self._recent.popleft()
        try:
            if self._asked_at is not None and self._pipe.poll():
                self._latest, self._asked_at = (self._pipe.recv(), self._asked_at), None
                each, changed = 1 if self.three is None else 3, self._latest[0]["changed"]
                self.changed = tuple(number // each for number in changed if number % each == each - 1)
                self._latest[0]["changed"] = [*self.changed]
            if verdicts and self._asked_at is None:
                readings = average_readings(self._recent, conversion, masked, baseline, self._whole())
                self._pipe.send(readings._replace(tare=id(conversion)))
                self._asked_at = last.t_host
        except (OSError, EOFError):
            self.explain("the process that estimates them has ended")

    def _rest_of_axes(
        self,
        newtons: np.ndarray,
        conversion: UnitConversion,
        verdicts: Sequence[Verdict],
        inwards: np.ndarray,
    ) -> np.ndarray:
        """Return what all channels read untouched, (3 S,), N, given that of those ``inwards``, (S,), N.

        That of the others follows as slowly as a baseline does, while nothing touches the skin.
        """
        if conversion is not self._conversion:
            self._drift = np.zeros(len(newtons))
        self._drift[INWARDS] = inwards
        rise = newtons - self._drift - (0.0 if conversion.rest is None else conversion.rest)
        self.tangential = rise.reshape(-1, 3)[:, :2]
        limit = DRIFT / DECISIONS * sum(verdict.state != "touch" for verdict in verdicts)
        self._drift = self._drift + np.clip(rise, -limit, limit)
        return self._drift

    def state(self, now: float) -> dict[str, Any]:
        """Return what is known at ``now``, s, on the host's monotonic clock, as JSON data."""
        message, host = self._latest
        return message if now - host <= self.stale else unknown_contacts("no estimate for half a second")
