"""Is a difference between two recalls real? Paired bootstrap over the queries both were measured on.

Invariant: only predictions of the same queries with the same positives under the same protocol are compared, query by
query; what both found or both missed says nothing about which is better.

A resample of Q queries with replacement holds (gained, lost, neither) queries as one draw of a multinomial with the
observed shares, so resampling costs nothing, whatever Q is; the interval is the percentile interval (Efron and
Tibshirani, An Introduction to the Bootstrap, 1993, chapter 13). With few disagreeing queries that interval is too
narrow, so a difference is called real only if McNemar's exact test agrees (McNemar, 1947: a sign test of the
disagreeing queries). Both take queries as independent; neighbouring frames of a drive are not, and deserve more doubt.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.common.text import Table, csv_text, shown
from pipeline.evaluation.predictions import Predictions, load_predictions

SAMPLES = 10_000
LEVEL = 0.95


@dataclass(frozen=True)
class Difference:
    """Recall@k of a second run minus that of a first one, in percentage points."""

    set_name: str
    protocol: str
    k: int
    runs: tuple[str, str]
    recalls: tuple[float, float]
    queries: int
    gained: int
    """Queries that only the second found."""
    lost: int
    """Queries that only the first found."""
    low: float
    high: float
    """The 95 % interval of the difference."""
    p_value: float
    """McNemar's exact test, two-sided."""

    @property
    def value(self) -> float:
        """Points; positive: the second run is better."""
        return 100.0 * (self.gained - self.lost) / self.queries

    @property
    def real(self) -> bool:
        """Whether the interval leaves zero out and the exact test agrees."""
        return (self.low > 0 or self.high < 0) and self.p_value < 1 - LEVEL

    @property
    def text(self) -> str:
        """`R@1 82.1 -> 84.2: difference +2.1 [+0.4, +3.9] real`"""
        told = "real" if self.real else "not distinguishable"
        change = f"{self.value:+.1f} [{self.low:+.1f}, {self.high:+.1f}]"
        return f"R@{self.k} {self.recalls[0]:.1f} -> {self.recalls[1]:.1f}: difference {change} {told}"


def paired_interval(gained: int, lost: int, queries: int, seed: int = 0, samples: int = SAMPLES) -> tuple[float, float]:
    """The 95 % percentile interval, in points, of `100 * (gained - lost) / queries` under resampling of the queries."""
    return _interval(np.array([1.0, -1.0, 0.0]), np.array([gained, lost, queries - gained - lost]), seed, samples)


def interval_of(differences: np.ndarray, seed: int = 0, samples: int = SAMPLES) -> tuple[float, float]:
    """The 95 % percentile interval, in points, of 100 times the mean of per-query differences [Q], each -1 to 1 (the
    mean over several trainings, for example), under resampling of the queries."""
    values, counts = np.unique(np.round(differences, 12), return_counts=True)
    return _interval(values, counts, seed, samples)


def _interval(values: np.ndarray, counts: np.ndarray, seed: int, samples: int) -> tuple[float, float]:
    """Of queries with `counts` [n] of each of the differences `values` [n]."""
    queries = int(counts.sum())
    drawn = np.random.Generator(np.random.PCG64(seed)).multinomial(queries, counts / queries, samples)
    low, high = np.quantile(drawn @ values, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return 100.0 * float(low) / queries, 100.0 * float(high) / queries


def mcnemar(gained: int, lost: int) -> float:
    """Two-sided exact p-value that gains and losses are equally likely; 1 where nothing differs."""
    if gained + lost == 0:
        return 1.0
    from scipy.stats import binomtest

    return float(binomtest(gained, gained + lost, 0.5).pvalue)


def differences(first: Predictions, second: Predictions, runs: tuple[str, str], ks: Sequence[int]) -> list[Difference]:
    """The two compared at every k they both have; none where they were not measured on the same queries."""
    if not _comparable(first, second):
        return []
    counted = np.ones(len(first.queries), bool)
    if first.protocol.without_positives == "drop":
        counted = np.fromiter((len(p) > 0 for p in first.positives), bool, len(counted))
    queries = int(counted.sum())
    found = []
    for k in ks:
        if queries == 0 or k > min(first.rows.shape[1], second.rows.shape[1]):
            continue
        hits = [((p.ranks >= 0) & (p.ranks < k))[counted] for p in (first, second)]
        gained, lost = int((hits[1] & ~hits[0]).sum()), int((hits[0] & ~hits[1]).sum())
        recalls = (100.0 * float(hits[0].mean()), 100.0 * float(hits[1].mean()))
        interval = paired_interval(gained, lost, queries)
        about = (first.set_name, first.protocol.name, k, runs, recalls, queries, gained, lost)
        found.append(Difference(*about, *interval, mcnemar(gained, lost)))
    return found


def compare_folders(
    runs: Sequence[tuple[str, Path]], ks: Sequence[int] = (1, 5, 10), every_pair: bool = False
) -> tuple[list[Difference], list[str]]:
    """Every later run against the first, on every set and protocol both have predictions of.

    Args:
        runs: (name, folder of predictions); folders that are not there are told, not compared.
        every_pair: each run against each earlier one, not against the first alone.

    Returns:
        (differences, what could not be compared and why).
    """
    notes = [f"{name}: no predictions in {folder}; run jobs.evaluate on it" for name, folder in runs if not _in(folder)]
    there = [(name, folder) for name, folder in runs if _in(folder)]
    found: list[Difference] = []
    pairs = list(itertools.combinations(there, 2)) if every_pair else [(there[0], later) for later in there[1:]]
    for (base, base_folder), (name, folder) in pairs:
        common = [file for file in _in(folder) if (base_folder / file).is_file()]
        if not common:
            notes.append(f"{name} and {base} have no set and protocol in common")
        for file in common:
            first, second = load_predictions(base_folder / file), load_predictions(folder / file)
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
    path.write_text(csv_text(lines))


def _in(folder: Path) -> list[str]:
    return sorted(file.name for file in folder.glob("*.parquet"))


def _comparable(first: Predictions, second: Predictions) -> bool:
    """The same queries in the same order, by name since folders move, with the same positives and protocol."""
    return (
        first.set_name == second.set_name
        and first.protocol == second.protocol
        and [Path(q).name for q in first.queries] == [Path(q).name for q in second.queries]
        and all(np.array_equal(a, b) for a, b in zip(first.positives, second.positives, strict=True))
    )
