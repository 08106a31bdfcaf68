"""The skin in a terminal; where output is no terminal, a line for each change of the verdict."""

from collections.abc import Iterator
from contextlib import contextmanager
from threading import Thread
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.style import Style
from rich.table import Table
from rich.text import Text

from skin.live.board import Board, Look
from skin.live.picture import Picture
from skin.live.verdict import Verdict

__all__ = ["lines", "screen", "shown"]

_HERTZ = 8
_PIXELS = 24
_BAR = 20  # characters
# Dark blue, teal, yellow, white: lighter means more to any eye.
_SCALE = ((13, 22, 48), (24, 92, 122), (92, 170, 120), (240, 200, 70), (255, 250, 230))


@contextmanager
def shown(board: Board, console: Console) -> Iterator[None]:
    """Show the board while the block runs."""
    if not console.is_terminal:
        thread = Thread(target=lines, args=(board, console), name="skin-lines", daemon=True)
        thread.start()
        try:
            yield
        finally:
            board.closed.set()
            thread.join(2)
        return
    draw = _Screen(board)
    with Live(get_renderable=draw, console=console, refresh_per_second=_HERTZ, transient=True):
        try:
            yield
        finally:
            board.closed.set()


def lines(board: Board, console: Console) -> None:
    """Print what is said whenever it changes, until the board is closed."""
    before = ""
    while True:
        look = board.look()
        said = _sentence(look)
        if said != before:
            console.print(said, markup=False, highlight=False, soft_wrap=True)
            before = said
        if board.closed.wait(1 / (4 * _HERTZ)):
            return


def _sentence(look: Look) -> str:
    verdict = look.verdict
    if verdict is None:
        return look.trouble.split(":")[0]
    if not verdict.touched:
        return "no touch"
    return ("DANGEROUS: " if verdict.dangerous else "") + " ".join(word for word, _ in verdict.words())


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
    beside.add_row(_map(picture(look.values)), _said(look))
    border = "bold red" if look.verdict is not None and look.verdict.dangerous else "dim"
    panel = Panel(beside, title=f"{facts.title} on {facts.port}", border_style=border, expand=False)
    return Group(panel, Text(look.line or " ", style="dim"), Text("Ctrl-C ends", style="dim"))


def _map(image: Any) -> Text:
    """Return a picture of half blocks, two rows of pixels a line."""
    text = Text()
    for upper, lower in zip(image[::2], image[1::2], strict=True):
        for above, below in zip(upper.tolist(), lower.tolist(), strict=True):
            text.append("▀", Style(color=_colour(above), bgcolor=_colour(below)))
        text.append("\n")
    return text


def _colour(level: int) -> str:
    place = level / 255 * (len(_SCALE) - 1)
    lower = min(int(place), len(_SCALE) - 2)
    share = place - lower
    mixed = [round(a + share * (b - a)) for a, b in zip(_SCALE[lower], _SCALE[lower + 1], strict=True)]
    return "#{:02x}{:02x}{:02x}".format(*mixed)


def _said(look: Look) -> RenderableType:
    verdict = look.verdict
    if verdict is None:
        return Text(look.trouble or "waiting", style="yellow")
    if not verdict.touched:
        return Text("no touch", style="dim")
    head = Text("DANGEROUS", "bold white on red") if verdict.dangerous else Text("touch", "bold")
    return Group(head, Text(), _bars(verdict), Text("frames are missing" if verdict.gap else "", "yellow"))


def _bars(verdict: Verdict) -> Table:
    table = Table.grid(padding=(0, 1))
    for word, chance in verdict.words():
        filled = round(_BAR * chance)
        table.add_row(word, "█" * filled + "░" * (_BAR - filled), f"{100 * chance:.0f} %")
    return table
