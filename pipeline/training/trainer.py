"""The training loop: load, step, save, validate; the global batch is its unit.

Invariant: what a step computes is a function of (config, shards, weights before it) and not of the number of ranks,
up to rounding (and up to dropout's masks, which are drawn for each rank's own images). All randomness is keyed by
(seed, epoch, sample, view) for images and (seed, step, rank) for dropout, so a resumed run needs no generator state,
repeats no place and skips none.
"""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from io import FileIO
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pipeline.common.errors import DataError, Diverged, Interrupted, Preempted, UsageError
from pipeline.common.files import write_atomically
from pipeline.config import RunConfig, flatten, recorded
from pipeline.data.cliques import Mined
from pipeline.data.places import build_loader
from pipeline.data.plan import plan
from pipeline.data.positions import place_points
from pipeline.data.shard_sets import open_shards
from pipeline.distributed import agree, agreed, broadcast_tensors, on_rank_0, rank, same, world_size
from pipeline.evaluation.describe.bank import TrainingBank
from pipeline.evaluation.search.projection import check_prefix
from pipeline.model.bank import Bank, bank_beside, save_bank
from pipeline.model.cross_image import check_crossing
from pipeline.model.vpr import PlaceModel, build_model
from pipeline.model.weights.convert import write_model
from pipeline.model.weights.files import frozen_hash, load_model, load_trainable, save_model, saved_names
from pipeline.training import checkpoint
from pipeline.training.ahead import OnDevice, Ready
from pipeline.training.checkpoint import RunState
from pipeline.training.compiled import compile_backbone, uncompiled
from pipeline.training.engines.base import Engine
from pipeline.training.engines.build import build_engine, choose
from pipeline.training.initialise import initialise, random_and_frozen
from pipeline.training.launch import notice_of, stop_at, stop_signals
from pipeline.training.loss import MultiSimilarityLoss
from pipeline.training.mining import Mining
from pipeline.training.numerics import full_float32, set_numerics
from pipeline.training.records.meter import Meter
from pipeline.training.records.run_folder import working_in
from pipeline.training.records.run_log import RunLog
from pipeline.training.records.tracking import Tracker
from pipeline.training.schedule import build_optimizer, learning_rate
from pipeline.training.validation import Validation
from shards.index import ShardIndex


@dataclass(frozen=True)
class Outcome:
    """How a run ended.

    Attributes:
        run: its folder.
        state: where it stands.
        reason: "epochs", "steps", "patience" or "already finished".
        page: how a person sees its MLflow run; "" where this process did not record it.
    """

    run: Path
    state: RunState
    reason: str
    page: str = ""

    def __str__(self) -> str:
        line = f"{self.reason}: step {self.state.step}, epoch {self.state.epoch}"
        if self.state.best is not None:
            line += f", best R@5 {self.state.best:.2f} at step {self.state.best_step}"
        return line


def train(config: RunConfig, accelerator: Any, queries: int | None = None) -> Outcome:
    """Trains in the run's folder, which it holds alone and whose `status.json` it keeps. Collective.

    Args:
        config: the run.
        accelerator: from `launch.start`.
        queries: validate on the first so many of each set only (a trial); none: on all.

    Raises:
        UsageError: another training works in the folder, or it cannot be written; and as `Trainer`.
    """
    with working_in(Path(config.output) / config.name) as status:
        outcome = Trainer(config, accelerator, queries).fit()
        status.message = str(outcome)
        return outcome


