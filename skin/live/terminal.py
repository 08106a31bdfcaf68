"""Live view in a terminal; where output is no terminal, JSON lines of its changes."""

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime, timedelta
from threading import Thread
from time import monotonic

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from skin.live.contacts import contact_text_lines
from skin.live.loop import Display, DisplayState
from skin.live.verdicts import write_changes
from skin.wire.segmentation import typed_lines

_KEYS = "t and Enter: a new tare, nothing may touch the skin; Ctrl-C ends"


@contextmanager
def show_in_terminal(display: Display, console: Console) -> Iterator[None]:
    """Show the display while the block runs, and read typed commands."""
    with suppress(AttributeError, ValueError):  # Windows; another thread than the main one
        # In the background the program reads no keys; it must not be stopped.
        signal.signal(signal.SIGTTIN, signal.SIG_IGN)
    Thread(target=_read_keys, args=(display,), name="skin-keys", daemon=True).start()
    render = lambda: screen(display, monotonic())  # noqa: E731
    live = Live(get_renderable=render, console=console, refresh_per_second=8, transient=True)
    closing = lambda _: display.closed.set()  # noqa: E731
    with live if console.is_terminal else write_changes(display, console.file, closing, reasons=True):
        try:
            yield
        finally:
            display.closed.set()


def _read_keys(display: Display) -> None:
    """Request a new tare at every line ``t``, or ``force`` after a refusal, until the input ends."""
    with suppress(OSError, ValueError):  # no input, or a closed one
        for text in typed_lines(sys.stdin.fileno()):
            if (word := text.strip().lower()) in ("t", "force"):
                display.request_tare(monotonic(), force=word == "force")


def screen(display: Display, now: float) -> RenderableType:
    """Return the verdict and the contacts at ``now``, s, with the status of the stream below."""
    info, state = display.info, display.state(now)
    contacts = Text("\n".join(contact_text_lines(state.contacts)))
    border = "bold red" if state.alarm else "dim"
    shown = Group(_verdict(state), Text(), contacts)
    panel = Panel(shown, title=f"{info.title} on {info.port}", border_style=border, expand=False)
    return Group(panel, Text(state.line or " ", style="dim"), Text(_KEYS, style="dim"))


def _verdict(state: DisplayState, width: int = 20) -> RenderableType:
    """Return the verdict, with bars of ``width`` characters."""
    verdict, alarm = state.verdict, Text("DANGEROUS", "bold white on red")
    if verdict is None or not verdict.touched:
        shown = "unknown" if verdict is None else verdict.state
        text = ": ".join(filter(None, (shown, state.reason)))
        trouble = Text(text, style="dim" if shown == "no touch" else "yellow")
        return Group(alarm, Text(), trouble) if state.alarm else trouble
    head, strongest = alarm if state.alarm else Text("touch", "bold"), int(state.peak.argmax())
    notes = [f"strongest reading {state.peak[strongest]:.1f} N, sensor {strongest}"]
    notes += [contact_text(verdict.contact), state.reason]
    notes += ["the touch has ended"] * (verdict.contact is None)
    notes += [f"{count} sensors at their limit"] if (count := int(state.saturated.sum())) else []
    notes += ["frames are missing"] * verdict.gap
    bars = Table.grid(padding=(0, 1))
    for word, probability in verdict.words():
        filled = round(width * probability)
        bars.add_row(word, "█" * filled + "░" * (width - filled), f"{100 * probability:.0f} %")
    return Group(head, Text(), bars, Text("\n".join(filter(None, notes)), "yellow"))


def contact_text(contact: float | None, short: float = 3.0, long: float = 60.0) -> str:
    """Return a text with the time since which something touches the skin; empty without contact.

    Args:
        contact: duration of the contact, s; None without contact.
        short, long: s of contact from which it is shown, and from which it may be drift.
    """
    if contact is None or contact < short:
        return ""
    began = datetime.now() - timedelta(seconds=contact)
    hint = "; if nothing touches the skin, take a new tare" if contact >= long else ""
    return f"contact since {began:%H:%M:%S} ({contact:.0f} s){hint}"
