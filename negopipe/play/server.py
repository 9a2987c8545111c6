"""The server of the page: this machine only, static files and JSON, one thread per request."""

import errno
import json
import logging
import traceback
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from negopipe.errors import UserError
from negopipe.play.service import Service, UnknownEncounter

log = logging.getLogger("negopipe")

HOST = "127.0.0.1"
"""The server listens on loopback only."""
NAMES = (HOST, "localhost", "[::1]")
"""Names of this machine that a request may be addressed to; a foreign page that has its name point here has another."""

PAGE = Path(__file__).parent / "page"
TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
}
FILES = {f"/{path.name}": path for path in PAGE.iterdir() if path.suffix in TYPES} | {"/": PAGE / "index.html"}
"""Static files by their address; no path of a request is looked up on the disk."""

MOST_BYTES = 4096
"""Longest body of a request."""
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data:; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


class Refused(Exception):
    """A request that is refused; status: of HTTP, reason: in one line."""

    def __init__(self, status: int, reason: str) -> None:
        super().__init__(reason)
        self.status = status


class Handler(BaseHTTPRequestHandler):
    """Answers one request."""

    protocol_version = "HTTP/1.1"
    server: "Server"

    def do_GET(self) -> None:
        self._answer(self._get)

    def do_POST(self) -> None:
        self._answer(self._post)

    def _get(self) -> tuple[bytes, str]:
        path = urlsplit(self.path).path
        if path in FILES:
            return FILES[path].read_bytes(), TYPES[FILES[path].suffix]
        match path.strip("/").split("/"):
            case ["api", "menu"]:
                return _json(self.server.service.menu())
            case ["api", "encounters", key]:
                return _json(self.server.service.look(key))
        raise Refused(404, "there is no such page")

    def _post(self) -> tuple[bytes, str]:
        given = self._body()
        match urlsplit(self.path).path.strip("/").split("/"):
            case ["api", "encounters"]:
                asked = (given.get(name) for name in ("opponent", "street", "control"))
                return _json(self.server.service.begin(*asked))
            case ["api", "encounters", key, "step"]:
                asked = (given.get(name) for name in ("step", "command", "opponent_command"))
                return _json(self.server.service.step(key, *asked))
        raise Refused(404, "there is no such page")

    def _body(self) -> dict[str, Any]:
        """The JSON object of the request. Its type makes browsers ask before they send it from a foreign page."""
        if self.headers.get_content_type() != "application/json":
            raise Refused(415, "the body must be application/json")
        length = self.headers.get("Content-Length", "")
        if not (length.isdecimal() and int(length) <= MOST_BYTES):
            raise Refused(413, f"the body must have a length up to {MOST_BYTES} bytes")
        try:
            given = json.loads(self.rfile.read(int(length)))
        except ValueError as error:
            raise Refused(400, "the body must be JSON") from error
        if not isinstance(given, dict):
            raise Refused(400, "the body must be a JSON object")
        return given

    def _check_origin(self) -> None:
        port = self.server.server_address[1]
        places = {f"{name}:{port}" for name in NAMES}
        host, origin = self.headers.get("Host", ""), self.headers.get("Origin")
        if host not in places or (origin is not None and origin not in {f"http://{place}" for place in places}):
            raise Refused(403, f"requests must come from a page of this server, http://{HOST}:{port}")

    def _answer(self, method: Any) -> None:
        try:
            self._check_origin()
            self._send(200, *method())
        except Refused as refused:
            self.close_connection = True  # the body may not have been read
            self._send(refused.status, *_json({"error": str(refused)}))
        except UnknownEncounter:
            self._send(404, *_json({"error": "this server has no such encounter"}))
        except UserError as error:
            self._send(400, *_json({"error": str(error)}))
        except (BrokenPipeError, ConnectionResetError):
            self.close_connection = True  # the page is gone
        except Exception as error:
            traceback.print_exc()
            self._send(500, *_json({"error": f"the server failed with {type(error).__name__}"}))

    def _send(self, status: int, content: bytes, type_: str) -> None:
        self.send_response(status)
        headers = HEADERS | {"Content-Type": type_, "Content-Length": str(len(content))}
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: Any) -> None:
        """Requests are not logged."""


class Server(ThreadingHTTPServer):
    """The server of a service; UserError where its port is not free. port: 0 = any that is free."""

    daemon_threads = True

    def __init__(self, service: Service, port: int) -> None:
        self.service = service
        try:
            super().__init__((HOST, port), Handler)
        except OSError as error:
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                raise
            raise UserError(f"play.port must be free (0 = any that is), got {port}: {error.strerror}") from error

    @property
    def address(self) -> str:
        return f"http://{HOST}:{self.server_address[1]}"


def _json(value: Any) -> tuple[bytes, str]:
    return json.dumps(value, allow_nan=False).encode(), "application/json"
