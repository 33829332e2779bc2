"""The local page: real HTTP uploads, what it refuses, and a photo chosen and dropped in a real browser."""

from __future__ import annotations

import base64
import contextlib
import http.client
import io
import json
import os
import re
import shutil
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from located import degrees, write
from PIL import Image
from tiny_checkpoint import save_tiny

from pipeline.common.errors import UsageError
from pipeline.config import EvaluationConfig
from pipeline.locate import server
from pipeline.locate.answers import Locator
from pipeline.locate.photo_index import make_index
from pipeline.locate.server import listen
from pipeline.model.weights.files import load_model

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
HOSTILE = '<img src=x onerror=alert(1)>"&.jpg'


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model, and 25 photos along a street, one of them with a hostile name, and one without a position."""
    folder = tmp_path_factory.mktemp("home")
    save_tiny(folder / "run", 0)
    for place in range(25):
        name = HOSTILE if place == 3 else f"p{place:02d}.jpg"
        tags = None if place == 7 else degrees(45.0 + place / 500, 7.5 + (place % 5) / 1000)
        write(folder / "p" / name, tags, place)
    return folder


@pytest.fixture(scope="module")
def port(home: Path) -> Iterator[int]:
    model = load_model(home / "run")
    config = EvaluationConfig(workers=0, batch=8)
    index = make_index(model, home / "p", home / "index", config, "cpu", "f", progress=False)
    serving = listen(Locator(model, index, "cpu"), 5, 0)
    thread = threading.Thread(target=serving.serve_forever, daemon=True)
    thread.start()
    yield serving.server_port
    serving.shutdown()
    serving.server_close()
    thread.join(10)


def ask(port: int, method: str, path: str, body: bytes = b"", **headers: str) -> tuple[int, str, dict[str, str]]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    connection.request(method, path, body or None, {name.replace("_", "-"): value for name, value in headers.items()})
    with contextlib.closing(connection.getresponse()) as answer:
        return answer.status, answer.read().decode("latin-1"), dict(answer.headers)


def upload(port: int, data: bytes, name: str = "asked.jpg", **headers: str) -> tuple[int, str, dict[str, str]]:
    quoted = name.replace('"', "%22")
    body = (
        f'--x\r\nContent-Disposition: form-data; name="photo"; filename="{quoted}"\r\n\r\n'.encode()
        + data
        + b"\r\n--x--\r\n"
    )
    return ask(port, "POST", "/", body, Content_Type="multipart/form-data; boundary=x", **headers)


def test_an_upload_is_answered(port: int, home: Path) -> None:
    status, page, headers = upload(port, (home / "p" / HOSTILE).read_bytes(), HOSTILE)
    assert status == 200 and "default-src 'none'" in headers["Content-Security-Policy"]
    assert "<img src=x" not in page and "&lt;img src=x onerror=alert(1)&gt;" in page
    rows = [int(row) for row in re.findall(r'src="/photo/(\d+)"', page)]
    files = sorted(home.glob("p/*"))
    assert len(rows) == 5 and files[rows[0]].name == HOSTILE
    assert "0 m away, right" in page and "distance 0.000" in page and "45.006000, 7.503000" in page
    assert (
        page.count('class="mark"') + (7 in rows) == 5 and "Probably on this map" in page and "100 % confidence" in page
    )
    status, small, headers = ask(port, "GET", f"/photo/{rows[0]}")
    picture = Image.open(io.BytesIO(small.encode("latin-1")))
    assert status == 200 and headers["Content-Type"] == "image/jpeg" and not picture.getexif()


def test_what_is_refused(port: int, home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = (home / "p" / "p01.jpg").read_bytes()
    for host in ("evil.example", f"evil.example:{port}", f"127.0.0.1.evil.example:{port}"):
        for path in ("/", "/photo/0", "/page.js"):
            status, told, _ = ask(port, "GET", path, Host=host)
            assert status == 400 and "index" not in told and "<" not in told, (host, path, told)
    assert ask(port, "GET", "/", Host=f"localhost:{port}")[0] == 200
    assert upload(port, data, Origin="http://evil.example")[0] == 403
    assert upload(port, data, Origin="null")[0] == 403
    assert upload(port, data, Sec_Fetch_Site="cross-site")[0] == 403
    assert upload(port, data, Origin=f"http://127.0.0.1:{port}")[0] == 200
    for path in ("/photo/25", "/photo/-1", "/photo/../../etc/passwd", "/photo/%2e%2e%2fp%2fp01.jpg", "/server.py",
                 "/page.html", "/photo/99999999999999999999"):  # fmt: skip
        assert ask(port, "GET", path)[0] == 404, path
    for broken in (b"no photo", data[:300], b""):
        status, page, _ = upload(port, broken, "../../etc/passwd")
        assert status == 400 and 'role="alert"' in page and "Traceback" not in page
    monkeypatch.setattr("pipeline.common.pictures.MAX_PIXELS", 1000)
    bomb = io.BytesIO()
    Image.new("RGB", (40, 40)).save(bomb, "PNG")
    status, page, _ = upload(port, bomb.getvalue())
    assert status == 400 and "too large: 40 x 40 pixels" in page
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    connection.putrequest("POST", "/")
    connection.putheader("Content-Type", "multipart/form-data; boundary=x")
    connection.putheader("Content-Length", str(server.UPLOAD_BYTES + 1))
    connection.endheaders()
    with contextlib.closing(connection.getresponse()) as answer:
        assert answer.status == 413 and b"larger than 32 MB" in answer.read()


def test_it_listens_on_this_machine_alone(port: int, home: Path) -> None:
    with open("/proc/net/tcp") as table:  # noqa: PTH123
        local = [line.split()[1] for line in table if line.split()[1].endswith(f":{port:04X}") and " 0A " in line]
    assert local == [f"0100007F:{port:04X}"]
    with pytest.raises(UsageError, match=f"--port {port}: cannot listen"):
        listen(None, 5, port)  # type: ignore[arg-type]


class Browser:
    """A headless Chromium, driven by the DevTools protocol over two pipes (`--remote-debugging-pipe`)."""

    def __init__(self, profile: Path) -> None:
        assert CHROMIUM is not None
        (to_browser, self._out), (self._in, from_browser) = os.pipe(), os.pipe()
        command = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--hide-scrollbars",
                   "--window-size=1200,1300", f"--user-data-dir={profile}", "--remote-debugging-pipe"]  # fmt: skip
        shell = f'exec "$@" 3<&{to_browser} 4>&{from_browser}'
        self._process = subprocess.Popen(
            ["bash", "-c", shell, "bash", *command],
            pass_fds=(to_browser, from_browser),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(to_browser)
        os.close(from_browser)
        self._count, self._rest, self._session = 0, b"", ""
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]

    def call(self, method: str, **parameters: Any) -> Any:
        self._count += 1
        message = {"id": self._count, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        while True:
            while b"\0" not in self._rest:
                part = os.read(self._in, 1 << 16)
                assert part, "the browser has gone"
                self._rest += part
            answer, _, self._rest = self._rest.partition(b"\0")
            told = json.loads(answer)
            if told.get("id") == self._count:
                assert "error" not in told, told
                return told["result"]

    def value(self, expression: str) -> Any:
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def until(self, expression: str) -> None:
        deadline = time.monotonic() + 60
        while not self.value(expression):
            assert time.monotonic() < deadline, (expression, self.value("document.documentElement.outerHTML"))
            time.sleep(0.05)

    def picture(self, path: Path) -> None:
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", captureBeyondViewport=True)["data"]))

    def close(self) -> None:
        self._process.kill()
        self._process.wait(30)
        os.close(self._in)
        os.close(self._out)


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_a_photo_is_chosen_and_dropped_in_a_browser(port: int, home: Path, tmp_path: Path) -> None:
    whole = "document.readyState == 'complete' && document.body.className.includes('scripted')"
    names = "document.querySelector('.places .card .told').innerText"
    with contextlib.closing(Browser(tmp_path / "profile")) as browser:
        browser.call("Page.navigate", url=f"http://127.0.0.1:{port}/")
        browser.until(f"{whole} && document.body.className.includes('first')")
        node = browser.call("DOM.getDocument")["root"]["nodeId"]
        field = browser.call("DOM.querySelector", nodeId=node, selector="input[type=file]")["nodeId"]
        browser.call("DOM.setFileInputFiles", nodeId=field, files=[str(home / "p" / "p12.jpg")])
        browser.until(f"{whole} && !!document.querySelector('.places') && {names}.includes('p12.jpg')")

        data = {"items": [], "files": [str(home / "p" / HOSTILE)], "dragOperationsMask": 1}
        for kind in ("dragEnter", "dragOver", "drop"):
            browser.call("Input.dispatchDragEvent", type=kind, x=600, y=700, data=data)
        browser.until(f"{whole} && !!document.querySelector('.places') && {names}.includes('onerror=alert(1)')")
        browser.until("[...document.images].every(i => i.complete)")
        assert browser.value("[...document.images].every(i => i.naturalWidth > 0)")
        assert browser.value("document.images.length") == 6 and browser.value("document.scripts.length") == 1
        assert browser.value("document.querySelectorAll('svg .mark').length") >= 4
        assert browser.value("document.documentElement.scrollWidth <= innerWidth")
        assert browser.value("getComputedStyle(document.querySelector('.places .card')).borderTopColor") == (
            "rgb(26, 152, 80)"
        )
        browser.picture(tmp_path / "page.png")
    seen = np.asarray(Image.open(tmp_path / "page.png").convert("RGB")).reshape(-1, 3)
    assert len(np.unique(seen, axis=0)) > 1000  # photos, not an empty page
