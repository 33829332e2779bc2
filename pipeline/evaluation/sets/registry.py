"""The field's evaluation sets by name: the folder each is expected in, its layout, its rule and its published counts.

Invariant: this is a plain table; reading a layout is the business of `layouts` and `msls`. Counts are those of the
published papers, so a set that differs on disk is told apart from the one others report on.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

UTM_LAYOUT = "images/{split}/{database,queries}/.../@UTM_east@UTM_north@...@.jpg"


@dataclass(frozen=True)
class Published:
    """One named set."""

    folders: tuple[str, ...]
    """Names its folder goes by, below the root, in any case."""
    layout: Literal["utm", "svox", "pairs", "nordland", "gardens_point", "msls_val", "msls_challenge"]
    """How it lies on disk."""
    looks: str
    """That layout in words, for the message when it is missing."""
    counts: tuple[tuple[str, int, int], ...] = ()
    """(split, database, queries) as published."""
    rule: str = "25 m"
    """What makes a positive, by default."""
    frames: int = 0
    """The +- frames of a frame rule."""
    queries: tuple[str, ...] = ("queries",)
    """Names of the query folder(s)."""


_SVOX = ("night", "rain", "sun", "snow", "overcast")
_SVOX_QUERIES = {"night": 823, "rain": 937, "sun": 854, "snow": 870, "overcast": 872}
_PAIRS = "{new,old}/ or {ref,query}/ or images/test/{database,queries}/, partners with the same name"
_MSLS = ("msls", "mapillary_sls", "Mapillary_Street_Level_Sequences", "msls_val", "msls_challenge")
_NORDLAND = "images/test/{database,queries} (summer, winter) or {summer,winter}/ or {ref,query}/, frames in order"
_SF_XL = (("v1", 1000), ("v2", 598), ("night", 466), ("occlusion", 76))

SETS: dict[str, Published] = {
    "pitts30k": Published(
        ("pitts30k",), "utm", UTM_LAYOUT, (("test", 10_000, 6_816), ("val", 10_000, 7_608), ("train", 10_000, 7_416))
    ),
    "pitts250k": Published(("pitts250k",), "utm", UTM_LAYOUT, (("test", 83_952, 8_280),)),
    "tokyo247": Published(("tokyo247", "tokyo24_7", "tokyo_247"), "utm", UTM_LAYOUT, (("test", 75_984, 315),)),
    "msls_val": Published(
        _MSLS,
        "msls_val",
        "train_val/{cph,sf}/{database,query}/{images/,raw.csv,postprocessed.csv,subtask_index.csv}, or "
        "images/val/{database,queries}/@...@.jpg with a list of the 740 official queries beside it",
        (("any", 18_871, 740),),
    ),
    "msls_challenge": Published(
        _MSLS,
        "msls_challenge",
        "test/<city>/{database,query}/{images/,subtask_index.csv} and the ground truth's postprocessed.csv, there or "
        "in test_meta/<city>/{database,query}/",
        (("any", 38_770, 27_092),),
    ),
    "nordland_2star": Published(
        ("nordland",), "nordland", _NORDLAND, (("any", 27_592, 27_592),), "+-10 frames", frames=10
    ),
    "nordland_star": Published(("nordland",), "nordland", _NORDLAND, (("any", 27_592, 2_760),), "+-1 frames", frames=1),
    "amstertime": Published(("amstertime",), "pairs", _PAIRS, (("any", 1_231, 1_231),), "pairs"),
    "sped": Published(("sped", "spedtest"), "pairs", _PAIRS, (("any", 607, 607),), "pairs"),
    "gardens_point": Published(
        ("gardens_point", "gardenspoint", "GardensPointWalking"),
        "gardens_point",
        "{day_left,day_right,night_right}/, 200 frames each",
        (("any", 200, 200),),
        "+-2 frames",
        frames=2,
    ),
    "svox": Published(
        ("svox",),
        "svox",
        "images/test/{gallery,queries_night,...}/@UTM_east@UTM_north@...@.jpg",
        (("test", 17_166, sum(_SVOX_QUERIES.values())),),
        queries=tuple(f"queries_{condition}" for condition in _SVOX),
    ),
    "sf_xs": Published(("sf_xs", "sf-xs", "sfxs"), "utm", "{train,val,test}/{database,queries}/@...@.jpg"),
}
SETS |= {
    f"svox_{condition}": Published(
        ("svox",),
        "svox",
        f"images/test/{{gallery,queries_{condition}}}/@UTM_east@UTM_north@...@.jpg",
        (("test", 17_166, _SVOX_QUERIES[condition]),),
        queries=(f"queries_{condition}",),
    )
    for condition in _SVOX
}
SETS |= {
    f"sf_xl_{part}": Published(
        ("sf_xl", "sf-xl", "sfxl"),
        "utm",
        f"processed/test/{{database,queries_{part}}}/@...@.jpg",
        (("test", 2_805_840, count),) if part == "v1" else (),
        queries=(f"queries_{part}",),
    )
    for part, count in _SF_XL
}

ALIASES = {
    "nordland*": "nordland_star",
    "nordland**": "nordland_2star",
    "tokyo24/7": "tokyo247",
    "gardens_point_walking": "gardens_point",
}


def key(name: str) -> str:
    """A name without case and punctuation, as names are compared."""
    return re.sub(r"[^a-z0-9*]", "", name.lower())


_BY_KEY = {key(name): name for name in SETS} | {key(alias): name for alias, name in ALIASES.items()}


def published_name(text: str) -> str | None:
    """The set's name in this table, however it is written (`Tokyo24/7`, `SVOX-Night`, `nordland**`); else None."""
    return _BY_KEY.get(key(text)) if not text.startswith((".", "/", "~")) else None


def count_remark(name: str, split: str, database: int, queries: int) -> str | None:
    """A line when a published set's counts are not those on disk; None when they agree or none are published."""
    for of_split, wanted_database, wanted_queries in SETS[name].counts if name in SETS else ():
        if of_split in (split, "any") and (database, queries) != (wanted_database, wanted_queries):
            return (
                f"{database:,} database images and {queries:,} queries here, "
                f"published are {wanted_database:,} and {wanted_queries:,}"
            )
    return None
