"""The paper's comparisons with other methods, filled from released files: `sota` and `challenging`.

    python -m jobs.experiment --table sota --dry_run --released weights/released --root data

Invariant: what a file is follows from its tensors, as everywhere; its name only says what no tensor does (which of
CosPlace and EigenPlaces it is, which data it was trained on). A figure of the paper stands beside ours on the same set
alone. A row or set that could not be evaluated says why.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.common.errors import DataError, UsageError
from pipeline.common.files import write_atomically
from pipeline.common.text import Table, csv_text, markdown_text, printable
from pipeline.config import EvaluationConfig, ModelConfig, flatten
from pipeline.config.image_size import ImageSize
from pipeline.config.setting import changing
from pipeline.evaluation.identity import files_digest
from pipeline.evaluation.protocol import protocols
from pipeline.evaluation.report import paper_numbers, tables
from pipeline.evaluation.report.paper_numbers import FIGURES, HEADLINE, Reported
from pipeline.evaluation.sets.evaluation_set import EvaluationSet
from pipeline.evaluation.sets.load import load_set, sets_there
from pipeline.evaluation.sets.registry import published_name
from pipeline.paper.measure import write_order
from pipeline.paper.plan import dimensions
from pipeline.paper.rows import check_rows
from pipeline.paper.runner import Runner

ENDINGS = (".pth", ".tar", ".safetensors")
NS = (1, 5, 10)
PCA_FROM = "pitts30k"


@dataclass(frozen=True)
class Method:
    """A row: what the paper evaluated, and how (its supplement, section "Compared Methods Details")."""

    dim: int
    """Numbers of the paper's global descriptor, before PCA."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Settings of the evaluation that are the method's own."""
    by_data: bool = False
    """Its model trained on MSLS is evaluated on MSLS, the one trained on Pitts30k elsewhere."""


METHODS: dict[str, Method] = {
    "NetVLAD": Method(32_768),
    "SFRS": Method(4096),
    "Patch-NetVLAD": Method(4096, {"rerank": 100, "rerank_by": "patch-netvlad", "resize": "antialias"}, by_data=True),
    "TransVPR": Method(256, {"rerank": 100, "rerank_by": "transvpr"}, by_data=True),
    "CosPlace": Method(512),
    "GCL": Method(2048, {"pca": 2048, "pca_whiten": True}),
    "MixVPR": Method(4096),
    "EigenPlaces": Method(2048),
    HEADLINE: Method(10_752, {"pca": 4096, "groups": ("ordered",), "pca_from": PCA_FROM}),
}


@dataclass(frozen=True)
class Comparison:
    """A table of the paper that compares methods."""

    title: str
    methods: tuple[str, ...]
    sets: tuple[str, ...]


COMPARISONS = {
    "sota": Comparison(
        "Comparison with other methods (tab:compare_SOTA)",
        tuple(METHODS),
        ("pitts30k", "tokyo247", "msls_val", "msls_challenge"),
    ),
    "challenging": Comparison(
        "Comparison on more challenging sets (suptab:compare_SOTA)",
        ("SFRS", "CosPlace", "MixVPR", "EigenPlaces", HEADLINE),
        ("nordland_2star", "amstertime", "svox_night", "svox_rain", "svox_sun"),
    ),
}


@dataclass(frozen=True)
class Release:
    """A file that is one of the methods."""

    path: Path
    method: str
    dim: int
    image_size: int | str

    @property
    def data(self) -> str:
        """What it was trained on, where its name says so: msls, pitts30k, or nothing."""
        name = self.path.name.lower()
        return "msls" if re.search("msls|mapillary", name) else "pitts30k" if "pitts" in name else ""


@dataclass(frozen=True)
class Cell:
    """A method on a set."""

    release: Release
    set_name: str
    """As `load_set` takes it."""
    config: EvaluationConfig

    @property
    def name(self) -> str:
        """Of its results: the method, and a digest of the file, the set and everything its recalls depend on."""
        told = {k: v for k, v in flatten(self.config).items() if k in changing(EvaluationConfig, "numbers")}
        of = json.dumps([files_digest([self.release.path]), told], sort_keys=True)
        return f"{self.release.method}-{hashlib.sha256(of.encode()).hexdigest()[:10]}"


@dataclass
class ReleasedTable:
    """A comparison over a folder of released files.

    Attributes:
        cells: method x set, in the table's order, of what can be evaluated.
        sets: those that are there, `Cell.set_name` -> set.
        missing: what is not there, one line each: methods, sets, files that are none of the methods.
        notes: what a reader should know of a row.
    """

    name: str
    comparison: Comparison
    runner: Runner
    cells: list[Cell] = field(default_factory=list)
    sets: dict[str, EvaluationSet] = field(default_factory=dict)
    missing: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def results(self) -> Path:
        """Folder of the evaluations, one JSON each, with what was answered to each query."""
        return self.runner.output / "tables" / self.name / "results"

    def result(self, cell: Cell) -> dict[str, Any] | None:
        """What an evaluation found, as `tables.as_dicts`; None where it has not been done."""
        path = self.results / f"{cell.name}.json"
        if not path.is_file():
            return None
        entry: dict[str, Any] = tables.read_json(path)["results"][0]
        return entry

    def fill(self) -> None:
        """Evaluates what is not there yet, file by file.

        Raises:
            Preempted, StepFailed: a child was stopped or failed; what is done is kept.
        """
        for path in dict.fromkeys(cell.release.path for cell in self.cells):
            todo = [cell for cell in self.cells if cell.release.path == path and self.result(cell) is None]
            if todo:
                evaluations = {cell.name: cell.config for cell in todo}
                order = write_order(self.results, path, evaluations)
                self.runner.carry_out(order, f"the evaluation of {path.name}")


def method_of(config: ModelConfig, name: str) -> str:
    """Which method a model is; `name`, of its file, decides where the tensors cannot. Raises `UsageError`: none."""
    pooling, backbone, told = config.pooling, config.backbone, name.lower()
    if pooling.kind == "netvlad":
        if backbone.vgg.layout == "matconvnet":
            return "SFRS"
        return "Patch-NetVLAD" if pooling.netvlad.projection else "NetVLAD"
    if pooling.kind == "cosplace":
        for method in ("EigenPlaces", "CosPlace"):
            if method.lower() in told:
                return method
        raise UsageError(f"{name}: CosPlace or EigenPlaces, which no tensor says; put one of these words into its name")
    if pooling.kind in ("gem", "cls") and "gcl" in told:
        return "GCL"
    kinds = {"mixvpr": "MixVPR", "transvpr": "TransVPR"}
    if pooling.kind == "spm" and config.cross_image.layers:
        return HEADLINE
    if pooling.kind not in kinds:
        raise UsageError(f"{name}: none of the compared methods ({', '.join(METHODS)})")
    return kinds[pooling.kind]


def releases_in(folder: Path) -> tuple[list[Release], list[str]]:
    """(What the files below a folder are, a line for each that is none of the methods or cannot be read).

    Raises:
        UsageError: no such folder, or no such file in it.
    """
    from pipeline.model.weights.load import load_any

    files = sorted(path for path in folder.rglob("*") if path.suffix in ENDINGS and path.is_file())
    if not files:
        raise UsageError(f"--released {folder}: no released file there (their names end in {', '.join(ENDINGS)})")
    found, others = [], []
    for path in files:
        try:
            model = load_any(path)
            found.append(Release(path, method_of(model.config, path.name), model.descriptor_dim, model.image_size))
        except (DataError, UsageError) as error:
            told = str(error)
            others.append(told if path.name in told else f"{path.name}: {told}")
    return found, others


def build(
    name: str, folder: Path, evaluate: EvaluationConfig, runner: Runner, rows: Sequence[str] = ()
) -> ReleasedTable:
    """The table over the files in `folder`: nothing is evaluated or written.

    Args:
        evaluate: its `sets` (those of the table by default) and everything the methods do not say.
        rows: methods to evaluate; none: all of the table.

    Raises:
        UsageError: a method that the table does not have, or no released file in the folder.
    """
    whole = COMPARISONS[name]
    check_rows(rows, whole.methods)
    methods = tuple(method for method in whole.methods if method in rows or not rows)
    table = ReleasedTable(name, dataclasses.replace(whole, methods=methods), runner)
    found, table.missing = releases_in(folder)
    table.sets, missing = sets_there(evaluate.sets or table.comparison.sets, evaluate)
    table.missing += missing
    fitted_on = None
    if any(release.method == HEADLINE for release in found):
        fitted_on = _pca_source(table, evaluate)
    for method in table.comparison.methods:
        own = [release for release in found if release.method == method]
        if not own:
            table.missing.append(f"{method}: no released file of it in {folder}")
            continue
        for set_name, loaded in table.sets.items():
            release = _chosen(table, method, own, loaded)
            if release is not None:
                config = _evaluation(table, release, set_name, evaluate, fitted_on)
                table.cells.append(Cell(release, set_name, config))
    table.missing, table.notes = ([*dict.fromkeys(lines)] for lines in (table.missing, table.notes))
    return table


def _chosen(table: ReleasedTable, method: str, own: list[Release], loaded: EvaluationSet) -> Release | None:
    """The file of a method for a set: by the data it was trained on, then by the paper's dimensions."""
    row = METHODS[method]
    if row.by_data:
        data = "msls" if _known(loaded).startswith("msls") else "pitts30k"
        fitting = [release for release in own if release.data in (data, "")]
        if not fitting:
            table.missing.append(f"{method} on {loaded.name}: no file whose name says that it was trained on {data}")
            return None
        own = [release for release in fitting if release.data] or fitting
    own = [release for release in own if release.dim == row.dim] or own
    if len(own) > 1:
        names = ", ".join(release.path.name for release in own)
        table.missing.append(f"{method} on {loaded.name}: several files, leave one: {names}")
        return None
    if own[0].dim != row.dim:
        table.notes.append(f"{method}: {own[0].path.name} gives {own[0].dim:,} numbers, the paper's {row.dim:,}")
    return own[0]


