"""Runs compared query by query, from what their evaluations answered: `difference` on files of predictions.

Invariant: only predictions of the same queries with the same positives under the same protocol are compared, query by
query; what both found or both missed says nothing about which is better.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.common.files import write_atomically
from pipeline.common.text import Table, csv_text, shown
from pipeline.evaluation.difference import Difference, difference
from pipeline.evaluation.predictions import Predictions, load_predictions


def differences(first: Predictions, second: Predictions, runs: tuple[str, str], ks: Sequence[int]) -> list[Difference]:
    """The two compared at every k they both have; none where they were not measured on the same queries."""
    if not _comparable(first, second):
        return []
    counted = np.ones(len(first.queries), bool)
    if first.protocol.without_positives == "drop":
        counted = np.fromiter((len(p) > 0 for p in first.positives), bool, len(counted))
    known = min(first.rows.shape[1], second.rows.shape[1])
    return [
        difference((first.set_name, first.protocol.name, k, runs), (first.ranks, second.ranks), counted)
        for k in ks
        if k <= known and counted.any()
    ]


def compare_folders(
    runs: Sequence[tuple[str, Path]], ks: Sequence[int] = (1, 5, 10), every_pair: bool = False
) -> tuple[list[Difference], list[str]]:
    """Every later run against the first, on every set and protocol both have predictions of.

    Args:
        runs: (name, folder of an evaluation); what it scored from its stored descriptors counts as well. Folders
            without predictions are told, not compared.
        every_pair: each run against each earlier one, not against the first alone.

    Returns:
        (differences, what could not be compared and why).
    """
    notes = [f"{name}: no predictions in {folder}; run jobs.evaluate on it" for name, folder in runs if not _in(folder)]
    there = [(name, folder) for name, folder in runs if _in(folder)]
    found: list[Difference] = []
    pairs = list(itertools.combinations(there, 2)) if every_pair else [(there[0], later) for later in there[1:]]
    for (base, base_folder), (name, folder) in pairs:
        base_files, files = _in(base_folder), _in(folder)
        common = [file for file in files if file in base_files]
        if not common:
            notes.append(f"{name} and {base} have no set and protocol in common")
        for file in common:
            first, second = load_predictions(base_files[file]), load_predictions(files[file])
            compared = differences(first, second, (base, name), ks)
            if not compared:
                notes.append(f"{file}: {name} was measured on other queries, positives or settings than {base}")
            found += compared
    return found, notes


def as_text(found: Sequence[Difference]) -> str:
    """Lines by pair of runs, set and protocol."""
    parts: list[str] = []
    for runs, each in itertools.groupby(found, key=lambda d: d.runs):
        rows = [
            [f"  {d.set_name}", d.protocol, d.text, f"({d.gained} gained, {d.lost} lost of {d.queries:,})"]
            for d in each
        ]
        head = f"{shown(runs[0])} -> {shown(runs[1])}, same queries, 95 % intervals"
        parts.append(head + "\n" + Table((), rows, range(4)).text())
    return "\n\n".join(parts)


def as_markdown(found: Sequence[Difference]) -> str:
    """A table, the real differences in bold."""
    head = ["runs", "set", "protocol", "N", "recall, %", "difference, 95 % interval", "judgement"]
    rows = [
        [
            " -> ".join(d.runs), d.set_name, d.protocol, str(d.k), f"{d.recalls[0]:.1f} -> {d.recalls[1]:.1f}",
            f"{d.value:+.1f} [{d.low:+.1f}, {d.high:+.1f}]", "real" if d.real else "not distinguishable",
        ]
        for d in found
    ]  # fmt: skip
    return Table(head, rows, (0, 1, 2, 6), [(i, 6) for i, d in enumerate(found) if d.real]).markdown()


def write_csv(found: Sequence[Difference], path: Path) -> None:
    """One line a difference."""
    lines: list[list[object]] = [
        ["first", "second", "set", "protocol", "n", "recall_first", "recall_second", "difference", "low", "high",
         "gained", "lost", "queries", "p_value", "real"]
    ]  # fmt: skip
    for d in found:
        interval = [*d.recalls, d.value, d.low, d.high]
        counts = [d.gained, d.lost, d.queries]
        lines.append([*d.runs, d.set_name, d.protocol, d.k, *interval, *counts, d.p_value, d.real])
    write_atomically(path, csv_text(lines))


def _in(evaluation: Path) -> dict[str, Path]:
    """Name -> file of the predictions of an evaluation, then of those made from its store alone."""
    found = [f for part in ("from_store/", "") for f in sorted(evaluation.glob(f"{part}predictions/*.parquet"))]
    return {file.name: file for file in found}


def _comparable(first: Predictions, second: Predictions) -> bool:
    """The same queries in the same order, by name since folders move, with the same positives and protocol."""
    return (
        first.set_name == second.set_name
        and first.protocol == second.protocol
        and [Path(q).name for q in first.queries] == [Path(q).name for q in second.queries]
        and all(np.array_equal(a, b) for a, b in zip(first.positives, second.positives, strict=True))
    )
