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

import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from skin.core.files import json_line
from skin.errors import InputError
from skin.hardware.live.contacts import contact_text_lines
from skin.hardware.live.loop import Display, DisplayState
from skin.hardware.live.terminal import SkinPicture, contact_text
from skin.hardware.live.verdicts import verdict_message

HERTZ = 33  # pictures per second: 30, with a margin for a busy machine
_PIXELS = 64
_HOST = "127.0.0.1"
_PAGE = Path(__file__).with_name("page.html")


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