def _evaluation(
    table: ReleasedTable, release: Release, set_name: str, evaluate: EvaluationConfig, fitted_on: EvaluationSet | None
) -> EvaluationConfig:
    """How the paper evaluated a method on a set; PCA in proportion to a smaller descriptor."""
    row, loaded = METHODS[release.method], table.sets[set_name]
    own = dict(row.settings)
    own["group_size"] = paper_numbers.group_size(_known(loaded))
    if own.get("pca_from") and fitted_on is None:
        del own["pca_from"]
    if "pca" in own:
        wanted = dimensions(release.dim, own["pca"]) if release.method == HEADLINE else min(own["pca"], release.dim)
        source = fitted_on if own.get("pca_from") and fitted_on is not None else loaded
        if wanted > len(source.database):
            table.notes.append(
                f"{release.method} on {loaded.name}: without PCA, which needs {wanted:,} images and has "
                f"{len(source.database):,} of {source.name}"
            )
            own = {k: v for k, v in own.items() if not k.startswith("pca")}
        else:
            own["pca"] = wanted
    return dataclasses.replace(evaluate, **{"sets": (set_name,), "groups": ("single",), **own})


def _pca_source(table: ReleasedTable, evaluate: EvaluationConfig) -> EvaluationSet | None:
    """Pitts30k's training images, on which the paper's PCA is fitted; None where they are not there."""
    try:
        return load_set(PCA_FROM, dataclasses.replace(evaluate, split="train"))
    except (DataError, UsageError):
        table.notes.append(
            f"{HEADLINE}: PCA is fitted on each set's own database, as Pitts30k's training images are not there"
        )
        return None


