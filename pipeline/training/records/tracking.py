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
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote, urlsplit, urlunsplit

from pipeline.common.errors import UsageError
from pipeline.common.text import without_passwords
from pipeline.config import RunConfig, flatten, recorded
from pipeline.evaluation.protocol import read_metric_name


def store_uri(uri: str | None, output: str) -> str:
    """The tracking store: the setting, else MLFLOW_TRACKING_URI, else `<output>/mlflow.db`.

    A server's user and password are taken out of it and go where MLflow looks for them, into
    MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD of this process, so that no error or record can hold them.
    """
    known = os.environ.get("MLFLOW_TRACKING_URI")
    if known and uri == without_passwords(known):  # a record of `known`
        uri = known
    found = uri or known or f"sqlite:///{Path(output).resolve() / 'mlflow.db'}"
    at = urlsplit(found)
    if at.scheme in ("http", "https") and at.username:
        os.environ["MLFLOW_TRACKING_USERNAME"] = unquote(at.username)
        os.environ["MLFLOW_TRACKING_PASSWORD"] = unquote(at.password or "")
        found = urlunsplit(at._replace(netloc=at.netloc.rpartition("@")[2]))
    return found


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


def how_to_open(uri: str, experiment: str = "", *runs: str) -> str:
    """How a person sees the records: the address of a server, or the command that serves a local store and then that.

    The page is that of a run, of several beside each other, of an experiment, or MLflow's first.

    MLflow's job execution would start seven helper processes, which outlive a SIGTERM; nothing here needs them.
    """
    page = f"/#/experiments/{experiment}" if experiment else ""
    if len(runs) == 1:
        page += f"/runs/{runs[0]}"
    elif runs:
        page = f"/#/compare-runs?runs={quote(json.dumps(runs))}&experiments={quote(json.dumps([experiment]))}"
    if uri.startswith("http"):
        at = urlsplit(uri)  # without a name and password that may stand in it
        return urlunsplit((at.scheme, at.netloc.rpartition("@")[2], at.path.rstrip("/"), "", "")) + page
    command = "MLFLOW_SERVER_ENABLE_JOB_EXECUTION=false mlflow ui --workers 1 --backend-store-uri "
    return f"{command}{shlex.quote(without_passwords(uri))}     then http://localhost:5000{page}"


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
        self._model = ""  # MLflow's id of the best checkpoint's
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
        self._client.log_dict(self.run_id, recorded(self.config), "config.yaml")
        self._client.log_dict(self.run_id, environment(), "environment.yaml")

    def _tags(self) -> dict[str, str]:
        """What the MLflow page shows of a run beside its numbers: a description, and the code's commit."""
        commit = code_commit()
        tags = {"run_folder": str(self._folder()), "kind": "training", DESCRIPTION: describe(self.config)}
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
        with _recording(f"metrics of step {step}"):
            from mlflow.entities import Metric

            now = int(time.time() * 1000)
            entries = [Metric(name, float(value), now, step) for name, value in values.items()]
            self._pending.append(self._client.log_batch(self.run_id, metrics=entries, synchronous=False))

    def checkpoint(self, path: Path, step: int, values: dict[str, float]) -> None:
        """Registers a checkpoint folder as a logged model of the run, ranked by its validation figures."""
        if self._client is None:
            return
        with _recording(f"checkpoint of step {step}"):
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
                told = describe(self.config, best_line(values, step))
                self._client.set_tag(self.run_id, DESCRIPTION, told)
            self._client.finalize_logged_model(model.model_id, LoggedModelStatus.READY)
            self._client.set_tag(self.run_id, "checkpoint", str(path))
            self._model = model.model_id

    def finished(self, whole: Callable[[Path], None] | None = None) -> None:
        """What a run that came to its end leaves: its log and, where `tracking.register` names one, a model's version.

        Args:
            whole: writes the best checkpoint's model, complete, into a folder.
        """
        if self._client is None:
            return
        with _recording("the log of the run"):
            add_artifacts(self._client, self.run_id, [self._folder() / "train.log"], "training")
        name = self.config.tracking.register
        if name is None or whole is None:
            return
        with _recording(f"the model {name}"), tempfile.TemporaryDirectory() as folder:
            whole(Path(folder))
            self._register(name, Path(folder))

    def _register(self, name: str, folder: Path) -> None:
        """A new version of the registered model, made of the best checkpoint's logged model and the files in `folder`.

        The version has the run's description; its files are downloaded by `mlflow artifacts download`.
        """
        from mlflow.exceptions import MlflowException

        if not self._model:  # of a run that continued after its best step
            found = self._client.search_logged_models(
                [self._experiment], filter_string=f"source_run_id = '{self.run_id}'",
                order_by=[{"field_name": "creation_timestamp", "ascending": False}], max_results=1,
            )  # fmt: skip
            if not found:
                raise MlflowException(f"run {self.run_id} has no logged model")
            self._model = found[0].model_id
        model = self._client.get_logged_model(self._model)
        self._client.log_model_artifacts(self._model, str(folder))
        try:
            self._client.create_registered_model(name)
        except MlflowException as error:
            if error.error_code != "RESOURCE_ALREADY_EXISTS":
                raise
        run = self._client.get_run(self.run_id)
        version = self._client.create_model_version(
            name, model.artifact_location, run_id=self.run_id, model_id=self._model,
            description=run.data.tags.get(DESCRIPTION), tags={"step": model.tags.get("step", "")},
        )  # fmt: skip
        print(f"registered in MLflow: {name}, version {version.version}", file=sys.stderr, flush=True)

    def close(self, status: str) -> None:
        """Waits for what is still being written and ends the run: FINISHED, FAILED or KILLED (to be continued)."""
        if self._client is None:
            return
        with _recording("the end of the run"):
            for record in self._pending:  # (MLflow's own flush opens a default store in the working directory)
                record.wait()
            self._client.set_terminated(self.run_id, status=status)


