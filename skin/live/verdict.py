"""The verdict of a live view: state, labels, alarm, notes on what may be wrong; in words and as JSON data."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from math import isfinite, nan
from typing import Any, Literal, NamedTuple

from skin.touch.labels import OPPOSITE

State = Literal["touch", "no touch", "unknown"]

NOTES = {
    "stale": "{text}",
    "below": "{sensors} below rest: a broken wire, device.scale of the wrong sign, or a tare under load",
    "void": "the baseline of {sensors} is void, as readings fell below it: tare the untouched skin",
    "over_range": "values of {sensors} were lost or cut off under force: beyond the range, or a broken wire",
    "unreadable": "more frames are unreadable in this contact than at rest: values beyond the range?",
    "lost_wire": "{sensors} fell to rest while neighbours stay pressed: a broken wire",
    "changed": "{sensors} have changed, by what the others read: check, calibrate or tare the skin",
    "masked": "a touch near {sensors} may stay undetected: no valid reading",
    "pause": "no frame for {seconds:.2f} s, in which a touch may have come and gone",
    "near_threshold": "probably dangerous, but below the threshold of the alarm",
    "unverified": "{text}",
    "clock": "{text}",
    "provisional": "the threshold of the alarm is provisional and raises more false alarms{text}",
    "guarantee_lapsed": "a guarantee that has lapsed: {text}",
    "guarantee_unverified": "a guarantee for a device whose scale or range is unverified: {text}",
    "guarantee_valid": "guarantee: {text}",
}
"""Code of each note -> its sentence, the gravest first."""

LASTING = frozenset(("over_range", "unreadable", "lost_wire"))
"""Notes with which no touch is safe, until it ends."""


def sensor_list(sensors: Sequence[int], maximum: int = 3) -> str:
    """Return the numbers of sensors in words, at most so many."""
    omitted = f" and {len(sensors) - maximum} more" if len(sensors) > maximum else ""
    numbers = ", ".join(map(str, sensors[:maximum]))
    return f"sensor{'s' * (len(sensors) > 1)} {numbers}{omitted}"


class Note(NamedTuple):
    """What may be wrong with a verdict.

    Attributes:
        code: one of :data:`NOTES`.
        sensors: that it is about.
        seconds: that it is about.
        detail: text of a note on the whole session.
    """

    code: str
    sensors: tuple[int, ...] = ()
    seconds: float = 0.0
    detail: str = ""

    @property
    def text(self) -> str:
        """The note in words."""
        return NOTES[self.code].format(
            sensors=sensor_list(self.sensors), seconds=self.seconds, text=self.detail
        )

    @property
    def message(self) -> dict[str, Any]:
        """The note as JSON data."""
        return {"code": self.code, "text": self.text, "sensors": list(self.sensors)}


def order_notes(notes: Iterable[Note]) -> tuple[Note, ...]:
    """Return notes, the gravest first."""
    return tuple(sorted(notes, key=lambda note: list(NOTES).index(note.code)))


def summarize_notes(notes: Sequence[Note]) -> str:
    """Return the gravest of ordered notes, and the number of the others; empty if nothing is wrong."""
    text, *others = [note.text for note in notes if note.code != "guarantee_valid"] or [""]
    return text + (f" (and {len(others)} more note{'s' * (len(others) > 1)})" if others else "")


@dataclass(frozen=True)
class Verdict:
    """Classification of a window.

    Attributes:
        t: s, the device's clock at the latest frame.
        t_host: s, the host's clock at that frame.
        probabilities: label -> its probability in this window; of ``dangerous`` the largest since the alarm
            was raised, while it lasts.
        touched: debounced; if False, nothing touches the skin and the labels are meaningless.
        labels: label -> debounced prediction; empty without touch.
        dangerous: the alarm, which lasts until the contact ends.
        gap: whether frames are missing in the window.
        masked: sensors without a valid reading.
        contact: duration of the contact, s; None without contact.
        unknown: sensors where a dangerous touch may stay undetected: they have no valid reading.
        notes: on what may be wrong, the gravest first.
        agreeing: label -> its probability in the latest window that agreed with the debounced label; where it
            is missing, that of this window.
    """

    t: float
    t_host: float
    probabilities: dict[str, float] = field(default_factory=dict)
    touched: bool = False
    labels: dict[str, bool] = field(default_factory=dict)
    dangerous: bool = False
    gap: bool = False
    masked: tuple[int, ...] = ()
    contact: float | None = None
    unknown: tuple[int, ...] = ()
    notes: tuple[Note, ...] = ()
    agreeing: dict[str, float] = field(default_factory=dict)

    @property
    def state(self) -> State:
        """``touch``; ``unknown``, if a dangerous touch on a sensor may stay undetected; or ``no touch``."""
        return (
            "touch" if self.touched or self.contact is not None else "unknown" if self.unknown else "no touch"
        )

    @property
    def danger(self) -> bool | None:
        """Whether the touch is dangerous; None where that can be neither said nor excluded."""
        uncertain = self.unknown or any(note.code in {*LASTING, "near_threshold"} for note in self.notes)
        return True if self.dangerous else None if uncertain else False

    @property
    def known(self) -> dict[str, bool | None]:
        """The labels, with :attr:`danger` for ``dangerous``."""
        return self.labels | ({"dangerous": self.danger} if "dangerous" in self.labels else {})

    def words(self) -> list[tuple[str, float]]:
        """Return the predicted classes, each with its probability; empty without touch."""
        probabilities = self.probabilities | self.agreeing
        pairs = [
            (OPPOSITE.get(name, ""), 1 - probabilities[name])
            if yes is False
            else (name if yes else f"{name}?", probabilities[name])
            for name, yes in self.known.items()
        ]
        return [(word, probability) for word, probability in pairs if word and isfinite(probability)]

    @property
    def in_alarm(self) -> "Verdict":
        """This verdict during an alarm that has begun before it, whose probability it does not know."""
        return replace(
            self,
            dangerous=True,
            labels=self.labels | ({"dangerous": True} if "dangerous" in self.labels else {}),
            probabilities=self.probabilities | {"dangerous": nan},
        )


class Assessment(NamedTuple):
    """What is known of the skin at a moment.

    Attributes:
        verdict: the present one; None if there is none.
        reason: why there is none, in words.
        alarm: including one that continues without a verdict.
    """

    verdict: Verdict | None
    reason: str
    alarm: bool


SCHEMA = 1
"""Version of the messages. A field may be added without a new version; a reader ignores unknown ones."""


def verdict_message(
    assessment: Assessment, notes: Sequence[Note], contacts: dict[str, Any], now: float
) -> dict[str, Any]:
    """Return what is known of the skin as JSON data.

    Args:
        assessment: the present one.
        notes: on the verdict or its absence, the gravest first.
        contacts: what is known of them.
        now: s, the host's monotonic clock.

    Returns:
        The fields of ``docs/export.md`` but ``number`` and ``event``.
    """
    verdict, _, alarm = assessment
    moment = datetime.now(UTC) - timedelta(seconds=0.0 if verdict is None else now - verdict.t_host)
    shared = {
        "schema": SCHEMA,
        "stale": verdict is None,
        "reason": summarize_notes(notes),
        "state": "unknown" if verdict is None else verdict.state,
        "alarm": alarm,
        "dangerous": True if alarm else None if verdict is None else verdict.danger,
        "notes": [note.message for note in notes],
        "time": moment.isoformat(timespec="milliseconds").replace("+00:00", "Z"),
        "contacts": contacts,
    }
    if verdict is None:
        return shared
    return shared | {
        "device_time": verdict.t,
        "touched": verdict.touched,
        "labels": verdict.known,
        # JSON has no NaN, and the probabilities of an untouched skin mean nothing.
        "probabilities": {
            name: round(value, 6) if isfinite(value) and verdict.state == "touch" else None
            for name, value in verdict.probabilities.items()
        },
        "contact": verdict.contact,
        "gap": verdict.gap,
        "masked": list(verdict.masked),
        "unknown": list(verdict.unknown),
    }


def contact_text(contact: float | None, short: float = 3.0, long: float = 60.0) -> str:
    """Return a text with the time since which something touches the skin; empty without contact.

    Args:
        contact: duration of the contact, s; None without contact.
        short, long: s of contact from which it is shown, and from which it may be drift.
    """
    if contact is None or contact < short:
        return ""
    return (
        f"contact since {datetime.now() - timedelta(seconds=contact):%H:%M:%S} ({contact:.0f} s)"
        f"{'; if nothing touches the skin, take a new tare' * (contact >= long)}"
    )
