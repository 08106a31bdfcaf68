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
from scipy.spatial import ConvexHull, Delaunay
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from skin.core.files import json_line
from skin.errors import InputError
from skin.learning.representation import centres, weights
from skin.live.contacts import contact_text_lines
from skin.live.loop import Display, DisplayState
from skin.live.terminal import contact_text
from skin.live.verdicts import verdict_message

HERTZ = 33  # pictures per second: 30, with a margin for a busy machine
_PIXELS = 64
_HOST = "127.0.0.1"
_PAGE = Path(__file__).with_name("page.html")
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


def message(state: DisplayState, picture: SkinPicture) -> dict[str, Any]:
    """Return the data of each picture: the fields of a JSON line, and what the page draws.

    Forces are in N, the picture is base64 of uint8 row by row, the time ``sent`` in s.
    """
    verdict = state.verdict
    return {
        **verdict_message(verdict, state.alarm, state.notes, state.contacts),
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


def _application(display: Display) -> Starlette:
    info = display.info
    picture = SkinPicture(info.positions, info.size, _PIXELS, info.top)

    async def page(request: Request) -> Response:
        return FileResponse(_PAGE, media_type="text/html", headers={"Cache-Control": "no-store"})

    async def skin(request: Request) -> Response:
        geometry = {"positions": info.positions.tolist(), "size": list(info.size), "pixels": _PIXELS}
        named = {"title": info.title, "port": info.port, "top": info.top, "window": info.window}
        return JSONResponse(geometry | named)

    async def pictures(request: Request) -> Response:
        return StreamingResponse(_events(display, picture), media_type="text/event-stream")

    async def tare(request: Request) -> Response:
        # Another site's page can send a plain POST here, but not with a header of its own.
        if (order := request.headers.get("x-skin")) not in ("tare", "force"):
            return Response(status_code=403)
        refused = display.request_tare(force=order == "force")
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
    number, due = display.state().number, monotonic()  # of the first picture: the latest frame
    while not display.closed.is_set():
        state = display.state(number)
        number = state.number
        yield f"data: {json_line(message(state, picture))}\n\n"
        # A picture that is a little late does not delay the next; those that are very late are left out.
        due = max(due + 1 / HERTZ, monotonic() - 1 / HERTZ)
        await asyncio.sleep(max(0.0, due - monotonic()))
