"""Live view on a local web page; pictures are sent as server-sent events."""

import asyncio
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
from skin.live.contacts import contact_text_lines
from skin.live.loop import Display, DisplayState
from skin.live.verdict import contact_text, verdict_message

HERTZ = 33
"""Pictures per second: 30, with a margin for a busy machine."""
_HOST = "127.0.0.1"


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
    server = uvicorn.Server(
        uvicorn.Config(
            _application(display),
            log_config=None,
            access_log=False,
            lifespan="off",
            timeout_graceful_shutdown=1,
        )
    )
    thread = Thread(target=server.run, kwargs={"sockets": [listening]}, name="skin-page", daemon=True)
    thread.start()
    try:
        yield f"http://{_HOST}:{listening.getsockname()[1]}"
    finally:
        display.close()
        server.should_exit = True
        thread.join(5)
        listening.close()


def message(state: DisplayState, now: float) -> dict[str, Any]:
    """Return the data of each picture: the fields of a JSON line, and what the page draws.

    Forces are in N, the time ``sent`` in s.

    Args:
        state: of the display.
        now: s, the host's monotonic clock.
    """
    verdict = state.assessment.verdict
    return {
        **verdict_message(state.assessment, state.notes, state.contacts, now),
        "number": state.number,
        "sent": time(),
        "values": [round(value, 3) for value in state.values.tolist()],
        "valid": state.valid.tolist(),
        "saturated": state.saturated.tolist(),
        "peak": [round(value, 3) for value in state.peak.tolist()],
        "held": state.held,
        "tangential": None if state.tangential is None else state.tangential.round(3).tolist(),
        "unknown": list(range(len(state.valid))) if verdict is None else list(verdict.unknown),
        "since": "" if verdict is None else contact_text(verdict.contact),
        "words": [] if verdict is None else verdict.words(),
        "line": state.line,
        "contact_text": contact_text_lines(state.contacts),
    }


def _application(display: Display) -> Starlette:

    async def pictures(request: Request) -> Response:
        return StreamingResponse(_events(display), media_type="text/event-stream")

    async def tare(request: Request) -> Response:
        # Another site's page can send a plain POST here, but not with a header of its own.
        if (order := request.headers.get("x-skin")) not in ("tare", "force"):
            return Response(status_code=403)
        refused = display.request_tare(monotonic(), force=order == "force")
        return JSONResponse({"reason": refused}, status_code=409) if refused else Response(status_code=204)

    async def info(request: Request) -> Response:
        if not len(display.positions):
            return Response(status_code=503)  # the page asks again
        return JSONResponse(
            {
                "title": display.title,
                "port": display.port,
                "top": display.top,
                "window": display.window,
                "size": display.size,
                "positions": display.positions.tolist(),
            }
        )

    return Starlette(
        routes=[
            Route(
                "/",
                FileResponse(
                    Path(__file__).with_name("page.html"),
                    media_type="text/html",
                    headers={"Cache-Control": "no-store"},
                ),
            ),
            Route("/skin.json", info),
            Route("/pictures", pictures),
            Route("/tare", tare, methods=["POST"]),
        ],
        # Other host names are refused, so that pages of other sites cannot read the skin.
        middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=[_HOST, "localhost"])],
    )


async def _events(display: Display) -> AsyncIterator[str]:
    due, number = monotonic(), display.state(monotonic()).number  # of the first picture: the latest frame
    while not display.closed.is_set():
        now = monotonic()
        state = display.state(now, number)
        number = state.number
        yield f"data: {json_line(message(state, now))}\n\n"
        # A picture that is a little late does not delay the next; those that are very late are left out.
        due = max(due + 1 / HERTZ, monotonic() - 1 / HERTZ)
        await asyncio.sleep(max(0.0, due - monotonic()))
