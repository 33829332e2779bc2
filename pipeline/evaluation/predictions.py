"""Predictions on disk: what was answered to each query, so that recalls, intervals and figures need no model.

Invariant: a file holds one set under one protocol, with both in its schema, and a row for each query in set order.

Columns: `query` (path), `rows` (list of database rows, best first), `distances` (squared L2), `positives` (list of
correct rows), `rank` (from 0, of the first correct one; -1 where none is among the rows).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.common.errors import DataError
from pipeline.common.files import replacing, write_atomically
from pipeline.common.text import shown
from pipeline.evaluation.evaluate import Result
from pipeline.evaluation.protocol import Protocol, read_protocol
from pipeline.evaluation.recall import first_hits
from pipeline.evaluation.report import tables
from pipeline.evaluation.sets.evaluation_set import EvaluationSet
from pipeline.evaluation.sets.msls import export_predictions

META = b"place_recognition"


@dataclass(frozen=True)
class Predictions:
    """What `load_predictions` reads."""

    set_name: str
    protocol: Protocol
    queries: list[str]
    rows: np.ndarray
    """int64 [Q, K], -1 where the database is smaller"""
    distances: np.ndarray
    """float32 [Q, K]"""
    positives: list[np.ndarray]
    ranks: np.ndarray
    """int64 [Q]: recall@n is the mean of (0 <= ranks) & (ranks < n)"""


def predictions_path(folder: Path, set_name: str, protocol: Protocol) -> Path:
    """`<folder>/<set>.<protocol>.parquet`"""
    return folder / f"{set_name}.{protocol.name}.parquet"


def save_predictions(result: Result, evaluated: EvaluationSet, folder: Path) -> Path:
    """Writes a result's predictions, whole or not at all; returns the file.

    MSLS-challenge also gets the file that its server takes.
    """
    about = {"set": result.set_name, "protocol": result.protocol.to_dict(), "database": result.database}
    table = pa.table(
        {
            "query": pa.array([str(path) for path in evaluated.queries]),
            "rows": _lists(result.predictions.astype(np.int64, copy=False)),
            "distances": _lists(result.distances.astype(np.float32, copy=False)),
            "positives": _lists([np.asarray(p, np.int64) for p in evaluated.positives]),
            "rank": pa.array(first_hits(result.predictions, evaluated.positives)),
        }
    ).replace_schema_metadata({META: json.dumps(about)})
    path = predictions_path(folder, result.set_name, result.protocol)
    with replacing(path) as fresh:
        pq.write_table(table, fresh, compression="zstd")
    if evaluated.name == "msls_challenge":
        export_predictions(evaluated, result.predictions, path.with_suffix(".txt"))
    return path


def save_results(results: Sequence[Result], sets: Sequence[EvaluationSet], output: Path, about: dict[str, Any]) -> None:
    """All that an evaluation leaves but pictures: results.json, results.csv, results.md, and predictions/.

    `about`: what results.json says of the model.
    """
    tables.write_json(results, output / "results.json", about)
    tables.write_csv(results, output / "results.csv")
    write_atomically(output / "results.md", tables.markdown(results))
    for result in results:
        evaluated = next(s for s in sets if s.name == result.set_name)
        save_predictions(result, evaluated, output / "predictions")


def load_predictions(path: Path) -> Predictions:
    """Reads a file of `save_predictions`. Raises `DataError` for anything else."""
    try:
        table = pq.read_table(path)
        about = json.loads(table.schema.metadata[META])
        return Predictions(
            about["set"],
            read_protocol(about["protocol"], str(path)),
            table["query"].to_pylist(),
            np.array(table["rows"].to_pylist(), np.int64),
            np.array(table["distances"].to_pylist(), np.float32),
            [np.array(p, np.int64) for p in table["positives"].to_pylist()],
            table["rank"].to_numpy(),
        )
    except (OSError, pa.ArrowException, KeyError, TypeError, ValueError, OverflowError) as error:
        reason = shown(" ".join(str(error).split()))
        raise DataError(f"{path}: not a file of predictions ({reason}); evaluate again") from None


def _lists(values: np.ndarray | list[np.ndarray]) -> pa.Array:
    """A column of lists from [Q, K], or from Q arrays, without an object a number."""
    lengths = np.fromiter(map(len, values), np.int64, len(values))
    flat = values.ravel() if isinstance(values, np.ndarray) else np.concatenate([np.zeros(0, np.int64), *values])
    return pa.ListArray.from_arrays(np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32), flat)