@contextmanager
def _recording(what: str, *also: type[Exception]) -> Iterator[None]:
    """A store that fails in mid-run (or with `also`) costs a warning, never the training."""
    from mlflow.exceptions import MlflowException

    tolerated: tuple[type[Exception], ...] = (MlflowException, OSError, *also)
    try:
        yield
    except tolerated as error:
        reason = without_passwords(str(error).splitlines()[0])
        print(f"warning: MLflow did not record {what}: {reason}", file=sys.stderr, flush=True)


DESCRIPTION = "mlflow.note.content"  # the tag that MLflow's page shows as a run's description, in markdown


def describe(config: RunConfig, best: str = "none yet") -> str:
    """A run in markdown: what, on what, its best recall, and the command that repeats it."""
    shards = config.data.shards if isinstance(config.data.shards, str) else ", ".join(config.data.shards)
    folder = Path(config.output) / config.name
    rows = {
        "model": f"{config.model.backbone.name}, {config.data.image_size} px",
        "trained on": f"{without_passwords(shards)}, {config.data.places_per_batch} places in a batch, order "
        f"{config.data.order}, {config.train.passes} descriptions",
        "best recall": best,
        "again": f"`python -m jobs.train --config {folder / 'config.json'} --name NEW_NAME`",
    }
    return f"**{config.name}**\n\n| | |\n|---|---|\n" + "\n".join(f"| {k} | {v} |" for k, v in rows.items())


def best_line(values: dict[str, float], step: int) -> str:
    """The recalls at 1 and 5 of the first set and protocol among metrics, and their step."""
    read = [(name, value) for metric, value in values.items() if (name := read_metric_name(metric)) is not None]
    told = [f"R@{name[3]} {value:.1f}" for name, value in read if name[1:3] == read[0][0][1:3] and name[3] in (1, 5)]
    return f"{', '.join(told)} on {read[0][0][1]} ({read[0][0][2]}), step {step}" if read else "none"


def add_artifacts(client: Any, run_id: str, files: Iterable[Path], folder: str) -> None:
    """Those of the files that are there, in a folder of the run's artifacts."""
    for file in files:
        if file.is_file():
            client.log_artifact(run_id, str(file), folder)


def record_curves(run: Path, picture: Path) -> None:
    """Adds a training's curves to its MLflow run; a store that fails costs a warning."""
    told, run_id = json.loads((run / "config.json").read_text()), (run / "mlflow_run_id").read_text().strip()
    if not run_id:
        return
    with _recording(str(picture), UsageError):
        client = open_client(store_uri(told["tracking"]["uri"], str(run.parent)))
        add_artifacts(client, run_id, [picture], "training")


def record_evaluation(run: Path, written: dict[str, Any], values: dict[str, float], folder: Path) -> bool:
    """Records an evaluation in the MLflow run that trained the checkpoint; False where that run was not recorded.

    Args:
        run: the run's folder (its config says which store).
        written: what the checkpoint says of itself ("mlflow_run_id", "step").
        values: recalls by metric name, without the kind: recorded as `evaluation/<name>`.
        folder: results.json, report.html and the recall curves in its figures/, stored as artifacts.

    All evaluations are recorded at step 0, whatever the checkpoint's step: MLflow then shows them as bars that stand
    beside each other, and not as lone points of curves. The tag `evaluated_step` tells the checkpoint's.
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
    entries = [Metric(f"evaluation/{k}", float(v), now, 0) for k, v in values.items()]
    try:
        client.log_batch(written["mlflow_run_id"], metrics=entries)
        client.set_tag(written["mlflow_run_id"], "evaluated_step", str(written["step"]))
        files = [folder / name for name in ("results.json", "results.md", "report.html")]
        curves = sorted((folder / "figures").glob("*.curves.png"))
        add_artifacts(client, written["mlflow_run_id"], [*files, *curves], "evaluation")
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
