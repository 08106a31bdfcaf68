"""A live view of bytes in memory: decoder, tare, engine, loop and display, with the time as an argument."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from skin.live.loop import Display, LiveLoop
from skin.wire.decoder import Decoder
from skin.wire.reader import Port, WireFeed
from skin.wire.skin import SerialSource
from skin.wire.tare import Tare

LOOK = 0.05  # s between two looks at the display


class Look:
    """What the display shows at ``t``, s."""

    def __init__(self, t, state):
        verdict, _, self.alarm = state.assessment
        self.t, self.reason = t, state.reason
        self.notes = [note.code for note in state.notes]
        self.state = "unknown" if verdict is None else verdict.state
        self.danger = True if self.alarm else None if verdict is None else verdict.danger
        self.words = [] if verdict is None else [word for word, _ in verdict.words()]


class MemoryView:
    """A live view of a stream.

    Args:
        stream: (s of the host's clock, bytes that arrive then).
        engine: with its settings.
        verify: called with the conversion before the first decision.
        inwards, clock: three channels for each sensor of the engine; of the loop, whose work takes no time.
        port: settings of the port.

    Attributes:
        looks: what the display shows, every ``LOOK`` s.
        said: (s, verdict or None, reason, alarm) of all assessments for observers.
    """

    def __init__(self, stream, engine, verify=None, inwards=False, clock=float, **port):
        self.looks, self.said = [], []
        port = Port(**port)
        source = SerialSource(port, engine.sensors, engine.rate, inwards=inwards)
        sensors = engine.sensors * (3 if inwards else 1)
        decoder = Decoder(sensors, adapter=port.frames, polarity=source.polarity)
        # It opens a stream that nobody reads.
        feed = WireFeed(SimpleNamespace, decoder, port.limits, inwards=inwards)
        skin = SimpleNamespace(stats=decoder.stats)
        three = None if source.three is None else Tare(source.three.convert, 2.0, engine.rate)
        tare = Tare(source.convert, 2.0, engine.rate, lambda: decoder.header, three=three)
        positions = np.zeros((engine.sensors, 3))
        self.display = Display("memory", "memory", positions, (0.1, 0.1), 4.0)
        self.display.observers.append(lambda assessment, now, event: self.said.append((now, *assessment)))
        self.loop = LiveLoop(skin, tare, replace(engine), self.display, verify, clock=clock)
        for arrival, data in stream:
            self.look(arrival)
            frames = feed.decode(data, arrival)
            skin.channels = feed.states
            if frames:
                self.loop.take(frames, arrival)
            self.loop.update_status(arrival)

    def look(self, end):
        """Look at the display until ``end``, s."""
        while len(self.looks) * LOOK <= end:
            t = len(self.looks) * LOOK
            self.display.refresh(t)
            self.looks.append(Look(t, self.display.state(t)))

    def states(self, begin, end):
        """Return the states that were shown between two times, s."""
        return {look.state for look in self.looks if begin < look.t < end}

    def notes(self, begin, end):
        """Return the codes of the notes that were shown between two times, s."""
        return {code for look in self.looks if begin < look.t < end for code in look.notes}

    def first(self, after):
        """Return when the first alarm was shown, s."""
        return next((t for t, _, _, alarm in self.said if alarm and t >= after), np.inf)

    def kept(self, begin, end):
        """Return whether the alarm was shown all the time."""
        inside = [look.alarm for look in self.looks if begin < look.t < end]
        return bool(inside) and all(inside)

    def hidden(self, begin, end):
        """Return the longest time, s, for which touches were shown as no touch, or as safe."""
        spans, longest = 0, 0
        for look in self.looks:
            wrong = begin <= look.t < end and (look.state == "no touch" or look.danger is False)
            spans = spans + 1 if wrong else 0
            longest = max(longest, spans)
        return longest * LOOK