def _known(loaded: EvaluationSet) -> str:
    return published_name(loaded.name) or loaded.name


def paper_figure(method: str, loaded: EvaluationSet) -> Reported | None:
    """The paper's figures for a method on a set, None where it gives none."""
    name = _known(loaded)
    return paper_numbers.reported(name) if method == HEADLINE else FIGURES.get((name, method, ""))


def set_table(table: ReleasedTable, set_name: str) -> Table:
    """The table of one set: a row a method, ours beside the paper's."""
    loaded = table.sets[set_name]
    cells = {cell.release.method: cell for cell in table.cells if cell.set_name == set_name}
    rows = []
    for method in table.comparison.methods:
        figure = paper_figure(method, loaded)
        theirs = _joined([None if figure is None else figure.at(n) for n in NS])
        if method not in cells:
            rows.append([method, "-", theirs, "", ""])
            continue
        cell = cells[method]
        found = table.result(cell)
        ours = _joined([None if found is None else found["recalls"].get(str(n)) for n in NS])
        rows.append([method, ours, theirs, cell.release.path.name, _protocol(table, cell)])
    return Table(["method", "ours R@1 / 5 / 10", "paper", "file", "protocol"], rows, left=(0, 3, 4))


def _protocol(table: ReleasedTable, cell: Cell) -> str:
    """The name of what was measured, else of what will be."""
    found, loaded = table.result(cell), table.sets[cell.set_name]
    return found["protocol_name"] if found else protocols(cell.config, cell.release.image_size, loaded.rule)[0].name


