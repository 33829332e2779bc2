"""The miniature: a small procedural city, photographed, in exactly the layouts of real data.

`draw(out, places, seed)` writes `out/gsv` (GSV-Cities' layout) and `out/eval/miniature` (evaluation folders with `@utm`
names), so that everything downstream meets real file layouts without a download.
Rooms: styles -> place (identity) -> facade; weather, objects, camera -> picture (a photo); layout (names) -> drawing.
Invariant: NumPy and Pillow only; the same settings give the same bytes.
"""

from shards.sources.miniature.drawing import MiniatureSummary, draw

__all__ = ["MiniatureSummary", "draw"]
