"""A filled table for people and programs: terminal, markdown, CSV; and what an unfilled one would cost.

Invariant: a recall never stands without its protocol, and the paper's figure never without its set and protocol; mean
and standard deviation are over seeds (trainings), never over sets or groupings.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

from pipeline.common.files import write_atomically
from pipeline.common.text import Table, csv_text, markdown_text, printable
from pipeline.evaluation.protocol import Protocol
from pipeline.evaluation.sets.registry import published_name
from pipeline.paper import paired
from pipeline.paper.chart import draw
from pipeline.paper.study import Study
from pipeline.paper.values import by_row, paper_figure, paper_set, value

SHOWN = (1, 5)
"""The N of Recall@N in the printed table; the CSV has all."""
PAIRED = "Differences on the same queries, percentage points; intervals over queries, mean over seeds"


def table(study: Study, set_name: str) -> Table:
    """The table of one set: row, what it varied here, our recalls by grouping, the paper's."""
    loaded, protocols = study.sets[set_name], by_row(study, set_name)
    groupings = list(dict.fromkeys(g for row in protocols.values() for g in row))
    sizes = {g: {row[g].group_size for row in protocols.values() if g in row} for g in groupings}
    theirs = paper_set(study, loaded)
    sized = {paper_figure(study, row, loaded) for row in study.table.rows} - {None}
    batches = {f.group_size for f in sized if f is not None}
    batch = ordered(batches.pop()) if len(batches) == 1 else "ordered"
    with_settings = any(study.settings.get(row) for row in study.table.rows)
    head = [study.table.axis or "row", *(["here"] if with_settings else [])]
    for g in groupings:
        named = g if g == "single" or len(sizes[g]) > 1 else f"{g}{next(iter(sizes[g]))}"
        head.append(named)
    head.append(f"paper: {theirs}, {batch}")
    rows = []
    for row in study.table.rows:
        line = [row, *([study.settings.get(row, "")] if with_settings else [])]
        for g in groupings:
            protocol = protocols.get(row, {}).get(g)
            ours = [None if protocol is None else value(study, row, loaded, protocol, k) for k in SHOWN]
            fewer = next((len(f.seeds) for f in ours if f and len(f.seeds) < len(study.seeds)), 0)
            line.append(_cell(["-" if f is None else str(f) for f in ours]) + (f" (n {fewer})" if fewer else ""))
        figure = paper_figure(study, row, loaded)
        at = [None if figure is None else figure.at(k) for k in SHOWN]
        line.append(_cell(["-" if found is None else f"{found:.1f}" for found in at]))
        rows.append(line)
    return Table(head, rows)


def ordered(size: int) -> str:
    """Name of the paper's protocol with groups of so many images."""
    return Protocol(groups="ordered", group_size=size).name


def _cell(figures: list[str]) -> str:
    return "-" if set(figures) == {"-"} else " / ".join(figures)


def heading(study: Study, set_name: str) -> str:
    """What a set is, in one line."""
    s = study.sets[set_name]
    return f"{s.name}: {len(s.database):,} database images, {len(s.queries):,} queries, positives {s.rule}; R@1 / R@5"


def notes(study: Study) -> list[str]:
    """Protocols spelt out, seeds, whose figures the paper's are, rows without numbers, missing sets: each once."""
    counted = ", ".join(map(str, study.seeds))
    spread = "mean ± standard deviation over trainings with seeds" if len(study.seeds) > 1 else "one training, seed"
    lines = {
        f"recalls in percent; ours: {spread} {counted}" + ("; (n 1): so many of them" if _fewer(study) else ""): None
    }
    for set_name, loaded in study.sets.items():
        for row in by_row(study, set_name).values():
            for protocol in row.values():
                told = dataclasses.replace(protocol, rule="as said above")  # one line serves all sets
                lines[f"{protocol.name}: {told.describe()}"] = None
        theirs = paper_set(study, loaded)
        if theirs != (published_name(loaded.name) or loaded.name):
            lines[
                f"the paper has no figures for {loaded.name}: beside it stand those for {theirs}, other photographs, "
                "from a large pretrained backbone; compare orders, not numbers"
            ] = None
    sources = {f.table for n, s in study.sets.items() for r in study.table.rows if (f := paper_figure(study, r, s))}
    if sources:
        lines[f"the paper's figures: {', '.join(sorted(sources))} of its source; groups in file order"] = None
    lines |= {f"{row}: {note}": None for row, note in study.notes.items()}
    lines |= {f"missing: {line}": None for line in study.missing}
    return list(lines)


