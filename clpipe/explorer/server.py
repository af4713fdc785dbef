"""The server of the page. It listens on this machine only, at an address with a random token."""

import json
import secrets
import socket
import struct
from collections.abc import Callable, Mapping
from contextlib import suppress
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.routing import Mount, Route

from clpipe.analysis.plot import noise_svg
from clpipe.analysis.svg import PAGE_FILES
from clpipe.base.errors import ClpipeError, KeyedError, RequestError
from clpipe.base.reading import parse_json
from clpipe.base.types import Array
from clpipe.chain.methods import TABLE_MODELS
from clpipe.explorer.controls import (
    camera_controls,
    key_controls,
    parameters_of,
    stage_controls,
)
from clpipe.explorer.explorer import Explorer
from clpipe.explorer.export import SAVED, exported
from clpipe.explorer.timeout import TimeoutProtocol
from clpipe.explorer.view import View
from clpipe.images.preview import reduce

HOST = "127.0.0.1"
MAX_REQUEST_BYTES = 1 << 20  # bytes of a request
MAX_COORDINATE = 1 << 20  # px, more than the side of an image
PAGE = "explore.html"
TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; connect-src 'self'; "
    "style-src 'self' 'unsafe-inline'; "  # Matplotlib's SVGs have styles
    "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}

Handler = Callable[[Mapping[str, Any]], Response]


class Server:
    """Serves an explorer to browsers on this machine.

    Args:
        explorer: the explorer.
        port: the port. 0 selects a free one.

    Raises:
        RequestError: the port is in use or not permitted.
    """

    def __init__(self, explorer: Explorer, port: int = 0) -> None:
        self._explorer = explorer
        token = secrets.token_urlsafe(16)
        self._socket = socket.socket()
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._socket.bind((HOST, port))
            self._socket.listen()
        except OSError as error:
            self._socket.close()
            raise RequestError(
                f"--port {port}: cannot be used: {error.strerror}. Choose another, or omit --port"
            ) from None
        self.address = f"http://{HOST}:{self._socket.getsockname()[1]}/{token}/"
        config = uvicorn.Config(
            self._app(token),
            http=TimeoutProtocol,
            log_level="error",
            access_log=False,
            server_header=False,
            lifespan="off",
            timeout_graceful_shutdown=1,
        )
        self._server = uvicorn.Server(config)

    def run(self) -> None:
        """Serve until :meth:`stop` or Ctrl-C."""
        with suppress(KeyboardInterrupt):
            self._server.run(sockets=[self._socket])

    def stop(self) -> None:
        """Make :meth:`run` return."""
        self._server.should_exit = True

    def _app(self, token: str) -> Starlette:
        handlers: dict[str, Handler] = {
            "start": self._start,
            "develop": self._develop,
            "pixels": self._pixels,
            "values": self._values,
            "noise": self._noise,
            "export": self._export,
        }
        routes = [
            *(Route(path, handler) for path, handler in page_files().items()),
            *(
                Route(f"/{name}", json_route(handler), methods=["POST"])
                for name, handler in handlers.items()
            ),
        ]
        hosts = Middleware(TrustedHostMiddleware, allowed_hosts=[HOST, "localhost"])
        return Starlette(routes=[Mount(f"/{token}", routes=routes)], middleware=[hosts])

    def _start(self, question: Mapping[str, Any]) -> Response:
        """Return the constants of a page: images, controls, and initial values."""
        explorer = self._explorer
        device = explorer.device
        return json_response(
            {
                "images": [job.key for job in explorer.jobs],
                "values": explorer.initial,
                "keys": key_controls(),
                "stages": stage_controls(),
                "tables": {name: parameters_of(model) for name, model in TABLE_MODELS.items()},
                "cameras": camera_controls(explorer.cameras),
                "device": device.info.label if device else "NumPy",
                "saved": SAVED,
            }
        )

    def _develop(self, question: Mapping[str, Any]) -> Response:
        """Develop an image. Return facts, and the visible part of the image, reduced.

        Sending the whole image to a browser takes longer than its development.
        """
        sample = self._explorer.develop(*parse_subject(question))
        left, top, width, height, by = whole_numbers(
            question, "left", "top", "width", "height", "by"
        )
        left, top = min(max(left, 0), MAX_COORDINATE), min(max(top, 0), MAX_COORDINATE)
        part = sample.shown[top : top + max(height, 0), left : left + max(width, 0)]
        small = reduce(np.ascontiguousarray(part), min(max(by, 1), 64)) if part.size else part
        place = {"left": left, "top": top, "width": part.shape[1], "height": part.shape[0]}
        return pixel_response(sample.facts, small, place)

    def _pixels(self, question: Mapping[str, Any]) -> Response:
        """Return all pixels of a recent result."""
        (number,) = whole_numbers(question, "number")
        return pixel_response({}, self._explorer.sample(number).shown, {})

    def _values(self, question: Mapping[str, Any]) -> Response:
        number, x, y = whole_numbers(question, "number", "x", "y")
        return json_response(self._explorer.values_at(number, x, y))

    def _noise(self, question: Mapping[str, Any]) -> Response:
        left, top, width, height = whole_numbers(question, "left", "top", "width", "height")
        report = self._explorer.noise(*parse_subject(question), (left, top, width, height))
        return json_response({"report": report.record(), "svg": noise_svg(report)})

    def _export(self, question: Mapping[str, Any]) -> Response:
        image, values, _ = parse_subject(question)
        return json_response(exported(self._explorer, image, values))


