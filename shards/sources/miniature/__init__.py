"""The miniature: a small procedural city, photographed, in exactly the layouts of real data.

`draw` writes `gsv/` (GSV-Cities' layout) and `eval/miniature/` (evaluation folders with `@utm` names), so that
everything downstream meets real file layouts without a download.
towns -> place (identity) -> facade; weather, cutouts, camera -> photograph (a photo); plan (names) -> drawing.
Invariant: the same settings give the same bytes.
"""

from shards.sources.miniature.drawing import MiniatureConfig, draw

__all__ = ["MiniatureConfig", "draw"]
