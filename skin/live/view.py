"""The live view of ``skin live``: terminal, JSON lines, log of alarms."""

import gc
import signal
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence, Set
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Lock, Thread
from time import monotonic, time
from typing import IO, Any

import numpy as np
from hydra import compose
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.text import Text

from skin.core.files import json_line, unwritable
from skin.core.interrupt import ends_on_signal
from skin.core.messages import quiet
from skin.errors import InputError
from skin.evaluation.operating_point import FinalThreshold, OperatingPoint
from skin.live.contacts import LiveContacts, contact_text_lines
from skin.live.engine import Engine
from skin.live.engine_builder import LiveSettings, LiveSetup, watch_exported, watch_run
from skin.live.loop import Display, DisplayState, LiveLoop, watch_age
from skin.live.verdict import Assessment, Note, contact_text, verdict_message
from skin.runs.configuration import Config, validate_config
from skin.runs.model import check_overrides
from skin.wire.segmentation import typed_lines

_say = Console(stderr=True, highlight=False).print

# Events for other programs and as a log: JSON lines, or another form.


HEARTBEAT = 0.4
"""s without a line from which the state is repeated: 0.5 s at most, as :func:`watch_age` looks each 0.1 s."""


Form = Callable[[Any, Iterable[dict[str, Any]]], object]
"""Writes messages to an open file until they end."""


def write_json(file: IO[str], messages: Iterable[dict[str, Any]]) -> None:
    """Write a JSON line for each message, flushed one by one."""
    for message in messages:
        file.write(json_line(message) + "\n")
        file.flush()


class MessageQueue:
    """Writes numbered messages in a thread of its own: a slow reader delays no verdict.

    Args:
        file: open for writing.
        failed: called with the error when the file cannot be written any more, as its reader is gone.
        form: writes them.
        waiting: most messages for a slow reader; then the oldest is dropped.
        ending: s in which a slow reader may take the last messages.
    """

    def __init__(
        self,
        file: IO[Any],
        failed: Callable[[Exception], object],
        form: Form,
        waiting: int,
        ending: float = 1.0,
    ) -> None:
        self._file, self._failed, self._form, self._most, self._ending = file, failed, form, waiting, ending
        self._waiting, self._adding, self._number = SimpleQueue[dict[str, Any] | None](), Lock(), 0
        self._thread = Thread(target=self._run, name="skin-lines", daemon=True)

    def __enter__(self) -> "MessageQueue":
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        """Write the messages that wait, and end."""
        self._waiting.put(None)
        self._thread.join(self._ending)

    def add(self, message: dict[str, Any]) -> None:
        """Add a message with its number, from 1 up; return at once."""
        with self._adding, suppress(Empty):
            self._number += 1
            self._waiting.put({"number": self._number, **message})
            if self._waiting.qsize() > self._most:
                self._waiting.get_nowait()

    def _run(self) -> None:
        try:
            self._form(self._file, iter(self._waiting.get, None))
        except (OSError, ValueError) as error:
            self._failed(error)


VERDICTS = frozenset(("verdict", "change", "heartbeat"))
"""Events for other programs: a verdict, another reason for none, and the state again after ``HEARTBEAT``."""
_STATES = ("stale", "resumed"), ("alarm", "cleared"), ("unknown", "known")
CHANGES = frozenset(("started", *sum(_STATES, ()), "tare", "tare_refused", "tare_forced", "ended"))
"""Events of a log: changes of what is known of the skin, of the alarm, of what is known of a position (its
sensors have no valid reading), and of the baseline."""


@contextmanager
def write_events(
    display: Display,
    file: IO[Any],
    failed: Callable[[Exception], object],
    wanted: Set[str],
    form: Form = write_json,
) -> Iterator[None]:
    """Write a message to a file for each event while the block runs.

    Args:
        display: gives the verdicts; watched by :func:`watch_age`.
        file: open for writing.
        failed: called with the error when the file cannot be written any more; the live view continues.
        wanted: names of the events, of :data:`VERDICTS` and :data:`CHANGES`.
        form: of the file.
    """
    written = monotonic()
    latest, states = display.assess(written), (True, False, False)

    def observe(assessment: Assessment, now: float, event: str) -> None:
        nonlocal latest, states
        former, before, latest, verdict = latest, states, assessment, assessment.verdict
        # Places stay as they were while nothing is known of the skin.
        states = verdict is None, assessment.alarm, before[2] if verdict is None else bool(verdict.unknown)
        pairs = zip(_STATES, before, states, strict=True)
        changes = [names[not state] for names, previous, state in pairs if state != previous]
        if not write(now, *changes, event):
            again = "heartbeat" if now - written >= HEARTBEAT else ""
            write(now, again if latest == former else "change" if verdict is None else "verdict")

    def write(now: float, *events: str) -> bool:
        nonlocal written
        chosen = [event for event in events if event in wanted]
        for event in chosen:
            written, described = now, display.describe(latest, now)
            queue.add({"event": event, **verdict_message(latest, *described, now)})
        return bool(chosen)

    # A second of verdicts, as frames come in bursts: old ones tell of a skin that is no longer so.
    with MessageQueue(file, failed, form, 24 if wanted is VERDICTS else 256) as queue:
        write(monotonic(), "started")
        display.observers.append(observe)
        try:
            yield
        finally:
            write(monotonic(), "ended")


