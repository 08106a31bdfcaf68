"""The skin in a terminal; if output is no terminal, one line per change of the verdict."""

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime, timedelta
from threading import Thread
from typing import Any

import numpy as np
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.style import Style
from rich.table import Table
from rich.text import Text

from skin.hardware.live.board import Board, Look
from skin.hardware.live.picture import Picture
from skin.hardware.live.verdict import Verdict
from skin.wire.segmentation import typed

_HERTZ = 8
_PIXELS = 24
_BAR = 20  # characters
_SHORT, _LONG = 3.0, 60.0  # s of contact after which it is told, and after which it may be drift
_KEYS = "t and Enter: a new tare, nothing may touch the skin; Ctrl-C ends"
# Dark blue, teal, yellow, white: lighter means more to any eye.
_SCALE = ((13, 22, 48), (24, 92, 122), (92, 170, 120), (240, 200, 70), (255, 250, 230))
_MIXED = [
    np.interp(np.arange(256), np.linspace(0, 255, len(_SCALE)), channel)
    for channel in zip(*_SCALE, strict=True)
]
_COLOURS = ["#{:02x}{:02x}{:02x}".format(*rgb) for rgb in np.round(_MIXED).astype(int).T.tolist()]


@contextmanager
def shown(board: Board, console: Console) -> Iterator[None]:
    """Show the board while the block runs, and hear what the operator types."""
    with suppress(AttributeError, ValueError):  # Windows; another thread than the main one
        # Where the program is sent to the background, keys are no longer heard; it must not be stopped.
        signal.signal(signal.SIGTTIN, signal.SIG_IGN)
    Thread(target=_hear, args=(board,), name="skin-keys", daemon=True).start()
    live = Live(get_renderable=_Screen(board), console=console, refresh_per_second=_HERTZ, transient=True)
    with live if console.is_terminal else _printed(board, console):
        try:
            yield
        finally:
            board.closed.set()


@contextmanager
def _printed(board: Board, console: Console) -> Iterator[None]:
    thread = Thread(target=lines, args=(board, console), name="skin-lines", daemon=True)
    thread.start()
    try:
        yield
    finally:
        thread.join(2)


def _hear(board: Board) -> None:
    """Ask for a new tare at every line ``t``, until the input ends."""
    with suppress(OSError, ValueError):  # no input, or a closed one
        for text in typed(sys.stdin.fileno()):
            if text.strip().lower() == "t":
                board.tare.set()


def lines(board: Board, console: Console) -> None:
    """Print what is said whenever it changes, until the board is closed."""
    before = ""
    while True:
        said = _sentence(board.look())
        if said != before:
            console.print(said, markup=False, highlight=False, soft_wrap=True)
            before = said
        if board.closed.wait(1 / (4 * _HERTZ)):
            return


def _sentence(look: Look) -> str:
    verdict, alarm = look.verdict, "DANGEROUS: " if look.alarm else ""
    if verdict is None:
        return alarm + look.trouble.split(":")[0]
    if not verdict.touched:
        return "no touch"
    return alarm + " ".join(word for word, _ in verdict.words())


class _Screen:
    """Renders the board anew each time it is asked."""

    def __init__(self, board: Board) -> None:
        facts = board.facts
        self._board, self._number = board, 0
        self._picture = Picture(facts.positions, facts.size, _PIXELS, facts.top)

    def __call__(self) -> RenderableType:
        look = self._board.look(self._number)
        self._number = look.number
        return screen(self._board, look, self._picture)


def screen(board: Board, look: Look, picture: Picture) -> RenderableType:
    """Return the skin beside what is said of it, and the line about the stream below."""
    facts, beside = board.facts, Table.grid(padding=(0, 3))
    beside.add_row(_map(picture(look.values, look.valid)), _said(look))
    border = "bold red" if look.alarm else "dim"
    panel = Panel(beside, title=f"{facts.title} on {facts.port}", border_style=border, expand=False)
    return Group(panel, Text(look.line or " ", style="dim"), Text(_KEYS, style="dim"))


def _map(image: Any) -> Text:
    """Return a picture of half blocks, two rows of pixels a line."""
    text = Text()
    for upper, lower in zip(image[::2], image[1::2], strict=True):
        for above, below in zip(upper.tolist(), lower.tolist(), strict=True):
            text.append("▀", Style(color=_COLOURS[above], bgcolor=_COLOURS[below]))
        text.append("\n")
    return text


def _said(look: Look) -> RenderableType:
    verdict, alarm = look.verdict, Text("DANGEROUS", "bold white on red")
    if verdict is None:
        trouble = Text(look.trouble or "waiting", style="yellow")
        return Group(alarm, Text(), trouble) if look.alarm else trouble
    if not verdict.touched:
        return Text("no touch", style="dim")
    head, notes = alarm if verdict.dangerous else Text("touch", "bold"), [since(verdict.contact)]
    notes += [f"{count} sensors at their limit"] if (count := int(look.saturated.sum())) else []
    notes += ["frames are missing"] * verdict.gap
    return Group(head, Text(), _bars(verdict), Text("\n".join(notes), "yellow"))


def since(contact: float | None) -> str:
    """Return since when something touches the skin, by the clock on the wall; empty if nothing does.

    Args:
        contact: for how long, s.
    """
    if contact is None or contact < _SHORT:
        return ""
    began = datetime.now() - timedelta(seconds=contact)
    hint = "; if nothing touches the skin, take a new tare" if contact >= _LONG else ""
    return f"contact since {began:%H:%M:%S} ({contact:.0f} s){hint}"


def _bars(verdict: Verdict) -> Table:
    table = Table.grid(padding=(0, 1))
    for word, chance in verdict.words():
        filled = round(_BAR * chance)
        table.add_row(word, "█" * filled + "░" * (_BAR - filled), f"{100 * chance:.0f} %")
    return table
