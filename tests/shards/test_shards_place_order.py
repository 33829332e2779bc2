"""Each place's photos stay with their place, however many places there are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa

from shards.catalogue import SCHEMA, build
from shards.groups import plan_groups


def test_photos_stay_with_their_place() -> None:
    """Arrow's group_by promises no order; with about a hundred places it shows."""
    random = np.random.default_rng(0)
    rows = []
    for place in range(120):
        city, name = "ABC"[place // 40], str(100000 + place % 40)
        rows += [
            {"city": city, "place_id": name, "path": f"{city}/{name}/{i}.jpg", "size": 100 + i}
            for i in range(random.integers(1, 12))
        ]
    catalogue = build("own_places", Path("/nowhere"), pa.Table.from_pylist(rows, schema=SCHEMA))
    plan = plan_groups(catalogue, seed=0, shard_mb=1.0)
    seen: set[tuple[str, str]] = set()
    for place in plan.order:
        mine = catalogue.table.slice(int(plan.starts[place]), int(plan.counts[place])).to_pylist()
        keys = {(row["city"], row["place_id"]) for row in mine}
        assert len(keys) == 1
        assert not keys & seen
        seen |= keys
    assert len(seen) == sum(
        n >= 4 for n in np.unique([r["path"].rsplit("/", 1)[0] for r in rows], return_counts=True)[1]
    )
    listed = catalogue.listed.to_pylist()
    assert [(r["city"], r["place_id"]) for r in listed] == sorted({(r["city"], r["place_id"]) for r in rows})
