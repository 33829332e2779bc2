"""The report in a real browser: every picture visible, and not one request to anywhere. Skips without a Chromium."""

from __future__ import annotations

import shutil
import socket
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image

from pipeline.config import EvaluationConfig
from pipeline.evaluation.evaluate import Answers, score
from pipeline.evaluation.protocol import protocols
from pipeline.evaluation.report import figures
from pipeline.evaluation.report.error_plots import areas
from pipeline.evaluation.report.page import write_page
from pipeline.evaluation.report.pictures import draw
from pipeline.evaluation.sets.evaluation_set import EvaluationSet

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
QUIET = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--hide-scrollbars", "--window-size=1200,3000",
)  # fmt: skip


@contextmanager
def listening() -> Iterator[tuple[int, list[str]]]:
    """A proxy that answers nothing and keeps the first line of every request: (port, lines)."""
    heard: list[str] = []
    with socket.create_server(("127.0.0.1", 0)) as server:

        def listen() -> None:
            while True:
                try:
                    connection, _ = server.accept()
                except OSError:
                    return
                with connection:
                    heard.append(connection.recv(4096).decode(errors="replace").split("\r\n")[0])

        thread = threading.Thread(target=listen, daemon=True)
        thread.start()
        yield server.getsockname()[1], heard
        server.shutdown(socket.SHUT_RDWR)
        thread.join(10)


def visit(page: Path, folder: Path) -> tuple[np.ndarray, list[str]]:
    """(screenshot [H, W, 3], hosts that the page asked).

    A browser also calls home; a page without scripts can only ask hosts that its text names.
    """
    assert CHROMIUM is not None
    picture = folder / f"{page.stem}.png"
    with listening() as (port, heard):
        proxy = (f"--proxy-server=http://127.0.0.1:{port}", "--proxy-bypass-list=<-loopback>")
        command = [CHROMIUM, *QUIET, *proxy, f"--user-data-dir={folder}/profile", f"--screenshot={picture}"]
        subprocess.run([*command, page.as_uri()], check=True, capture_output=True, timeout=120)
    hosts = {urlsplit(line.split(" ")[1] if "://" in line else "//" + line.split(" ")[1]).hostname for line in heard}
    named = sorted(host for host in hosts if host and host in page.read_text())
    return np.asarray(Image.open(picture).convert("RGB")).astype(int), named


def share(pixels: np.ndarray, colour: str) -> float:
    wanted = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    return float((np.abs(pixels - wanted).max(axis=-1) < 30).mean())


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_the_report_is_seen_whole_and_asks_nobody(tmp_path: Path) -> None:
    blue = np.full((240, 320, 3), (20, 40, 220), np.uint8)
    photos = [tmp_path / f"{i}.png" for i in range(8)]
    for path in photos:
        Image.fromarray(blue).save(path)
    config = EvaluationConfig(groups=("single",), recalls=(1, 2))
    positives = [np.array([q], np.int64) for q in range(4)]
    street = EvaluationSet("street", photos, photos[:4], positives, "pairs")
    rows, far = np.array([[0, 1], [1, 2], [3, 2], [4, 5]]), np.ones((4, 2), np.float32)
    result = score(street, protocols(config, 224, "pairs")[0], config, Answers(rows, far))
    pictures = draw([result], [street], tmp_path / "figures")
    page = tmp_path / "report.html"
    write_page([result], pictures, page, "Street", {"checkpoint": "none"})
    seen, heard = visit(page, tmp_path)
    assert heard == []
    assert share(seen, "#1428dc") > 0.02 and min(share(seen, c) for c in (figures.GREEN, figures.RED)) > 0.0005

    # the same page with a picture from elsewhere: the listener does hear, and nothing is seen
    text = page.read_text()
    for start in ("data:image/jpeg;base64,", "data:image/png;base64,"):
        text = text.replace(start, "http://pictures.invalid/")
    poisoned = tmp_path / "poisoned.html"
    poisoned.write_text(text)
    seen, heard = visit(poisoned, tmp_path)
    assert heard == ["pictures.invalid"] and share(seen, "#1428dc") < 0.001


def test_cities_are_areas_of_their_own() -> None:
    rng = np.random.Generator(np.random.PCG64(0))
    middles = np.array([[0.0, 0.0], [60_000.0, 0.0], [0.0, 40_000.0]])
    member = rng.integers(0, 3, 200)
    found = areas(middles[member] + rng.uniform(-1_500, 1_500, (200, 2)))
    assert len(set(zip(found, member, strict=True))) == 3 == len(set(found))
    road = np.stack([np.arange(0, 30_000, 900.0), np.zeros(34)], 1)
    assert set(areas(road)) == {0}
