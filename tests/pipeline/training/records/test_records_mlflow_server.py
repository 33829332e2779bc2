"""The tracker against a real MLflow server: a run recorded over HTTP, behind a password, a server that dies in mid-run;
and the command that is printed to see a local store."""

from __future__ import annotations

import base64
import dataclasses
import json
import os
import shlex
import signal
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from processes import free_port

from pipeline.common.errors import UsageError
from pipeline.config import RunConfig, TrackingConfig, recorded
from pipeline.training.records.tracking import Tracker, how_to_open, open_client, record_evaluation, store_uri

pytestmark = pytest.mark.slow  # a server takes ten seconds to start


@contextmanager
def server(folder: Path) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """A server in a process group of its own: (its address, the process)."""
    port = free_port()
    command = [
        sys.executable, "-m", "mlflow", "server", "--host", "127.0.0.1", "--port", str(port), "--workers", "1",
        "--backend-store-uri", f"sqlite:///{folder}/mlflow.db", "--artifacts-destination", str(folder / "artifacts"),
    ]  # fmt: skip
    environment = {**os.environ, "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
    with (folder / "server.log").open("wb") as log:
        process = subprocess.Popen(command, env=environment, stdout=log, stderr=log, start_new_session=True)
    uri = f"http://127.0.0.1:{port}"
    try:
        for _ in range(900):
            try:
                urllib.request.urlopen(f"{uri}/health", timeout=1)
                break
            except OSError:
                assert process.poll() is None, (folder / "server.log").read_text()[-2000:]
                time.sleep(0.1)
        yield uri, process
    finally:
        kill(process)


def kill(process: subprocess.Popen[bytes]) -> None:
    """The server and its workers, at once."""
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait(30)


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_TIMEOUT", "20")
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)


