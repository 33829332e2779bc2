"""Is a difference between two recalls of the same queries real? The statistics alone: paired bootstrap and McNemar.

A resample of Q queries with replacement holds (gained, lost, neither) queries as one draw of a multinomial with the
observed shares, so resampling costs nothing, whatever Q is; the interval is the percentile interval (Efron and
Tibshirani, An Introduction to the Bootstrap, 1993, chapter 13). With few disagreeing queries that interval is too
narrow, so a difference is called real only if McNemar's exact test agrees (McNemar, 1947: a sign test of the
disagreeing queries). Both take queries as independent; neighbouring frames of a drive are not, and deserve more doubt.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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


def difference(
    about: tuple[str, str, int, tuple[str, str]], ranks: tuple[np.ndarray, np.ndarray], counted: np.ndarray
) -> Difference:
    """Of two answers to the same queries.

    Args:
        about: set, protocol, k, names of the two.
        ranks: int64 [Q] each, of `recall.first_hits` among at least k predictions.
        counted: bool [Q], the queries that the recalls are of; at least one.
    """
    k, queries = about[2], int(counted.sum())
    hits = [((r >= 0) & (r < k))[counted] for r in ranks]
    gained, lost = int((hits[1] & ~hits[0]).sum()), int((hits[0] & ~hits[1]).sum())
    recalls = (100.0 * float(hits[0].mean()), 100.0 * float(hits[1].mean()))
    return Difference(
        *about, recalls, queries, gained, lost, *paired_interval(gained, lost, queries), mcnemar(gained, lost)
    )


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
