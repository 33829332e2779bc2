"""One HTML file for an evaluation: its tables, curves, grids and error plots; opens anywhere, without a network.

Invariant: the file refers to nothing outside itself: styles are inline, pictures are data URLs, there are no scripts;
every name in it is escaped (Jinja's autoescape), and none holds a control character (`printable`).
"""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path

from pipeline.common.files import write_atomically
from pipeline.common.text import printable
from pipeline.evaluation.evaluate import Result
from pipeline.evaluation.report.pictures import Picture
from pipeline.evaluation.report.tables import notes, table

TEMPLATE = "page.html.j2"


def write_page(
    results: Sequence[Result], pictures: Sequence[Picture], path: Path, title: str, about: Mapping[str, str]
) -> None:
    """Writes the page. `about`: facts of the head line, such as checkpoint, date, descriptor size."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("pipeline.evaluation", "report"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=lambda value: printable(value) if type(value) is str else value,
    )
    names = dict.fromkeys(result.set_name for result in results)
    page = environment.get_template(TEMPLATE).render(
        title=title,
        about=about,
        table=table(results),
        notes=notes(results),
        sets={name: [_shown(picture) for picture in pictures if picture.set_name == name] for name in names},
    )
    write_atomically(path, page)


def _shown(picture: Picture) -> dict[str, object]:
    kind = "jpeg" if picture.path.suffix == ".jpg" else "png"
    data = f"data:image/{kind};base64,{base64.b64encode(picture.path.read_bytes()).decode()}"
    return {"title": picture.title, "open": picture.open, "data": data}
