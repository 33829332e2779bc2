"""Runs in MLflow: parameters, metrics by step, artifacts, checkpoints; a local SQLite store unless told otherwise.

Invariant: only rank 0 records, a run that is resumed continues its MLflow run, and a metric's name carries the
protocol it was measured under (`validation/city.shuffled16.recall_at_1`; MLflow allows no `@` and groups its charts by
what stands before the slash). Recording never changes what is
computed; a store that cannot be reached is an error at the start, not a surprise at the end.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit, urlunsplit

from pipeline.common.errors import UsageError
from pipeline.config import RunConfig, flatten, to_dict


def store_uri(uri: str | None, output: str) -> str:
    """The tracking store: the setting, else MLFLOW_TRACKING_URI, else `<output>/mlflow.db`."""
    return uri or os.environ.get("MLFLOW_TRACKING_URI") or f"sqlite:///{Path(output).resolve() / 'mlflow.db'}"


def open_client(uri: str) -> Any:
    """A client of the store.

    Raises:
        UsageError: it cannot be reached or is not a store.
    """
    import logging

    for noisy in ("alembic", "mlflow.store.db.utils", "mlflow.tracking"):
        logging.getLogger(noisy).setLevel(logging.WARNING)
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "3")
    from mlflow import MlflowClient
    from mlflow.exceptions import MlflowException

    if uri.startswith("sqlite:///"):
        Path(uri.removeprefix("sqlite:///")).parent.mkdir(parents=True, exist_ok=True)
    try:
        client = MlflowClient(tracking_uri=uri)
        client.search_experiments(max_results=1)
        return client
    except (MlflowException, OSError) as error:
        raise UsageError(f"the MLflow store {uri} cannot be used: {str(error).splitlines()[0]}") from error


def how_to_open(uri: str, experiment: str = "", run: str = "") -> str:
    """How a person sees the records: the address of a server, or the command that serves a local store and then that.

    MLflow's job execution would start seven helper processes, which outlive a SIGTERM; nothing here needs them.
    """
    page = f"/#/experiments/{experiment}" + (f"/runs/{run}" if run else "") if experiment else ""
    if uri.startswith("http"):
        at = urlsplit(uri)  # without a name and password that may stand in it
        return urlunsplit((at.scheme, at.netloc.rpartition("@")[2], at.path.rstrip("/"), "", "")) + page
    command = f"MLFLOW_SERVER_ENABLE_JOB_EXECUTION=false mlflow ui --workers 1 --backend-store-uri {uri}"
    return f"{command}     then http://localhost:5000{page}"


def code_commit() -> str:
    """The commit of this code, with "-dirty" where files differ from it; "" outside a git checkout."""
    here = Path(__file__).parent
    try:
        commit = subprocess.run(
            ["git", "-C", str(here), "describe", "--always", "--abbrev=40", "--dirty", "--exclude=*"],
            capture_output=True, text=True, timeout=10, check=True,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return ""
    return commit.stdout.strip()


def experiment_id(client: Any, uri: str, name: str, output: str) -> str:
    """The experiment's id; it is created where it is missing, its artifacts beside a local store."""
    found = client.get_experiment_by_name(name)
    if found is not None and found.lifecycle_stage == "deleted":
        raise UsageError(
            f"the MLflow experiment {name} in {uri} was deleted: bring it back (mlflow experiments restore -x "
            f"{found.experiment_id}), or choose another --tracking.experiment"
        )
    if found is not None:
        return str(found.experiment_id)
    local = uri.startswith("sqlite:")
    location = (Path(output).resolve() / "mlartifacts" / name).as_uri() if local else None
    return str(client.create_experiment(name, artifact_location=location))


