"""Live view on a local web page; pictures are sent as server-sent events."""

import asyncio
import base64
import socket
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Thread
from time import monotonic, time
from typing import Any

import numpy as np
import uvicorn
from scipy.interpolate import RBFInterpolator
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from skin.core.files import json_line
from skin.errors import InputError
from skin.learning.representation import centres
from skin.live.contacts import contact_text_lines
from skin.live.loop import Assessment, Display, DisplayState
from skin.live.terminal import contact_text
from skin.live.verdicts import verdict_message

HERTZ = 33
"""Pictures per second: 30, with a margin for a busy machine."""
_HOST = "127.0.0.1"
_PAGE = Path(__file__).with_name("page.html")


class SkinPicture:
    """Interpolates readings between the sensors, for display only: radial functions, linear in the distance.

    Each sensor shows its own reading, and there is no edge between the sensors or outside of them.

    Args:
        positions: (S, 3), m.
        size: extent (x, y) of the sheet, m.
        pixels: edge length of the picture, which is stretched over the sheet.
        top: N at the brightest value.
    """

    def __init__(self, positions: np.ndarray, size: tuple[float, float], pixels: int, top: float) -> None:
        self.pixels, self.top = pixels, top
        self._points, self._targets = np.asarray(positions, dtype=float)[:, :2], centres(size, pixels)
        self._known = np.zeros(len(self._points), dtype=bool)
        self._matrix = np.zeros((pixels**2, len(self._points)), np.float32)

    def __call__(self, values: np.ndarray, valid: np.ndarray | None = None) -> np.ndarray:
        """Return the picture of readings (S,), N, as (pixels, pixels), uint8: 255 is ``top`` and above.

        Args:
            values: N.
            valid: (S,), bool; other sensors are left out, not shown as 0; None: all are known.
        """
        valid = np.ones(len(values), dtype=bool) if valid is None else valid
        if not np.array_equal(valid, self._known):
            self._known, self._matrix = valid.copy(), np.zeros_like(self._matrix)
            if valid.any():
                points, own = self._points[valid], np.eye(int(valid.sum()))
                radial = RBFInterpolator(points, own, kernel="linear", degree=0)
                self._matrix[:, valid] = radial(self._targets)
        image = self._matrix @ values.astype(np.float32)
        return (255 * np.clip(image / self.top, 0, 1)).astype(np.uint8).reshape(self.pixels, self.pixels)


@contextmanager
def serve_page(display: Display, port: int) -> Iterator[str]:
    """Serve the page while the block runs; yield its address.

    Args:
        display: the display to show.
        port: 0: any free one.

    Raises:
        InputError: the port is in use or not allowed.
    """
    try:
        listening = socket.create_server((_HOST, port))
    except (OSError, OverflowError) as error:
        raise InputError(f"no page on port {port}: {error}; give live.web_port=0, or another") from error
    settings = uvicorn.Config(
        _application(display), log_config=None, access_log=False, lifespan="off", timeout_graceful_shutdown=1
    )
    server = uvicorn.Server(settings)
    thread = Thread(target=server.run, kwargs={"sockets": [listening]}, name="skin-page", daemon=True)
    thread.start()
    try:
        yield f"http://{_HOST}:{listening.getsockname()[1]}"
    finally:
        display.closed.set()
        server.should_exit = True
        thread.join(5)
        listening.close()


def message(state: DisplayState, picture: SkinPicture, now: float) -> dict[str, Any]:
    """Return the data of each picture: the fields of a JSON line, and what the page draws.

    Forces are in N, the picture is base64 of uint8 row by row, the time ``sent`` in s.

    Args:
        state: of the display.
        picture: interpolates the forces.
        now: s, the host's monotonic clock.
    """
    verdict, assessment = state.verdict, Assessment(state.verdict, "", state.alarm)
    return {
        **verdict_message(assessment, state.notes, state.contacts, now),
        "number": state.number,
        "sent": time(),
        "values": [round(value, 3) for value in state.values.tolist()],
        "valid": state.valid.tolist(),
        "saturated": state.saturated.tolist(),
        "peak": [round(value, 3) for value in state.peak.tolist()],
        "held": state.held,
        "picture": base64.b64encode(picture(state.map, state.valid).tobytes()).decode(),
        "unknown": list(range(len(state.valid))) if verdict is None else list(verdict.unknown),
        "since": "" if verdict is None else contact_text(verdict.contact),
        "words": [] if verdict is None else verdict.words(),
        "line": state.line,
        "contact_text": contact_text_lines(state.contacts),
    }


def _application(display: Display, pixels: int = 64) -> Starlette:
    info = display.info
    picture = SkinPicture(info.positions, info.size, pixels, info.top)

    async def page(request: Request) -> Response:
        return FileResponse(_PAGE, media_type="text/html", headers={"Cache-Control": "no-store"})

    async def skin(request: Request) -> Response:
        geometry = {"positions": info.positions.tolist(), "size": list(info.size), "pixels": pixels}
        named = {"title": info.title, "port": info.port, "top": info.top, "window": info.window}
        return JSONResponse(geometry | named)

    async def pictures(request: Request) -> Response:
        return StreamingResponse(_events(display, picture), media_type="text/event-stream")

    async def tare(request: Request) -> Response:
        # Another site's page can send a plain POST here, but not with a header of its own.
        if (order := request.headers.get("x-skin")) not in ("tare", "force"):
            return Response(status_code=403)
        refused = display.request_tare(monotonic(), force=order == "force")
        return JSONResponse({"reason": refused}, status_code=409) if refused else Response(status_code=204)

    # Other host names are refused, so that pages of other sites cannot read the skin.
    local = Middleware(TrustedHostMiddleware, allowed_hosts=[_HOST, "localhost"])
    routes = [
        Route("/", page),
        Route("/skin.json", skin),
        Route("/pictures", pictures),
        Route("/tare", tare, methods=["POST"]),
    ]
    return Starlette(routes=routes, middleware=[local])


async def _events(display: Display, picture: SkinPicture) -> AsyncIterator[str]:
    due = monotonic()
    number = display.state(due).number  # of the first picture: the latest frame
    while not display.closed.is_set():
        now = monotonic()
        state = display.state(now, number)
        number = state.number
        yield f"data: {json_line(message(state, picture, now))}\n\n"
        # A picture that is a little late does not delay the next; those that are very late are left out.
        due = max(due + 1 / HERTZ, monotonic() - 1 / HERTZ)
        await asyncio.sleep(max(0.0, due - monotonic()))
