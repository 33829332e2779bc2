"""A local page that answers "where was this photo taken": drop a photo, see the best places side by side and on a map.

It listens on 127.0.0.1 alone and keeps model and index ready, so that a question costs no imports. Flask and Werkzeug
are the server; the page has no map library: positions of the index are drawn as points, north up, without a network.

Invariant: nothing of a request is ever a path. An upload stays in memory and is bounded before it is decoded; photos of
the index are given out by their row alone, made small anew. Only the host names of this machine are answered, so that
no page of the web can read photos by pointing a name of its own here (DNS rebinding), and only a page of this server
may post. Every name is escaped.
"""

from __future__ import annotations

import base64
import io
import threading
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import numpy as np

from pipeline.common.errors import DataError, UsageError
from pipeline.common.text import printable, shown
from pipeline.data.images import ADVICE, load_image
from pipeline.locate.answers import Answer, Found, Locator

if TYPE_CHECKING:
    from flask import Flask
    from werkzeug.serving import BaseWSGIServer

UPLOAD_BYTES = 32 * 2**20  # of a request
SIDE = 640  # pixels of a photo on the page, at most
HOSTS = ["127.0.0.1", "localhost"]
DOTS = 4_000  # photos of the index on the map; of more, so many spread over it
MAP = (560, 420)  # its width and height
MARGIN = 24
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; img-src 'self' data:; style-src 'unsafe-inline'; "
    "script-src 'self'; connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "same-origin",  # with none at all a browser posts with the origin "null"
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
}


def make_app(locator: Locator, count: int) -> Flask:
    """The pages: `/` (form and, after a post, answers), `/photo/ROW` (a photo of the index, small), `/page.js`."""
    from flask import Flask, Response, abort, render_template, request
    from werkzeug.exceptions import HTTPException, SecurityError

    app = Flask(__name__, template_folder=".", static_folder=None)
    app.config.update(MAX_CONTENT_LENGTH=UPLOAD_BYTES, MAX_FORM_PARTS=4, MAX_FORM_MEMORY_SIZE=4096, TRUSTED_HOSTS=HOSTS)
    index, one_at_a_time = locator.index, threading.Lock()
    render = partial(
        render_template,
        "page.html",
        index=printable(index.folder.name),
        photos=len(index.photos),
        no_match_from=index.calibration.threshold,
        how=index.calibration.how,
        radius=locator.radius,
    )

    @app.before_request
    def only_from_here() -> None:
        origin = request.headers.get("Origin")
        own = origin is None or urlsplit(origin).netloc == request.host
        if request.method == "POST" and (not own or request.headers.get("Sec-Fetch-Site") == "cross-site"):
            abort(403)

    @app.after_request
    def with_headers(response: Response) -> Response:
        response.headers.update(HEADERS)
        return response

    @app.errorhandler(HTTPException)
    def told(error: HTTPException) -> tuple[str, int]:
        if isinstance(error, SecurityError):  # the page under that name could read this answer: it tells nothing
            return "this name is not answered; open http://127.0.0.1", 400
        reason = error.description or error.name
        if error.code == 413:
            reason = f"the photo is larger than {UPLOAD_BYTES // 2**20} MB; send a smaller one"
        return render(problem=reason), error.code or 500

    @app.get("/")
    def ask() -> str:
        return render()

    @app.post("/")
    def answer() -> str | tuple[str, int]:
        upload = request.files.get("photo")
        data = upload.read() if upload is not None else b""
        if upload is None or not data:
            return render(problem="no photo was sent; choose one, or drop it on the page"), 400
        name = shown(upload.filename or "photo")
        try:
            picture = small_jpeg(data)
            with one_at_a_time:  # the model has one set of buffers, and the machine one user
                found = locator.answer(Path(name), count, data)
        except DataError as error:
            reason = str(error).removesuffix(ADVICE)
            return render(problem=f"{name}: {reason}"), 400
        asked = f"data:image/jpeg;base64,{base64.b64encode(picture).decode()}"
        return render(name=name, answer=found, asked=asked, cards=cards(locator, found), map=drawn(locator, found))

    @app.get("/photo/<int:row>")
    def photo(row: int) -> Response:
        if row >= len(index.photos):
            abort(404, "no such photo in the index")
        try:
            return Response(small_jpeg(index.photos[row]), mimetype="image/jpeg")
        except DataError:
            abort(404, "this photo of the index can no longer be read")

    @app.get("/page.js")
    def script() -> Response:
        return Response((Path(__file__).parent / "page.js").read_text(), mimetype="text/javascript")

    return app