class Trainer:
    """Trains one run from its config, from the start or from its last checkpoint.

    Args:
        config: the run.
        accelerator: from `launch.start`.
        queries: as for `train`.

    Raises:
        UsageError, DataError: the config does not fit the launch, the shards or the run being resumed.
    """

    def __init__(self, config: RunConfig, accelerator: Any, queries: int | None = None) -> None:
        self.config, self.accelerator = config, accelerator
        self.main = rank() == 0
        self.run = Path(config.output) / config.name
        self.tracker = Tracker(config, enabled=False)
        self.log: RunLog | None = None  # rank 0 writes it
        self.samples: FileIO | None = None
        self.stops: list[int] = []  # signals received
        self.problem: Exception | None = None  # met between two exchanges of the ranks, told in the next
        self.flagged = False  # whether any rank had something to tell in the last step

        if (numerics := set_numerics(config.train, accelerator.device)) and self.main:
            print(numerics, file=sys.stderr, flush=True)

        # what all ranks must agree on before they build anything
        self.index = agreed(lambda: open_shards(config.data), what=f"reading {config.data.shards}")
        same(settings_digest(config), "the digest of the settings")
        same(self.index.digest, f"the digest of the shards {config.data.shards}")
        self.steps_per_epoch = len(self._plan(0).batches)
        check_batch(config, self.steps_per_epoch)
        if self.main and (remark := random_and_frozen(config.model)):
            print(f"warning: {remark}", file=sys.stderr, flush=True)
        self.total_steps = self.steps_per_epoch * config.train.epochs
        if config.train.steps is not None:
            self.total_steps = min(self.total_steps, config.train.steps)

        # the model, from its config and the seed
        torch.manual_seed(config.seed)
        model = agreed(lambda: build_model(config.model, config.data.image_size), what="building the model")
        check_prefix(max(config.loss.prefixes, default=None), model.descriptor_dim, "loss.prefixes")
        self.backbone_hash = frozen_hash(model)
        same(self.backbone_hash, "the hash of the frozen weights")
        self.saved = frozenset(saved_names(model, config.model, everything=False))

        # where the run stands: its last checkpoint, or what a new model learns from images before its first step
        self.state, optimizer, origin = self._resume(model)
        if self.state.step == 0 and not optimizer:
            initialise(model, self.index, config, accelerator.device)

        # compiled, then wrapped by the engine, which takes the optimiser's tensors last
        chosen = choose(config.train.engine)
        compile_backbone(model, config, chosen, accelerator.device)
        fused = chosen == "ddp" and accelerator.device.type == "cuda"
        self.engine: Engine = build_engine(
            config.train,
            accelerator,
            model,
            lambda parameters: build_optimizer(config.train, parameters, fused),
            4 * config.data.places_per_batch // world_size(),
        )
        self.engine.load(optimizer, self.state.scaler)

        self.loss = build_loss(config, self.index).to(accelerator.device)
        self.mining: Mining | None = None
        if config.data.order == "mined":
            self.mining = agreed(lambda: Mining(config, self.index, self.run, origin))
        self.validation: Validation | None = None
        if config.validate.sets:
            self.validation = agreed(
                lambda: Validation(config, accelerator.device, queries), what="reading validate.sets"
            )
        self._compare_scores()
        self.training_bank = TrainingBank(config, self.index, accelerator.device)
        self.bank: tuple[int, Bank | None] = (-1, None)

    def fit(self) -> Outcome:
        """Trains to the end.

        Raises:
            Preempted: SIGTERM or SIGUSR1 came; the run is saved and continues with `--train.resume auto`.
            Interrupted: Ctrl-C came; the same.
            Diverged: the loss is not finite; the last good checkpoint stays.
            DataError: a shard or a validation image cannot be read, a disk is full; on all ranks, whichever met it.
        """
        if self._ended():
            return Outcome(self.run, self.state, "already finished")
        self._open()
        if self.mining is not None:
            self.mining.adopt(self.state)
            self.mining.tell()
        status = "FAILED"
        with stop_signals() as self.stops:  # until the records are closed: a launcher ends the ranks of a failed job
            try:
                if self.state.step == 0 and self.validation is not None and self.config.train.validate_first:
                    self._validate()
                while not self._ended():
                    self._epoch()
                on_rank_0(partial(self.tracker.finished, self._write_whole), what="recording the end of the run")
                status = "FINISHED"
                return Outcome(self.run, self.state, self._ended(), self.tracker.where())
            except (Preempted, Interrupted, KeyboardInterrupt):
                status = "KILLED"
                raise
            finally:
                if self.samples is not None:
                    self.samples.close()
                self.tracker.close(status)

    def _epoch(self) -> None:
        """The rest of the current epoch, then validation and a checkpoint."""
        state = self.state
        if state.step < self.total_steps:
            self._train_epoch()
        if self.validation is not None:
            self._save()  # validation can take minutes: a kill in it must not cost the epoch
            self._validate()
        else:
            with self._whole():  # for the bank
                pass
        if state.cursor >= self.steps_per_epoch:  # only now: until it is validated, an epoch is not over
            state.epoch, state.cursor = state.epoch + 1, 0
        self._save()
        asked = self._exchange(self.problem)
        if asked and not self._ended():
            raise stop_at(asked, f"step {state.step}")

    def _train_epoch(self) -> None:
        """The steps that are left of the current epoch."""
        state, config = self.state, self.config
        loader = build_loader(
            self.index, config.data, config.seed, state.epoch, state.cursor, rank(), world_size(), self._mined(),
            stop=lambda: bool(self.stops),
        )  # fmt: skip
        if loader.plan.in_cliques and self.main:
            share = 100 * loader.plan.in_cliques / loader.plan.batches.size
            told = f"epoch {state.epoch + 1}: {share:.0f} % of the places are in mined groups"
            print(told, file=sys.stderr, flush=True)
        self.engine.model.train()
        meter = Meter(config.data.places_per_batch * 4, self.total_steps, state, enabled=self.main)
        with meter:
            for batch in self._agreed_batches(OnDevice(meter.wait(loader), self.accelerator.device)):
                self._step(batch, meter)
                last = state.step >= self.total_steps or state.cursor >= self.steps_per_epoch
                if state.step % config.train.save_every == 0 and not last:
                    self._save()

    def _mined(self) -> Mined | None:
        """What a mined epoch is planned from; made now, by the model as it is, where it is due."""
        if self.mining is None:
            return None
        if self.mining.due(self.state):
            with self._whole() as model:
                self.mining.make(self.state, model, self.accelerator, self._stop_unsaved)
        return self.mining.mined(self.state)

    def _stop_unsaved(self) -> None:
        """Leaves where nothing has happened since the last checkpoint."""
        if asked := self._exchange(self.problem):
            raise stop_at(asked, f"step {self.state.step}")

    def _agreed_batches(self, batches: OnDevice) -> Iterator[Ready]:
        """This rank's batches. What keeps a rank from the next step (a batch that cannot be read, a sample log that
        cannot be written, a signal: saved, and raised) the ranks tell each other with the loss of the step before,
        for which every rank has its batch already. Before the first step and after the last they ask each other."""
        coming = self._fetch(batches)
        self._heed()
        while coming is not None:
            now = coming()
            # one ahead, but no further than the run goes
            coming = self._fetch(batches) if self.state.step + 1 < self.total_steps else None
            yield now
            if self.flagged or coming is None:
                self._heed()

    def _fetch(self, batches: OnDevice) -> Callable[[], Ready] | None:
        try:
            return batches.fetch()
        except Exception as error:
            self.problem = self.problem or error
            return None

    def _heed(self) -> None:
        """Raises what any rank has to tell; a signal once the state, that of a finished step, is saved."""
        if asked := self._exchange(self.problem):
            self._save()
            raise stop_at(asked, f"step {self.state.step}")

    def _exchange(self, problem: Exception | None) -> int:
        """The signal that any rank received, or 0; raises the problem of any rank on all."""
        return agree(problem, notice_of(self.stops), what=f"step {self.state.step + 1} of {self.run}")

    def _step(self, batch: Ready, meter: Meter) -> None:
        """One step. What it tells is read once, when backward and update are on their way: a GPU never waits for the
        host to read. So a loss that is not finite is seen after its update, which is never saved."""
        state, config = self.state, self.config
        torch.manual_seed(step_seed(config.seed, state.step, rank()))
        with self.accelerator.autocast():
            descriptors = self.engine(
                batch.images, chunk=config.train.encode_chunk, joint=config.train.passes == "joint"
            )
        loss = self.loss(descriptors, batch.labels, flag=self.problem is not None or bool(self.stops))
        rate = learning_rate(config.train, state.step, self.steps_per_epoch, self.total_steps)
        self.engine.step(loss, rate)
        told = self.loss.summary()  # of the global batch, the same on every rank
        if not math.isfinite(told.loss):
            raise Diverged(
                f"the loss is {told.loss} at step {state.step} (epoch {state.epoch}); the last good checkpoint of "
                f"{self.run} stays; try a smaller --train.lr, --train.max_grad_norm 1.0 or --train.warmup_steps 500"
            )
        state.step += 1
        state.cursor += 1
        self.flagged = told.flagged > 0
        self._log_samples(batch.keys)
        mined = told.mined
        meter.record(told.loss, mined.by_pass, mined.negatives, batch.copy_wait())
        if state.step % config.train.log_every == 0 or state.step == self.total_steps:
            report = meter.report()
            self._record(
                {
                    "train/loss": report.loss,
                    **mined_metrics(report.mined),
                    "train/mined_positives": mined.positives,
                    "train/mined_negatives": report.negatives,
                    "train/images_per_second": report.images_per_second,
                    "train/data_wait": report.data_wait,
                    "train/copy_wait": report.copy_wait,
                    "train/lr": rate,
                    "train/epoch": state.epoch + state.cursor / self.steps_per_epoch,
                },
                state.step,
            )

    def _compare_scores(self) -> None:
        """Forgets the best score where it is of another validation set or protocol than the scores to come."""
        if self.validation is None:
            return
        state, now = self.state, on_rank_0(self.validation.identity, what="the validation set")
        if state.validation not in ("", now):
            if self.main and state.best is not None:
                print(
                    f"validation has another set or protocol than before: the best score so far ({state.best:.1f}) is "
                    "not compared, the best checkpoint is chosen anew",
                    file=sys.stderr,
                    flush=True,
                )
            state.best, state.best_step, state.stale = None, None, 0
            state.validated, state.validated_step, state.start = {}, None, {}
        state.validation = now

    def _validate(self) -> None:
        """Recall of the model as it is; keeps the best, counts the epochs without a better one."""
        assert self.validation is not None
        with self._whole() as model:
            values, score = self.validation.run(model, self.main)
        self.state.validated, self.state.validated_step = values, self.state.step
        self._record(values, self.state.step)
        if self.state.step == 0:
            self.state.start = values
            return
        if self.state.best is None or score > self.state.best:
            self.state.best, self.state.best_step, self.state.stale = score, self.state.step, 0
        else:
            self.state.stale += 1

    @contextmanager
    def _whole(self) -> Iterator[PlaceModel]:
        """The model as it is, whole and in evaluation mode, with a bank of its own, which the next save writes."""
        with self.engine.plain() as model, uncompiled(self.config.train.compile), full_float32():
            model.bank = self.training_bank.encode(model)
            self.bank = (self.state.step, model.bank)
            yield model

    def _record(self, values: dict[str, float], step: int) -> None:
        """Metrics of a step, in MLflow and in `train.log`; on rank 0."""
        self.tracker.metrics(values, step)
        if self.log is not None:
            self.log.write(values, step)

    def _save(self) -> None:
        """One checkpoint (collective): whole tensors are gathered on rank 0, which writes."""
        self.state.world_size = world_size()
        self.state.scaler = self.engine.scaler()
        tensors, optimizer = self.engine.state(self.saved)
        on_rank_0(partial(self._write, tensors, optimizer), what=f"writing a checkpoint under {self.run}")

    def _write(self, tensors: dict[str, Tensor], optimizer: dict[str, Tensor]) -> None:
        state, config = self.state, self.config
        for name, tensor in tensors.items():
            if tensor.is_floating_point() and not torch.isfinite(tensor).all():
                raise Diverged(
                    f"{name} is not finite at step {state.step}; the last good checkpoint of {self.run} stays"
                )

        def weights(path: Path) -> None:
            save_model(
                self.engine.model, path, config.model, config.data.image_size, everything=False,
                extra={"run": config.name, "step": state.step, "mlflow_run_id": state.run_id},
                state=tensors, backbone_hash=self.backbone_hash,
            )  # fmt: skip
            step, bank = self.bank
            if bank is not None and step == state.step:
                save_bank(bank, bank_beside(path))

        path = checkpoint.write(self.run, state, config, weights, optimizer)
        best = state.best_step == state.step
        if best or self.validation is None:
            checkpoint.point(self.run, "best", path)
        if best or (self.validation is None and self._ended()):  # others are replaced by the next
            self.tracker.checkpoint(path.resolve(), state.step, state.validated)
        checkpoint.prune(self.run, config.train.keep)

    def _resume(self, model: PlaceModel) -> tuple[RunState, dict[str, Tensor], Path]:
        """Where to continue, with the optimiser's tensors and the folder of the run that it comes from, the weights put
        into the model; or a new run's state.

        Rank 0 alone looks, reads and decides, and sends what it read: the others need not see the run's folder.
        """
        moments: dict[str, Tensor] = {}

        def read() -> tuple[RunState | None, Path]:
            path = checkpoint.find(self.run, self.config.train.resume)
            if path is None:
                return None, self.run
            print(f"continuing from {path}", file=sys.stderr, flush=True)
            state, config, optimizer = checkpoint.read(path)
            checkpoint.check_same(config, self.config, state, self.index.digest)
            load_trainable(model, path)
            moments.update(optimizer)
            if path.parent.parent != self.run.resolve():
                state.run_id = ""  # branched off another run: a run of its own in MLflow
            return state, path.parent.parent

        state, origin = on_rank_0(read, what=f"looking for a checkpoint of {self.run}")
        if state is None:
            return RunState(index=self.index.digest), {}, origin
        tensors = model.state_dict()
        with torch.no_grad():
            for name, value in broadcast_tensors({name: tensors[name] for name in sorted(self.saved)}).items():
                tensors[name].copy_(value)
        return state, broadcast_tensors(moments), origin

    def _write_whole(self, folder: Path) -> None:
        """The best checkpoint's model, complete, as `folder`/model.safetensors."""
        best = self.run / "checkpoints" / "best"
        write_model(load_model(best), folder / "model.safetensors", str(self.run))

    def _open(self) -> None:
        """The run's folder, its MLflow run and the sample log."""
        config = self.config
        note = self.run / "mlflow_run_id"

        def begin() -> None:
            self.run.mkdir(parents=True, exist_ok=True)
            for log in self.run.glob("samples.rank*.jsonl"):  # also those of a former, larger number of ranks
                self._forget_samples(log)
            write_atomically(self.run / "config.json", json.dumps(recorded(config), indent=1) + "\n")
            # a run killed before its first checkpoint left its id here
            known = self.state.run_id or (note.read_text().strip() if note.exists() else "")
            self.tracker = Tracker(config, known, config.tracking.enabled)
            self.state.run_id = self.tracker.run_id
            note.write_text(self.tracker.run_id)
            self.log = RunLog(self.run, self.state.step)
            if where := self.tracker.where():
                print(f"recorded in MLflow: {where}", file=sys.stderr, flush=True)

        def open_log() -> None:
            log = self.run / f"samples.rank{rank()}.jsonl"
            log.parent.mkdir(parents=True, exist_ok=True)  # a disk of this machine alone
            self._forget_samples(log)
            self.samples = log.open("ab", buffering=0)

        on_rank_0(begin, what=f"opening the run's folder {self.run}")
        if config.train.log_samples:
            agreed(open_log, what=f"opening the sample log in {self.run}")

    def _forget_samples(self, log: Path) -> None:
        """Drops what a log says of steps that a kill lost after the checkpoint: they are about to be taken again."""
        if not log.exists():
            return
        before = log.read_text()
        whole = [line for line in before.splitlines() if line.endswith("}")]
        kept = "".join(line + "\n" for line in whole if json.loads(line)["step"] <= self.state.step)
        if kept != before:
            write_atomically(log, kept)

    def _log_samples(self, keys: list[str]) -> None:
        """One line a step; what goes wrong is told in the ranks' next exchange, since the others are in their step."""
        if self.samples is None or self.problem is not None:
            return
        told = {"step": self.state.step, "epoch": self.state.epoch, "samples": keys}
        line = (json.dumps(told) + "\n").encode()
        try:
            if self.samples.write(line) != len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            self.problem = DataError(f"{self.samples.name}: {error.strerror}")

    def _ended(self) -> str:
        """Why the run is over, or ""."""
        state, train = self.state, self.config.train
        validated = self.validation is None or state.validated_step == state.step
        if state.step >= self.total_steps and validated:
            return "steps" if train.steps is not None and state.step >= train.steps else "epochs"
        if train.patience and state.stale >= train.patience:
            return "patience"
        return ""

    def _plan(self, epoch: int) -> Any:
        data = self.config.data
        return plan(self.index, self.config.seed, epoch, data.places_per_batch, data.order, data.window_shards)