def test_a_run_is_recorded_over_http_and_a_dead_server_costs_a_warning(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with server(tmp_path) as (uri, process):
        config = RunConfig(name="far", output=str(tmp_path / "outputs"), tracking=TrackingConfig(uri=uri))
        tracker = Tracker(config)
        for step in (1, 2, 3):
            tracker.metrics({"train/loss": 1.0 / step, "validation/city.single.recall_at_1": 10.0 * step}, step)
        checkpoint = tmp_path / "outputs" / "far" / "checkpoints" / "step-00000003"
        tracker.checkpoint(checkpoint, 3, {"validation/city.single.recall_at_1": 30.0})
        tracker.close("FINISHED")
        client = open_client(uri)
        run = client.get_run(tracker.run_id)
        assert run.info.run_name == "far" and run.info.status == "FINISHED" and run.data.params["seed"] == "0"
        history = client.get_metric_history(tracker.run_id, "train/loss")
        assert [(m.step, round(m.value, 6)) for m in history] == [(1, 1.0), (2, 0.5), (3, 0.333333)]
        artifacts = {a.path for a in client.list_artifacts(tracker.run_id)}
        assert {"config.yaml", "environment.yaml"} <= artifacts
        (model,) = client.search_logged_models([run.info.experiment_id])
        assert model.tags["checkpoint"] == str(checkpoint)

        again = Tracker(config, run_id=tracker.run_id)  # a resumed run continues its own
        again.metrics({"train/loss": 0.2}, 4)
        assert client.get_run(tracker.run_id).info.status == "RUNNING"
        capfd.readouterr()
        kill(process)
        started = time.monotonic()
        again.metrics({"train/loss": 0.1}, 5)
        again.checkpoint(checkpoint, 5, {"validation/city.single.recall_at_1": 40.0})
        again.close("FINISHED")
        told = capfd.readouterr().err
        assert "warning: MLflow did not record" in told and "checkpoint of step 5" in told
        assert time.monotonic() - started < 90
        with pytest.raises(UsageError, match="cannot be used"):
            Tracker(config)


@contextmanager
def door(uri: str, user: str, password: str) -> Iterator[str]:
    """A server before `uri` that lets in who knows the password; its address."""
    key = "Basic " + base64.b64encode(f"{user}:{password}".encode()).decode()

    class Door(BaseHTTPRequestHandler):
        def pass_on(self) -> None:
            body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            code, answer, kind = 401, b"who are you?", "text/plain"
            if self.headers.get("Authorization") == key:
                headers = {k: v for k, v in self.headers.items() if k in ("Content-Type", "Accept")}
                asked = urllib.request.Request(uri + self.path, body or None, headers, method=self.command)
                try:
                    reply = urllib.request.urlopen(asked, timeout=60)
                except urllib.error.HTTPError as error:
                    reply = error
                code, answer, kind = reply.status, reply.read(), reply.headers.get("Content-Type", "text/plain")
            self.send_response(code)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(answer)))
            self.end_headers()
            self.wfile.write(answer)

        do_GET = do_POST = do_PATCH = do_PUT = do_DELETE = pass_on

        def log_message(self, format: str, *arguments: object) -> None:
            pass

    port = free_port()
    with ThreadingHTTPServer(("127.0.0.1", port), Door) as listening:
        threading.Thread(target=listening.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{port}"
        listening.shutdown()


def test_a_server_behind_a_password_and_no_trace_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Recorded, registered and evaluated with user and password in the address; without them one line says 401."""
    for name in ("MLFLOW_TRACKING_USERNAME", "MLFLOW_TRACKING_PASSWORD"):
        monkeypatch.setenv(name, "")
    output = tmp_path / "outputs"
    with server(tmp_path) as (behind, _), door(behind, "me", "s3cret") as uri:
        config = RunConfig(name="far", output=str(output), tracking=TrackingConfig(uri=uri, register="town"))
        with pytest.raises(UsageError, match=f"{uri} cannot be used: .*401"):
            Tracker(config)
        known = uri.replace("://", "://me:s3cret@")
        tracker = Tracker(dataclasses.replace(config, tracking=TrackingConfig(uri=known, register="town")))
        (output / "far" / "evaluation").mkdir(parents=True)
        (output / "far" / "config.json").write_text(json.dumps(recorded(tracker.config)))
        (output / "far" / "train.log").write_text("step 1")
        (output / "far" / "evaluation" / "report.html").write_text("recalls")
        tracker.metrics({"train/loss": 1.0}, 1)
        tracker.checkpoint(output / "far/checkpoints/step-1", 1, {"validation/a.single.recall_at_5": 30.0})
        tracker.finished(lambda folder: (folder / "model.safetensors").write_bytes(b"weights"))
        tracker.close("FINISHED")
        written = {"mlflow_run_id": tracker.run_id, "step": 1}
        assert record_evaluation(output / "far", written, {"a.single.recall_at_1": 44.0}, output / "far/evaluation")
        run = open_client(store_uri(known, "")).get_run(tracker.run_id)
        assert run.data.params["tracking.uri"] == uri and run.data.metrics["evaluation/a.single.recall_at_1"] == 44.0
        assert open_client(uri).get_model_version("town", "1").run_id == tracker.run_id
        assert "s3cret" not in tracker.where()
    told = capfd.readouterr()
    assert "warning" not in told.err and "registered in MLflow: town, version 1" in told.err
    assert "s3cret" not in told.out + told.err
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert any(path.name == "model.safetensors" for path in files), "the server keeps the files"
    assert not [path for path in files if b"s3cret" in path.read_bytes()]


def test_the_printed_command_serves_and_leaves_no_process_behind(tmp_path: Path) -> None:
    """Typed in a shell as it is printed; SIGTERM to the server it starts."""
    open_client(f"sqlite:///{tmp_path / 'mlflow.db'}")
    command, _, page = how_to_open(f"sqlite:///{tmp_path / 'mlflow.db'}").partition("     then ")
    assert page == "http://localhost:5000"
    setting, *words = shlex.split(command)
    name, value = setting.split("=")
    port = free_port()
    program = str(Path(sys.executable).with_name(words[0]))
    started = subprocess.Popen(
        [program, *words[1:], "--port", str(port)], env={**os.environ, name: value}, stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip
    try:
        for _ in range(900):
            try:
                urllib.request.urlopen(f"http://127.0.0.1:{port}/health", timeout=1)
                break
            except OSError:
                assert started.poll() is None
                time.sleep(0.1)
        assert len(session_of(started.pid)) <= 2
        started.send_signal(signal.SIGTERM)
        started.wait(30)
        deadline = time.monotonic() + 20
        while session_of(started.pid) and time.monotonic() < deadline:
            time.sleep(0.2)
        assert not session_of(started.pid)
    finally:
        kill(started)


def session_of(leader: int) -> list[int]:
    """The processes of the session that a process began, zombies left out."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, session = stat.read_text().rpartition(") ")[2].split()[:4]
        except OSError:
            continue
        if int(session) == leader and state != "Z":
            found.append(int(stat.parent.name))
    return found
