"""Live view in a terminal; without a terminal, one line per change of the verdict."""

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
from scipy.spatial import ConvexHull, Delaunay

from skin.hardware.live.contacts import contact_text_lines
from skin.hardware.live.loop import Display, DisplayState
from skin.hardware.wire.segmentation import typed_lines
from skin.learning.representation import centres, weights

_FEWEST = 3
_INWARDS = 1e-6


class SkinPicture:
    """Interpolates readings between the sensors, for display only.

    Linear inside the sensors' hull, as ``representation=interp`` does; outside, as at the nearest point of
    the hull, so that there is no edge. Nearest neighbour if there is no triangle.

    Args:
        positions: (S, 3), m.
        size: extent (x, y) of the sheet, m.
        pixels: edge length of the picture, which is stretched over the sheet.
        top: N at the brightest value.
    """

    def __init__(self, positions: np.ndarray, size: tuple[float, float], pixels: int, top: float) -> None:
        self.pixels, self.top = pixels, top
        self._points, self._targets = np.asarray(positions, dtype=float)[:, :2], centres(size, pixels)
        self._known = np.ones(len(self._points), dtype=bool)
        self._matrix = self._weights()

    def _weights(self) -> np.ndarray:
        """Return the weights (P, S) of the known sensors."""
        points = self._points[self._known]
        matrix = np.zeros((len(self._targets), len(self._known)), np.float32)
        if len(points) < _FEWEST or np.linalg.matrix_rank(points - points[0], tol=1e-6) < 2:
            if len(points):
                matrix[:, self._known] = weights(points, self._targets, "nearest")
        else:
            matrix[:, self._known] = weights(points, _inside(points, self._targets), "linear")
        return matrix

    def __call__(self, values: np.ndarray, valid: np.ndarray | None = None) -> np.ndarray:
        """Return the picture of readings (S,), N, as (pixels, pixels), uint8: 255 is ``top`` and above.

        Args:
            values: N.
            valid: (S,), bool; other sensors are left out, not shown as 0; None: all are known.
        """
        valid = np.ones(len(values), dtype=bool) if valid is None else valid
        if not np.array_equal(valid, self._known):
            self._known = valid.copy()
            self._matrix = self._weights()
        image = self._matrix @ values.astype(np.float32)
        return (255 * np.clip(image / self.top, 0, 1)).astype(np.uint8).reshape(self.pixels, self.pixels)