@contextmanager
def write_file(
    display: Display,
    path: Path,
    mode: str = "a",
    wanted: Set[str] = CHANGES,
    form: Form = write_json,
    override: str = "live.log=FILE.jsonl",
) -> Iterator[None]:
    """Write events to a file while the block runs; by default, append JSON lines of :data:`CHANGES`.

    If it becomes unwritable, a message says so once.

    Args:
        display, wanted, form: as of :func:`write_events`.
        path: of the file.
        mode: in which it is opened.
        override: setting that selects another file, for the message.

    Raises:
        InputError: the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open(mode, encoding=None if "b" in mode else "utf-8")
    except OSError as error:
        raise unwritable(path, error, override) from error
    try:
        with write_events(display, file, partial(print, f"{path} ends here:", file=sys.stderr), wanted, form):
            yield
    finally:
        with suppress(OSError):  # of a full disk, which the message has reported
            file.close()


# The terminal; where output is no terminal, JSON lines of its changes.


_KEYS = "t and Enter: a new tare, nothing may touch the skin; Ctrl-C ends"


@contextmanager
def show_in_terminal(display: Display, console: Console) -> Iterator[None]:
    """Show the display while the block runs, and read typed commands."""
    with suppress(AttributeError, ValueError):  # Windows; another thread than the main one
        # In the background the program reads no keys; it must not be stopped.
        signal.signal(signal.SIGTTIN, signal.SIG_IGN)
    Thread(target=_read_keys, args=(display,), name="skin-keys", daemon=True).start()
    live = Live(
        get_renderable=lambda: screen(display, monotonic()),
        console=console,
        refresh_per_second=8,
        transient=True,
    )
    with (
        live
        if console.is_terminal
        else write_events(display, console.file, display.close, CHANGES | {"change"})
    ):
        yield


def _read_keys(display: Display) -> None:
    """Request a new tare at every line ``t``, or ``force`` after a refusal, until the input ends."""
    with suppress(OSError, ValueError):  # no input, or a closed one
        for text in typed_lines(sys.stdin.fileno()):
            if (word := text.strip().lower()) in ("t", "force"):
                display.request_tare(monotonic(), force=word == "force")


def screen(display: Display, now: float) -> RenderableType:
    """Return the verdict and the contacts at ``now``, s, with the status of the stream below."""
    state, title = display.state(now), f"{display.title} on {display.port}"
    return Group(
        Panel(
            Group(_verdict(state), Text(), Text("\n".join(contact_text_lines(state.contacts)))),
            title=title,
            border_style="bold red" if state.assessment.alarm else "dim",
            expand=False,
        ),
        Text(state.line or " ", style="dim"),
        Text(_KEYS, style="dim"),
    )


def _verdict(state: DisplayState) -> RenderableType:
    """Return the verdict in words."""
    (verdict, _, alarmed), alarm = state.assessment, Text("DANGEROUS", "bold white on red")
    if verdict is None or not verdict.touched:
        shown = "unknown" if verdict is None else verdict.state
        trouble = Text(
            ": ".join(filter(None, (shown, state.reason))), "dim" if shown == "no touch" else "yellow"
        )
        return Group(alarm, Text(), trouble) if alarmed else trouble
    strongest, limited = int(state.peak.argmax()), int(state.saturated.sum())
    notes = (
        f"strongest reading {state.peak[strongest]:.1f} N, sensor {strongest}",
        contact_text(verdict.contact),
        state.reason,
        "the touch has ended" * (verdict.contact is None),
        f"{limited} sensors at their limit" * (limited > 0),
        "frames are missing" * verdict.gap,
    )
    words = "\n".join(f"{word:10} {100 * probability:3.0f} %" for word, probability in verdict.words())
    return Group(
        alarm if alarmed else Text("touch", "bold"),
        Text(),
        Text(words),
        Text("\n".join(filter(None, notes)), "yellow"),
    )


# The whole view.


def show(
    run: str,
    config: Config,
    overrides: Sequence[str],
    live: LiveSettings,
    web: bool,
    seconds: float | None,
    emulated: AbstractContextManager[Sequence[str]] | None = None,
) -> None:
    """Show the predictions of a run for a skin until the command is ended.

    Args:
        run: name of a run, or an ONNX file.
        config: of the command.
        overrides: settings that replace those of the run; ``config`` has their values.
        live: settings of the view.
        web: whether to serve a page, too.
        seconds: duration, s; None: until the command is ended.
        emulated: emulates a skin with the simulator of the run, and gives the settings of a device at its
            port; None: the device is that of ``config``.

    Raises:
        InputError: the model, the device or the settings cannot be used.
    """
    try:
        with ExitStack() as opened:
            opened.enter_context(ends_on_signal())
            display = _open_page(live, web, opened)
            if run.endswith(".onnx"):
                check_overrides(run, overrides)
                setup = watch_exported(run, config.device, _say, opened)
            else:
                quiet()
                if emulated is not None:
                    _tell(display, "the response of the emulated skin is being computed")
                    overrides = [*opened.enter_context(emulated), *overrides]
                    config = validate_config(compose("live", list(overrides)))
                _tell(display, "the model and the response of the skin are being loaded")
                setup = watch_run(run, config, live, _say, overrides, opened, emulated is not None)
            _open_views(display, setup, live, opened)
            _tell(display, "the threshold of the alarm is being chosen")
            source, engine, nominal, final = setup.watch(live, _say)
            if setup.port is None:
                opened.enter_context(source.skin)
            if final is not None:
                opened.callback(final.close)
                display.add_note(Note("provisional"))
            if live.verdicts is None:
                opened.enter_context(show_in_terminal(display, Console()))
            given = source, engine, nominal, live.selftest, _say
            adopt = adopt_final(final, partial(setup.check_final, *given), engine, display)
            check = partial(setup.check, *given, display.add_note)
            loop = LiveLoop(source.skin, source.tare, engine, display, check, partial(next, adopt, None))
            opened.callback(lambda: _say(f"{loop.verdicts} verdicts, {loop.line}"))
            gc.collect()  # a search among all that is loaded would stop the loop for 0.3 s, again and again
            gc.freeze()
            loop.run(seconds)
    except KeyboardInterrupt:
        print("ended", file=sys.stderr)


def _open_page(live: LiveSettings, web: bool, opened: ExitStack) -> Display:
    """Return what the views show; first on the page, before anything else is loaded."""
    contacts = opened.enter_context(closing(LiveContacts("" if live.contacts else "live.contacts=false")))
    display = Display("", "", np.empty((0, 3)), (0, 0), live.top, contacts=contacts, calm=live.patience.calm)
    if web:
        from skin.live.web import serve_page

        _say(f"page: {opened.enter_context(serve_page(display, live.web_port))}")
    opened.enter_context(watch_age(display))
    return display


def _tell(display: Display, stage: str) -> None:
    """Tell what is being done before there are verdicts, on the page and to a person at a terminal."""
    display.set_verdict(None, monotonic(), stage)
    if sys.stderr.isatty():
        _say(stage)


def _open_views(display: Display, setup: LiveSetup, live: LiveSettings, opened: ExitStack) -> None:
    """Show the skin; start the estimates of contacts and all views but page and terminal."""
    model = setup.model
    display.title, display.port, display.size, display.window = (
        model.title,
        setup.name,
        model.size,
        model.window / model.rate,
    )
    display.place(model.positions)
    try:
        if live.contacts:
            display.contacts.start(
                setup.mechanics(thickness=live.thickness),
                lambda: setup.port is not None and setup.port.raw_range.whole,
            )
    except InputError as error:
        display.contacts.explain(str(error))
        _say(f"no contacts: {error}")
    if live.log is not None:
        opened.enter_context(write_file(display, Path(live.log).expanduser()))
    if live.record is not None:
        from skin.robot.recordings import LIVE, live_messages, load_package, write_messages

        display.recent = deque(maxlen=display.kept)
        package, epoch = load_package("mcap.writer", "robot"), time() - monotonic()
        opened.enter_context(
            write_file(
                display,
                Path(live.record).expanduser(),
                "xb",
                VERDICTS | CHANGES,
                lambda file, verdicts: write_messages(
                    package,
                    {"unit": "N", "positions": model.positions.tolist(), "size": model.size},
                    LIVE,
                    file,
                    live_messages(verdicts, display.recent, epoch),
                ),
                "live.record=FILE.mcap",
            )
        )
    if live.verdicts is not None:
        # A file of its own, and never closed: lines that a reader did not take would fail once more.
        lines = open(sys.stdout.fileno(), "w", closefd=False)  # noqa: SIM115
        opened.enter_context(write_events(display, lines, display.close, VERDICTS))


def adopt_final(
    final: FinalThreshold | None, test: Callable[[OperatingPoint], object], engine: Engine, display: Display
) -> Iterator[None]:
    """Replace a provisional threshold once the final one is known and tested; where there is none, say why.

    Args:
        final: chooses it; None: the threshold is final.
        test: raises InputError where the alarm could not be raised with it; it may take seconds.
        engine: that decides.
        display: with the note that the threshold is provisional.

    Yields:
        While it is not known.
    """
    while (point := None if final is None else final.take()) is None:
        yield
    if isinstance(point, OperatingPoint):
        from skin.device.base import in_background  # with torch, which an exported model does without

        tested = in_background(partial(test, point))
        while not tested.done():
            yield
        point = point if tested.exception() is None else str(tested.exception())
    if isinstance(point, str):
        display.add_note(Note("provisional", detail=f", and stays so: {point}"))
        return
    # From the next decision on; an alarm stays as it is.
    engine.above, engine.danger = point.announced(_say), point.score
    display.notes = tuple(note for note in display.notes if note.code != "provisional")