# where a machine has its files and its record: each may have places of its own
PLACES = ("output", "data.shards", "data.cache", "model.backbone.weights", "validate.root", "tracking.uri")


def settings_digest(config: RunConfig) -> str:
    """Sixteen hex digits of all settings but `PLACES`."""
    settings = {name: value for name, value in flatten(config).items() if name not in PLACES}
    return hashlib.sha256(json.dumps(settings, sort_keys=True, default=str).encode()).hexdigest()[:16]


def step_seed(seed: int, step: int, r: int) -> int:
    """Seed of a step's dropout on a rank; distinct over (seed, step, rank) below 2^20 steps and 2^12 ranks a seed."""
    return ((seed << 32) + (step << 12) + r) % (1 << 63)


def build_loss(config: RunConfig, index: ShardIndex) -> MultiSimilarityLoss:
    """The loss of a run, with the places' positions where it needs them; says once how many are unknown.

    Raises:
        DataError: `loss.ignore_within` on shards without positions.
    """
    loss, points = config.loss, None
    if loss.ignore_within:
        found, unknown = place_points(index, f"loss.ignore_within={loss.ignore_within:g}")
        points = torch.from_numpy(found)
        if unknown and rank() == 0:
            print(
                f"loss.ignore_within: {unknown:,} of {len(found):,} places have no position; no pair of theirs is "
                "ignored", file=sys.stderr, flush=True,
            )  # fmt: skip
    return MultiSimilarityLoss(loss.alpha, loss.beta, loss.base, loss.margin, loss.ignore_within, points, loss.prefixes)


