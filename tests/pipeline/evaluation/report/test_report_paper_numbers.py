"""The paper's figures: every number of the tables stands in the paper's source, in the row that it is given for."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from pipeline.evaluation.report import paper_numbers
from pipeline.evaluation.sets.registry import SETS


def table_numbers(source: str, label: str) -> list[list[str]]:
    """Rows of the LaTeX table with this label, as lists of their decimal numbers."""
    end = source.index(f"\\label{{{label}}}")
    start = source.rindex("\\begin{table", 0, end)
    rows = source[start:end].split("\\\\")
    return [re.findall(r"(?<![\d.])\d+\.\d(?!\d)", row) for row in rows]


@pytest.mark.parametrize("table", sorted(paper_numbers.TABLES))
def test_tables_are_the_papers(shared_dir: Path, table: str) -> None:
    label, rows = paper_numbers.TABLES[table]
    in_paper = table_numbers((shared_dir / "paper" / "cricavpr.tex").read_text(), label)
    for name, cells in rows.items():
        numbers = re.findall(r"\d+\.\d", cells)
        found = [row for row in in_paper if any(row[at : at + len(numbers)] == numbers for at in range(len(row)))]
        assert found, f"{table}: row {name} is not in {label}"


def test_single_rows_are_the_papers(shared_dir: Path) -> None:
    source = (shared_dir / "paper" / "cricavpr.tex").read_text()
    for (label, name, row), cells in paper_numbers.OTHERS.items():
        numbers = cells.split()
        found = [r for r in table_numbers(source, label) if any(r[i : i + 3] == numbers for i in range(len(r)))]
        assert found, f"{row} on {name} is not in {label}"


def test_the_headline_carries_its_protocol() -> None:
    assert {name for name in SETS if paper_numbers.reported(name)} == {
        "pitts30k", "pitts250k", "tokyo247", "msls_val", "msls_challenge", "nordland_2star", "amstertime",
        "svox_night", "svox_rain", "svox_sun",
    }  # fmt: skip
    pitts = paper_numbers.FIGURES["pitts30k", "CricaVPR", "ordered8_pca4096"]
    assert pitts == paper_numbers.reported("pitts30k") and pitts.recalls == (94.9, 97.3, 98.2) and pitts.group_size == 8
    tokyo = paper_numbers.reported("tokyo247")
    assert tokyo is not None and (tokyo.at(1), tokyo.at(20), tokyo.group_size) == (93.0, None, 16)
    single = paper_numbers.FIGURES["tokyo247", "CricaVPR", "single"]
    assert single.recalls == (89.5, 94.6, 96.2) and single.group_size == 1
    assert paper_numbers.FIGURES["pitts30k", "CricaVPR", "ordered16"].recalls[0] == 93.7
    assert paper_numbers.FIGURES["msls_val", "MixVPR", ""].recalls == (88.0, 92.7, 94.6)
    assert paper_numbers.reported("sped") is None


def test_rows_by_table() -> None:
    row = paper_numbers.table_row("ablation_crica", "AdaptSPM")
    assert {name: figures.recalls for name, figures in row.items()} == {
        "pitts30k": (90.6, 95.9, None), "tokyo247": (85.1, 93.3, None), "msls_val": (85.5, 93.2, None),
    }  # fmt: skip
    assert paper_numbers.table_row("inference_batch", "4")["pitts30k"].group_size == 4
    assert paper_numbers.table_row("ablation_crica", "nobody") == {} and paper_numbers.table_row("none", "x") == {}