def page_files() -> dict[str, Callable[[Request], Response]]:
    """Return the routes of the files of the page, by path."""
    folder = resources.files("clpipe.explorer") / "page"
    return {
        "/" if file.name == PAGE else f"/{file.name}": file_route(
            file.read_bytes(), TYPES[Path(file.name).suffix]
        )
        for file in (*PAGE_FILES.iterdir(), *folder.iterdir())
    }


def file_route(content: bytes, media_type: str) -> Callable[[Request], Response]:
    """Return a route that serves a file."""
    return lambda _: Response(content, media_type=media_type, headers=HEADERS)


def json_route(handler: Handler) -> Callable[[Request], Any]:
    """Return a route for requests in JSON. Errors are JSON with the key that they concern."""

    async def respond(request: Request) -> Response:
        body = b""
        try:
            async for part in request.stream():
                body += part
                if len(body) > MAX_REQUEST_BYTES:
                    return error_response(
                        f"the request is longer than {MAX_REQUEST_BYTES} bytes", status=413
                    )
            question = parse_json(body or b"{}")
            if not isinstance(question, dict):
                raise ValueError("expected an object")
        except ValueError as error:
            return error_response(f"the request is not valid JSON: {error}")
        except ClientDisconnect:
            return Response()  # the client has gone
        try:
            return await run_in_threadpool(handler, question)
        except ClpipeError as error:
            return error_response(str(error), error.key if isinstance(error, KeyedError) else "")

    return respond


def pixel_response(facts: Mapping[str, Any], pixels: Array, place: Mapping[str, int]) -> Response:
    """Return the length of the JSON in four bytes, the JSON, and RGB with a byte per channel.

    The JSON contains the facts. Its "part" states the position and size of the pixels in the image.
    """
    height, width = pixels.shape[:2]
    part = {**place, "columns": width, "rows": height}
    said = json.dumps({**facts, "part": part}, allow_nan=False).encode()
    body = struct.pack("<I", len(said)) + said + pixels.tobytes()
    return Response(body, media_type="application/octet-stream", headers=HEADERS)


def json_response(value: Any, status: int = 200) -> Response:
    """Return a value as ASCII JSON, because file names may not be UTF-8."""
    text = json.dumps(value, allow_nan=False)
    return Response(text, status, HEADERS, "application/json")


def error_response(text: str, key: str = "", status: int = 400) -> Response:
    """Return an error for the page."""
    return json_response({"error": text, "key": key}, status)


def parse_subject(question: Mapping[str, Any]) -> tuple[int, Mapping[str, Any], View]:
    """Return the image, the values and the view of a request.

    Raises:
        RequestError: one is missing or has a wrong type.
    """
    (image,) = whole_numbers(question, "image")
    values, step, truth = (
        question.get("values"),
        question.get("step", ""),
        question.get("truth", ""),
    )
    if not isinstance(values, dict) or not isinstance(step, str) or not isinstance(truth, str):
        raise RequestError("the request has no values or no view")
    return image, values, View(step, truth)


def whole_numbers(question: Mapping[str, Any], *names: str) -> tuple[int, ...]:
    """Return integers of a request by their names.

    Raises:
        RequestError: one is missing or has another type.
    """
    found = tuple(question.get(name) for name in names)
    if not all(type(value) is int for value in found):
        raise RequestError(f"the request needs the whole numbers {', '.join(names)}")
    return tuple(value for value in found if isinstance(value, int))