def _inside(points: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Return targets (P, 2), those outside of the hull of points (S, 2) moved to its nearest point."""
    outside = Delaunay(points).find_simplex(targets) < 0
    corners = points[ConvexHull(points).vertices]
    along = np.roll(corners, -1, axis=0) - corners
    share = ((targets[outside, None] - corners) * along).sum(axis=2) / (along**2).sum(axis=1)
    feet = corners + share.clip(0, 1)[..., None] * along
    nearest = ((feet - targets[outside, None]) ** 2).sum(axis=2).argmin(axis=1)
    moved = targets.copy()
    on_edge = feet[np.arange(len(feet)), nearest]
    # A little inwards, so that rounding does not leave them outside.
    moved[outside] = on_edge + _INWARDS * (corners.mean(axis=0) - on_edge)
    return moved


_HERTZ = 8
_PIXELS = 24
_BAR = 20  # characters
_SHORT, _LONG = 3.0, 60.0  # s of contact after which it is shown, and after which it may be drift
_KEYS = "t and Enter: a new tare, nothing may touch the skin; Ctrl-C ends"
# Dark blue, teal, yellow, white: lighter means more to any eye.
_SCALE = ((13, 22, 48), (24, 92, 122), (92, 170, 120), (240, 200, 70), (255, 250, 230))
_MIXED = [
    np.interp(np.arange(256), np.linspace(0, 255, len(_SCALE)), channel)
    for channel in zip(*_SCALE, strict=True)
]
_COLOURS = ["#{:02x}{:02x}{:02x}".format(*rgb) for rgb in np.round(_MIXED).astype(int).T.tolist()]


@contextmanager
def show_in_terminal(display: Display, console: Console) -> Iterator[None]:
    """Show the display while the block runs, and read typed commands."""
    with suppress(AttributeError, ValueError):  # Windows; another thread than the main one
        # In the background the program reads no keys; it must not be stopped.
        signal.signal(signal.SIGTTIN, signal.SIG_IGN)
    Thread(target=_read_keys, args=(display,), name="skin-keys", daemon=True).start()
    info, seen = display.info, 0  # frames
    picture = SkinPicture(info.positions, info.size, _PIXELS, info.top)

    def render() -> RenderableType:
        nonlocal seen
        state = display.state(seen)
        seen = state.number
        return screen(display, state, picture)

    live = Live(get_renderable=render, console=console, refresh_per_second=_HERTZ, transient=True)
    with live if console.is_terminal else _printed(display, console):
        try:
            yield
        finally:
            display.closed.set()


@contextmanager
def _printed(display: Display, console: Console) -> Iterator[None]:
    thread = Thread(target=print_changes, args=(display, console), name="skin-lines", daemon=True)
    thread.start()
    try:
        yield
    finally:
        thread.join(2)


def _read_keys(display: Display) -> None:
    """Request a new tare at every line ``t``, or ``force`` after a refusal, until the input ends."""
    with suppress(OSError, ValueError):  # no input, or a closed one
        for text in typed_lines(sys.stdin.fileno()):
            if (word := text.strip().lower()) in ("t", "force"):
                display.request_tare(force=word == "force")


def print_changes(display: Display, console: Console) -> None:
    """Print the verdict whenever it changes, until the display is closed."""
    before = ""
    while True:
        text = _sentence(display.state())
        if text != before:
            console.print(text, markup=False, highlight=False, soft_wrap=True)
            before = text
        if display.closed.wait(1 / (4 * _HERTZ)):
            return


def _sentence(state: DisplayState) -> str:
    verdict, alarm = state.verdict, "DANGEROUS: " if state.alarm else ""
    if verdict is None:
        return f"{alarm}unknown: {state.reason}"
    words = " ".join(word for word, _ in verdict.words()) or verdict.state
    return "; ".join(text for text in (alarm + words, state.reason) if text)


def screen(display: Display, state: DisplayState, picture: SkinPicture) -> RenderableType:
    """Return the skin beside the verdict, with the status of the stream below."""
    info, beside = display.info, Table.grid(padding=(0, 3))
    contacts = Text("\n".join(contact_text_lines(state.contacts)))
    beside.add_row(_map(picture(state.map, state.valid)), Group(_verdict(state), Text(), contacts))
    border = "bold red" if state.alarm else "dim"
    panel = Panel(beside, title=f"{info.title} on {info.port}", border_style=border, expand=False)
    return Group(panel, Text(state.line or " ", style="dim"), Text(_KEYS, style="dim"))


def _map(image: Any) -> Text:
    """Return a picture of half blocks, two rows of pixels per line."""
    text = Text()
    for upper, lower in zip(image[::2], image[1::2], strict=True):
        for above, below in zip(upper.tolist(), lower.tolist(), strict=True):
            text.append("▀", Style(color=_COLOURS[above], bgcolor=_COLOURS[below]))
        text.append("\n")
    return text


def _verdict(state: DisplayState) -> RenderableType:
    verdict, alarm = state.verdict, Text("DANGEROUS", "bold white on red")
    if verdict is None or not verdict.touched:
        shown = "unknown" if verdict is None else verdict.state
        text = ": ".join(filter(None, (shown, state.reason)))
        trouble = Text(text, style="dim" if shown == "no touch" else "yellow")
        return Group(alarm, Text(), trouble) if state.alarm else trouble
    head, notes = alarm if state.alarm else Text("touch", "bold"), [contact_text(verdict.contact)]
    notes += [state.reason] + ["the touch has ended"] * (verdict.contact is None)
    notes += [f"{count} sensors at their limit"] if (count := int(state.saturated.sum())) else []
    notes += ["frames are missing"] * verdict.gap
    bars = Table.grid(padding=(0, 1))
    for word, chance in verdict.words():
        filled = round(_BAR * chance)
        bars.add_row(word, "█" * filled + "░" * (_BAR - filled), f"{100 * chance:.0f} %")
    return Group(head, Text(), bars, Text("\n".join(notes), "yellow"))


def contact_text(contact: float | None) -> str:
    """Return a text with the time since which something touches the skin; empty without contact.

    Args:
        contact: duration of the contact, s; None without contact.
    """
    if contact is None or contact < _SHORT:
        return ""
    began = datetime.now() - timedelta(seconds=contact)
    hint = "; if nothing touches the skin, take a new tare" if contact >= _LONG else ""
    return f"contact since {began:%H:%M:%S} ({contact:.0f} s){hint}"