def mined_metrics(mined: tuple[float, ...]) -> dict[str, float]:
    """Percent of anchors with a mined pair, over all; of joint training also for each kind of description."""
    named = {"train/mined_anchors": sum(mined) / len(mined)}
    if len(mined) == 2:
        named["train/mined_anchors_group"], named["train/mined_anchors_alone"] = mined
    return named


def check_batch(config: RunConfig, steps_per_epoch: int) -> None:
    """Refuses a global batch that cannot be cut equally or never fills, and passes that the model cannot give, and a
    registration without a record.

    Raises:
        UsageError: with the numbers.
    """
    places, w = config.data.places_per_batch, world_size()
    if config.train.passes == "joint":
        check_crossing(config.model.cross_image, "train.passes joint")
    if config.tracking.register is not None and not config.tracking.enabled:
        raise UsageError("tracking.register: a model is registered in MLflow, but tracking.enabled is false")
    if config.validate.sets and "bank" in config.validate.groups:
        check_crossing(config.model.cross_image, "validate.groups bank")
    if places % w:
        raise UsageError(
            f"data.places_per_batch {places} cannot be cut equally over {w} processes; use a multiple of {w}"
        )
    if steps_per_epoch == 0:
        raise UsageError(f"the shards hold fewer than data.places_per_batch = {places} places; make the batch smaller")