def listen(locator: Locator, count: int, port: int) -> BaseWSGIServer:
    """The server on 127.0.0.1, bound and not yet serving: call its `serve_forever`. `port` 0 takes a free one.

    Raises:
        UsageError: the port is in use.
    """
    import socket

    from werkzeug.serving import WSGIRequestHandler, make_server

    class Quiet(WSGIRequestHandler):
        def log_request(self, code: int | str = "-", size: int | str = "-") -> None:
            """Nothing: names of photos are nobody's."""

    with socket.socket() as tried:  # Werkzeug would print lines of its own and end the process
        tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            tried.bind(("127.0.0.1", port))
        except (OSError, OverflowError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise UsageError(f"--port {port}: cannot listen there ({reason}); give another one") from None
    app = make_app(locator, count)
    return make_server("127.0.0.1", port, app, threaded=True, request_handler=Quiet)


def small_jpeg(source: Path | bytes) -> bytes:
    """A photo of at most `SIDE` pixels a side, upright, without its EXIF. Raises `DataError` as `load_image`."""
    image = load_image(source)
    image.thumbnail((SIDE, SIDE))
    data = io.BytesIO()
    image.save(data, "JPEG", quality=85)
    return data.getvalue()


def cards(locator: Locator, answer: Answer) -> list[dict[str, Any]]:
    """What the page tells of each answer."""
    return [
        {
            "row": found.row,
            "name": printable(found.place.name),
            "distance": f"{found.distance:.3f}",
            "sure": None if found.confidence is None else f"{100 * found.confidence:.0f}",
            "where": _where(found, locator.index.zone),
            "away": None if found.metres is None else f"{found.metres:,.0f} m",
            "right": found.right,
        }
        for found in answer.found
    ]


def _where(found: Found, zone: str) -> list[str]:
    told = []
    if found.degrees is not None:
        told.append(f"{found.degrees[0]:.6f}, {found.degrees[1]:.6f}")
    if found.utm is not None:
        told.append(f"{found.utm[0]:.0f} E {found.utm[1]:.0f} N {zone}".rstrip())
    return told


def drawn(locator: Locator, answer: Answer) -> dict[str, Any] | None:
    """The index's positions and the answers as points of a drawing, `MAP` units wide and high; None without positions.

    Metres are drawn as they are; degrees with longitude shortened by the cosine of the middle latitude.
    """
    index = locator.index
    if index.positions is None:
        return None
    flat = _flat(index.positions, index.coordinates)
    known = flat[~np.isnan(flat[:, 0])]
    shown_dots = known[:: max(1, -(-len(known) // DOTS))]
    marks = [(rank, flat[found.row]) for rank, found in enumerate(answer.found, 1) if not np.isnan(flat[found.row, 0])]
    low, high = known.min(axis=0), known.max(axis=0)
    span = np.maximum(high - low, 1e-9)
    room = np.array(MAP) - 2 * MARGIN
    scale = float((room / span).min()) if (high > low).any() else 1.0
    middle = (low + high) / 2

    def at(point: np.ndarray) -> tuple[float, float]:
        x, y = (point - middle) * scale
        return round(MAP[0] / 2 + float(x), 1), round(MAP[1] / 2 - float(y), 1)

    # the metres of a scale bar of at most a third of the width: 1, 2 or 5 times a power of ten
    per_metre = scale if index.coordinates == "utm" else scale / 111_320
    longest = MAP[0] / 3 / per_metre
    power = 10.0 ** np.floor(np.log10(longest))
    bar = power * max(step for step in (1, 2, 5) if step * power <= longest)
    usable = (high > low).any()
    return {
        "width": MAP[0],
        "height": MAP[1],
        "dots": [at(point) for point in shown_dots],
        "marks": [(rank, *at(point)) for rank, point in reversed(marks)],
        "bar": (round(bar * per_metre, 1), f"{bar:,.0f} m" if bar >= 1 else f"{bar:g} m") if usable else None,
    }


def _flat(positions: np.ndarray, coordinates: str) -> np.ndarray:
    """Positions [n, 2] as east and north [n, 2] on one scale."""
    if coordinates == "utm":
        return positions
    latitude, longitude = positions.T
    return np.stack([longitude * np.cos(np.radians(np.nanmean(latitude))), latitude], axis=1)