def _fewer(study: Study) -> bool:
    return any(len(v) < len(study.seeds) for by_n in study.values.values() for v in by_n.values())


def show(study: Study, compared: Sequence[paired.Paired]) -> None:
    """Prints the tables of all sets, the differences, the notes below."""
    print(study.table.title)
    for set_name in study.sets:
        print("\n" + printable(heading(study, set_name)))
        table(study, set_name).print()
    if compared:
        print(f"\n{PAIRED}")
        paired.table(compared).print()
    print("\n" + "\n".join(map(printable, notes(study))))


def markdown(study: Study, compared: Sequence[paired.Paired]) -> str:
    """The same as markdown."""
    out = [f"# {study.table.title}", ""]
    for set_name in study.sets:
        out += [markdown_text(heading(study, set_name)), "", table(study, set_name).markdown()]
    if compared:
        out += [PAIRED, "", paired.table(compared).markdown()]
    return "\n".join([*out, *(f"- {markdown_text(note)}" for note in notes(study))]) + "\n"


def write(study: Study, compared: Sequence[paired.Paired], folder: Path) -> None:
    """`table.md`, `table.csv` (one line a row, set, protocol and N), `table.png`, and `paired.csv` in `folder`.

    `compared`: from `paired.paired`.
    """
    write_atomically(folder / "table.md", markdown(study, compared))
    write_atomically(folder / "table.csv", csv_text(_long_form(study)))
    if compared:
        write_atomically(folder / "paired.csv", paired.csv(compared))
    draw(study, folder / "table.png")


def _long_form(study: Study) -> Iterator[list[object]]:
    """A line a row, set, protocol and N, its head first."""
    fields = ["row", "here", "set", "protocol", "n", "mean", "deviation", "seeds", "paper", "paper_set"]
    yield ["table", *fields, "paper_protocol", "paper_table"]
    for set_name, loaded in study.sets.items():
        for row, protocols in by_row(study, set_name).items():
            figure = paper_figure(study, row, loaded)
            for protocol in protocols.values():
                for k in study.values.get((row, loaded.name, protocol.name), {}):
                    found = value(study, row, loaded, protocol, k)
                    if found is None:
                        continue
                    spread = "" if found.deviation is None else found.deviation
                    seeds = " ".join(str(v) for v in found.seeds)
                    ours = [study.settings.get(row, ""), loaded.name, protocol.name, k, found.mean, spread, seeds]
                    theirs: list[object] = ["", "", "", ""]
                    if figure is not None:
                        told = figure.at(k)
                        paper = [paper_set(study, loaded), ordered(figure.group_size), figure.table]
                        theirs = ["" if told is None else told, *paper]
                    yield [study.name, row, *ours, *theirs]


def costs(study: Study, images_per_second: float | None = None) -> str:
    """What filling the table takes: rows, trainings with their state, images, time, and what is missing."""
    shared: dict[str, dict[str, None]] = {}
    for row, name in study.uses:
        shared.setdefault(name, {})[row] = None
    out = [f"{study.table.title}: {len(study.table.rows)} rows, trainings needed: {len(study.trainings)}", ""]
    for each in study.trainings:
        told = "steps unknown" if each.steps is None else f"{each.steps:,} steps, {each.images:,} images"
        status = study.runner.status(each)
        out.append(f"  {each.name}  [{status}]  at most {told}; rows: {', '.join(shared[each.name])}")
    out += [""] if study.sets else []
    for set_name in study.sets:
        out.append(f"  {heading(study, set_name)}")
    images, described = study.images_to_train(), study.images_to_describe()
    known = "unknown until the shards are there" if images is None else f"{images:,} images at most"
    out += ["", f"still to train: {known}; still to describe: {described:,} images"]
    speed = images_per_second or study.measured_speed()
    if images is not None and speed:
        source = "given" if images_per_second else "median of recorded runs of this table"
        # describing is a forward pass only: a third of a training step's arithmetic, about
        hours = (images + described / 3) / speed / 3600
        out.append(f"about {_duration(hours)} at {speed:,.0f} images/s ({source}), validation not counted")
    elif images:
        out.append("time: give --images_per_second as measured by a short run to have it estimated")
    out += [f"{row}: {note}" for row, note in study.notes.items()]
    out += [f"missing: {line}" for line in study.missing] or ["nothing is missing"]
    return "\n".join(out)


def _duration(hours: float) -> str:
    return f"{hours * 60:.0f} minutes" if hours < 2 else f"{hours:,.0f} hours"
