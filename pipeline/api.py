"""The library from Python, for notebooks and other programs: `import pipeline`, then these names (docs/python.md).

    model = pipeline.load_model("outputs/cricavpr")
    descriptors = model.describe(["first.jpg", "second.jpg"])
    results = pipeline.evaluate(model, "gardens_point", root="data")
    outcome = pipeline.train(pipeline.RunConfig.from_yaml("jobs/configs/cricavpr.yaml"))

Invariant: nothing here computes anything of its own; a number from Python is the number that the job would give.
`pipeline/__init__.py` imports this file only when one of its names is used.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch

from pipeline.common.errors import UsageError
from pipeline.config import EvaluationConfig, RunConfig
from pipeline.evaluation import evaluate as evaluation
from pipeline.evaluation.describe.bank import chosen_bank
from pipeline.evaluation.describe.encode import evaluating
from pipeline.evaluation.describe.sides import Engine
from pipeline.evaluation.evaluate import Result
from pipeline.evaluation.protocol import Side, protocols
from pipeline.evaluation.sets.evaluation_set import EvaluationSet, list_images
from pipeline.evaluation.sets.load import load_set
from pipeline.model.vpr import PlaceModel
from pipeline.model.weights.convert import read_whole

if TYPE_CHECKING:
    from pipeline.training.trainer import Outcome

Groups = Literal["single", "shuffled", "ordered", "bank"]


@dataclass(frozen=True)
class Model:
    """A model that is ready to describe photos.

    Attributes:
        module: the network, in eval mode; `module(images [n, 3, H, W])` describes one group of the cross-image encoder.
        device: where it is.
    """

    module: PlaceModel
    device: torch.device

    @property
    def descriptor_dim(self) -> int:
        """Numbers of a descriptor."""
        return self.module.descriptor_dim

    def describe(
        self,
        photos: str | Path | Sequence[str | Path],
        groups: Groups | None = None,
        config: EvaluationConfig | None = None,
        side: Side = "database",
    ) -> np.ndarray:
        """Descriptors of photos, in the order given, as an evaluation computes them.

        Args:
            photos: paths; or a folder, whose photos are taken in the order of their names.
            groups: which photos share the cross-image encoder: each alone, seeded random groups, neighbours, or each
                beside a bank; none: beside the bank that training saved with the model, alone where there is none.
            config: gives bank, bank_from, group_size, group_seed, resize, precision, batch and workers; none: the
                defaults.
            side: of an evaluation set; it changes only the draw of `shuffled` groups.

        Returns:
            float32 [n, descriptor_dim], rows of length 1.

        Raises:
            UsageError: no photos; DataError: photos that cannot be read, named.
        """
        paths = list_images(Path(photos)) if isinstance(photos, (str, Path)) else [Path(path) for path in photos]
        if not paths:
            raise UsageError("describe: no photos were given")
        groups = groups or ("single" if self.module.bank is None else "bank")
        wanted = dataclasses.replace(config or EvaluationConfig(), groups=(groups,), store="none", pca=None)
        nothing: list[np.ndarray] = [np.zeros(0, np.int64)] * len(paths)
        described = EvaluationSet("photos", paths, paths, nothing, "")
        found = np.empty((len(paths), self.descriptor_dim), np.float32)
        with evaluating(self.module):
            engine = Engine(self.module, wanted, self.device, None, False, "")
            bank = chosen_bank(self.module, wanted, paths, self.device)
            (protocol,) = protocols(wanted, self.module.image_size, "", bank)
            encoded = engine.side(described, side, [protocol], bank)
            blocks = encoded.describe(protocol)
            if blocks is not None:  # None on ranks other than 0
                for rows, values in blocks():
                    found[rows] = values
            encoded.close()
        return found


def load_model(
    path: str | Path, device: torch.device | str | None = None, image_size: int | str | None = None
) -> Model:
    """A model ready to use.

    Args:
        path: a run folder (its best checkpoint), a checkpoint folder, a file of ours, or a release of a whole model.
        device: none: a GPU where there is one.
        image_size: what photos are brought to: a side (224), "480x640" (height x width), or "native"; none: what the
            file says, for a release that of its authors' evaluation.

    Raises:
        UsageError: nothing there, or weights that do not fit; DataError: a broken file.
    """
    device = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
    return Model(read_whole(str(path), image_size).to(device).eval(), device)


def evaluate(
    model: Model | str | Path,
    sets: str | Sequence[str],
    root: str | Path | None = None,
    config: EvaluationConfig | None = None,
    output: str | Path | None = None,
    progress: bool = True,
) -> list[Result]:
    """Recall of a model, a result for each set and grouping, sets outermost.

    Args:
        model: from `load_model`, or its path.
        sets: names below `root`, or paths, as `jobs.evaluate --sets` takes them.
        root: folder under which names are looked up; none: that of `config`.
        config: groups, group size, N of Recall@N and all else that a protocol says.
        output: folder for the descriptors, where `config.store` keeps them.
        progress: show bars.

    Raises:
        DataError: a set is missing, or a photo is broken; UsageError: settings that cannot be.
    """
    config = config or EvaluationConfig()
    config = config if root is None else dataclasses.replace(config, root=str(root))
    loaded = [load_set(name, config) for name in ([sets] if isinstance(sets, str) else sets)]
    model = model if isinstance(model, Model) else load_model(model)
    folder = None if output is None else Path(output)
    projections = evaluation.projections_from(model.module, config, model.device, progress)
    return evaluation.evaluate(model.module, loaded, config, model.device, folder, progress, projections)


def train(config: RunConfig) -> Outcome:
    """Trains a run in this process, or continues it; `outcome.run` is the folder that `load_model` takes.

    Several processes need a launcher: `accelerate launch ... -m jobs.train`.

    Raises:
        UsageError, DataError: the settings or the shards; Diverged: the loss is not finite.
    """
    from pipeline.training.launch import launched
    from pipeline.training.trainer import train as train_run

    with launched(config.train.timeout) as accelerator:
        return train_run(config, accelerator)
