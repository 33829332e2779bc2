"""The tracker against a real MLflow server: a run recorded over HTTP, and a server that dies in mid-run."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from processes import free_port

from pipeline.common.errors import UsageError
from pipeline.config import RunConfig, TrackingConfig
from pipeline.training.records.tracking import Tracker, open_client

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