class Tracker:
    """Records one training run.

    Args:
        config: of the run.
        run_id: the MLflow run to continue, or "" for a new one.
        enabled: False (other ranks, tracking.enabled false) records nothing.
    """

    def __init__(self, config: RunConfig, run_id: str = "", enabled: bool = True) -> None:
        self.config, self.run_id = config, run_id
        self._client: Any = None
        self._pending: list[Any] = []
        if not enabled:
            return
        from mlflow.exceptions import MlflowException

        self.uri = store_uri(config.tracking.uri, config.output)
        self._client = open_client(self.uri)
        try:
            self._experiment = experiment_id(self._client, self.uri, config.tracking.experiment, config.output)
            if not self._continues(run_id):
                self._begin()
        except MlflowException as error:
            raise UsageError(f"the MLflow store {self.uri} cannot be used: {str(error).splitlines()[0]}") from error

    def _continues(self, run_id: str) -> bool:
        """Whether the run goes on in its MLflow run; a record deleted by another tool does not stop a training."""
        from mlflow.exceptions import MlflowException

        if not run_id:
            return False
        try:
            found = self._client.get_run(run_id)
            reason = "was deleted" if found.info.lifecycle_stage == "deleted" else ""
            if not reason:
                self._client.update_run(run_id, status="RUNNING")
        except MlflowException as error:
            if error.error_code != "RESOURCE_DOES_NOT_EXIST":
                raise
            reason = "is no longer there"
        if reason:
            print(
                f"warning: the MLflow run {run_id} {reason}; the training is recorded in a new one from here on",
                file=sys.stderr, flush=True,
            )  # fmt: skip
        return not reason

    def _begin(self) -> None:
        from mlflow.entities import Param

        run = self._client.create_run(self._experiment, run_name=self.config.name, tags=self._tags())
        self.run_id = run.info.run_id
        values = [Param(key, str(value)) for key, value in flatten(self.config).items()]
        for first in range(0, len(values), 100):  # MLflow takes at most 100 a call
            self._client.log_batch(self.run_id, params=values[first : first + 100])
        self._client.log_dict(self.run_id, to_dict(self.config), "config.yaml")
        self._client.log_dict(self.run_id, environment(), "environment.yaml")

    def _tags(self) -> dict[str, str]:
        """What the MLflow page shows of a run beside its numbers: a description, and the code's commit."""
        config, folder = self.config, self._folder()
        shards = config.data.shards if isinstance(config.data.shards, str) else ", ".join(config.data.shards)
        about = (
            f"**{config.name}**: {config.model.backbone.name}, trained on {shards}, {config.data.places_per_batch} "
            f"places in a batch, order {config.data.order}.\n\nAgain: `python -m jobs.train --config "
            f"{folder / 'config.json'} --name NEW_NAME`"
        )
        commit = code_commit()
        tags = {"run_folder": str(folder), "kind": "training", "mlflow.note.content": about}
        return tags | ({"mlflow.source.git.commit": commit} if commit else {})

    def where(self) -> str:
        """How a person sees this run; "" where it is not recorded."""
        return "" if self._client is None else how_to_open(self.uri, self._experiment, self.run_id)

    def _folder(self) -> Path:
        return Path(self.config.output) / self.config.name

    def metrics(self, values: dict[str, float], step: int) -> None:
        """Records metrics at a step, in the background."""
        if self._client is None:
            return
        with self._recording(f"metrics of step {step}"):
            from mlflow.entities import Metric

            now = int(time.time() * 1000)
            entries = [Metric(name, float(value), now, step) for name, value in values.items()]
            self._pending.append(self._client.log_batch(self.run_id, metrics=entries, synchronous=False))

    def checkpoint(self, path: Path, step: int, values: dict[str, float]) -> None:
        """Registers a checkpoint folder as a logged model of the run, ranked by its validation figures."""
        if self._client is None:
            return
        with self._recording(f"checkpoint of step {step}"):
            from mlflow.entities import LoggedModelStatus, Metric

            model = self._client.create_logged_model(
                self._experiment,
                name=f"{self.config.name}-step-{step}",
                source_run_id=self.run_id,
                tags={"checkpoint": str(path), "step": str(step)},
                model_type="checkpoint",
            )
            now = int(time.time() * 1000)
            entries = [Metric(k, float(v), now, step, model_id=model.model_id) for k, v in values.items()]
            if entries:
                self._client.log_batch(self.run_id, metrics=entries)
            self._client.finalize_logged_model(model.model_id, LoggedModelStatus.READY)
            self._client.set_tag(self.run_id, "checkpoint", str(path))

    def close(self, status: str) -> None:
        """Waits for what is still being written and ends the run: FINISHED, FAILED or KILLED (to be continued)."""
        if self._client is None:
            return
        with self._recording("the end of the run"):
            for record in self._pending:  # (MLflow's own flush opens a default store in the working directory)
                record.wait()
            self._client.set_terminated(self.run_id, status=status)

    @contextmanager
    def _recording(self, what: str) -> Iterator[None]:
        """A store that fails in mid-run costs a warning, never the training."""
        from mlflow.exceptions import MlflowException

        try:
            yield
        except (MlflowException, OSError) as error:
            reason = str(error).splitlines()[0]
            print(f"warning: MLflow did not record {what}: {reason}", file=sys.stderr, flush=True)


def record_evaluation(run: Path, written: dict[str, Any], values: dict[str, float], folder: Path) -> bool:
    """Records an evaluation in the MLflow run that trained the checkpoint; False where that run was not recorded.

    Args:
        run: the run's folder (its config says which store).
        written: what the checkpoint says of itself ("mlflow_run_id", "step").
        values: recalls by metric name, without the kind: recorded as `evaluation/<name>`.
        folder: results.json, report.html and figures, stored as artifacts.
    """
    config = run / "config.json"
    if not written.get("mlflow_run_id") or not config.exists():
        return False
    told = json.loads(config.read_text())
    uri = store_uri(told["tracking"]["uri"], str(run.parent))
    client = open_client(uri)
    from mlflow.entities import Metric
    from mlflow.exceptions import MlflowException

    now = int(time.time() * 1000)
    entries = [Metric(f"evaluation/{k}", float(v), now, int(written["step"])) for k, v in values.items()]
    try:
        client.log_batch(written["mlflow_run_id"], metrics=entries)
        for name in ("results.json", "results.md", "report.html"):
            if (folder / name).exists():
                client.log_artifact(written["mlflow_run_id"], str(folder / name), "evaluation")
    except MlflowException as error:
        raise UsageError(f"MLflow at {uri} did not take the evaluation: {str(error).splitlines()[0]}") from error
    return True


def environment() -> dict[str, Any]:
    """Python, platform and the versions that matter for a result."""
    wanted = (
        "torch",
        "accelerate",
        "transformers",
        "deepspeed",
        "webdataset",
        "pyarrow",
        "faiss-cpu",
        "numpy",
        "pillow",
    )
    installed = {d.metadata["Name"].lower(): d.version for d in metadata.distributions() if d.metadata["Name"]}
    return {
        "python": sys.version.split()[0],
        "platform": platform.platform(),
        "packages": {name: installed[name] for name in wanted if name in installed},
    }