def _joined(values: list[float | None]) -> str:
    told = ["-" if value is None else f"{value:.1f}" for value in values]
    return "-" if set(told) == {"-"} else " / ".join(told)


def heading(table: ReleasedTable, set_name: str) -> str:
    """What a set is, in one line."""
    s = table.sets[set_name]
    return f"{s.name}: {len(s.database):,} database images, {len(s.queries):,} queries, positives {s.rule}"


def notes(table: ReleasedTable) -> list[str]:
    """What was found beside recalls (time and memory of second stages among it), and what is missing: each once."""
    lines: dict[str, None] = {"recalls in percent; the paper's stand beside the same set": None}
    for cell in table.cells:
        for remark in (table.result(cell) or {"remarks": ()})["remarks"]:
            lines[f"{cell.release.method} on {table.sets[cell.set_name].name}: {remark}"] = None
    return [*lines, *table.notes, *(f"missing: {line}" for line in table.missing)]


def show(table: ReleasedTable) -> None:
    """Prints the tables of all sets, the notes below."""
    print(table.comparison.title)
    for set_name in table.sets:
        print("\n" + printable(heading(table, set_name)))
        set_table(table, set_name).print()
    print("\n" + "\n".join(map(printable, notes(table))))


def write(table: ReleasedTable, folder: Path) -> None:
    """`table.md`, and `table.csv` with one line a method, set and N, in `folder`."""
    out = [f"# {table.comparison.title}", ""]
    for set_name in table.sets:
        out += [markdown_text(heading(table, set_name)), "", set_table(table, set_name).markdown()]
    out += [f"- {markdown_text(note)}" for note in notes(table)]
    write_atomically(folder / "table.md", "\n".join(out) + "\n")
    write_atomically(folder / "table.csv", csv_text(_long_form(table)))


def _long_form(table: ReleasedTable) -> Iterator[list[object]]:
    """A line a method, set and N, its head first."""
    yield ["table", "method", "file", "set", "protocol", "n", "recall", "paper", "paper_table"]
    for cell in table.cells:
        loaded, found = table.sets[cell.set_name], table.result(cell)
        figure = paper_figure(cell.release.method, loaded)
        for n, recall in (found or {"recalls": {}})["recalls"].items():
            told = None if figure is None else figure.at(int(n))
            theirs = ["", ""] if figure is None else ["" if told is None else told, figure.table]
            named = [cell.release.method, cell.release.path.name, loaded.name, _protocol(table, cell)]
            yield [table.name, *named, n, recall, *theirs]


def costs(table: ReleasedTable, images_per_second: float | None = None) -> str:
    """What filling the table takes: files, sets, images to describe, pairs to match, and what is missing."""
    out = [table.comparison.title, ""]
    described = pairs = 0
    for cell in table.cells:
        loaded, release = table.sets[cell.set_name], cell.release
        images, matched = len(loaded.database) + len(loaded.queries), len(loaded.queries) * cell.config.rerank
        done = table.result(cell) is not None
        if not done:
            described, pairs = described + images, pairs + matched
        told = f", {matched:,} pairs to match" if matched else ""
        out.append(
            f"  {release.method} on {loaded.name}  [{'done' if done else 'to do'}]  {images:,} images of "
            f"{ImageSize.of(release.image_size).text} px{told}; {release.path.name}, {_protocol(table, cell)}"
        )
    out += [f"  {heading(table, set_name)}" for set_name in table.sets]
    out += ["", f"still to describe: {described:,} images; still to match: {pairs:,} pairs"]
    if images_per_second and described:
        hours = described / images_per_second / 3600
        out.append(f"describing: about {hours:,.1f} hours at {images_per_second:,.0f} images/s (given)")
    elif described:
        out.append("time: give --images_per_second, the images that are described in a second")
    out += table.notes
    out += [f"missing: {line}" for line in table.missing] or ["nothing is missing"]
    return "\n".join(out)
