"""Churches, towers and wall paintings: what a person would remember of a place.

Invariant: depends on the building's own random stream alone.
"""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw

from shards.sources.miniature.painter import PX, Painter, Wall, pattern, tone, window
from shards.sources.miniature.place import Building


def church(b: Building, w: float, rng: np.random.Generator) -> Wall:
    colour = tone(b.family.walls[0], 1.02)
    p = Painter(w, b.height + w * 0.55, colour)
    pattern(p, b.family, colour, rng)
    for x, y, ww, hh in ((w * 0.18, 2.6, 1.3, 3.0), (w * 0.82 - 1.3, 2.6, 1.3, 3.0)):
        window(p, b.family, x, y, ww, hh, rng)
    p.rect(w / 2 - 1.5, 0, w / 2 + 1.5, 3.2, tone(b.family.trim, 0.9))
    p.rect(w / 2 - 1.1, 0, w / 2 + 1.1, 2.9, b.family.accent)
    q = p.box(w / 2 - 1.4, 5.2, w / 2 + 1.4, 8.0)
    p.draw.ellipse(q, fill=tone(b.family.trim, 0.9))
    p.draw.ellipse((q[0] + 5, q[1] + 5, q[2] - 5, q[3] - 5), fill=(72, 66, 96))
    p.wall.shops.append((q[0] + 12, q[1] + 12, q[2] - 12, q[3] - 12))
    alpha = Image.new("L", p.size, 255)
    top = [(0, p.height), (0, b.height), (w / 2, p.height), (w, b.height), (w, p.height)]
    ImageDraw.Draw(alpha).polygon([(x * PX, (p.height - y) * PX) for x, y in top], fill=0)
    p.draw.line([(x * PX, (p.height - y) * PX) for x, y in top[1:4]], fill=tone(b.family.trim, 0.9), width=6)
    p.wall.alpha = alpha
    return p.wall


def tower(p: Painter, b: Building, rng: np.random.Generator) -> None:
    w, h = p.width, b.height
    for y in np.arange(3.5, h - 5, 4.0):
        window(p, b.family, w / 2 - 0.45, float(y), 0.9, 1.8, rng)
    q = p.box(w / 2 - 1.2, h - 4.4, w / 2 + 1.2, h - 2.0)
    p.draw.ellipse(q, fill=(236, 230, 214), outline=(60, 52, 48), width=3)
    cx, cy = (q[0] + q[2]) / 2, (q[1] + q[3]) / 2
    p.draw.line((cx, cy, cx + 8, cy - 8), fill=(40, 36, 36), width=3)
    p.draw.line((cx, cy, cx - 3, cy - 13), fill=(40, 36, 36), width=2)
    p.wall.shops.append((q[0] + 6, q[1] + 6, q[2] - 6, q[3] - 6))
    for y in (h - 0.4, h - 1.6, h - 5.0):
        p.rect(0, y, w, y + 0.3, tone(b.family.trim, 0.9))


def mural(p: Painter, x0: float, y0: float, x1: float, y1: float, rng: np.random.Generator) -> None:
    """A wall painting of bands, discs and leaves."""
    inks = [tuple(int(v) for v in c) for c in rng.integers(40, 235, (5, 3))]
    p.rect(x0, y0, x1, y1, (int(inks[0][0]), int(inks[0][1]), int(inks[0][2])))
    for _ in range(9):
        r, g, b = inks[int(rng.integers(1, 5))]
        cx, cy, s = float(rng.uniform(x0, x1)), float(rng.uniform(y0, y1)), float(rng.uniform(0.4, 2.2))
        a, c = max(cx - s, x0), min(cx + s, x1)
        if rng.random() < 0.5:
            q = p.box(a, max(cy - s, y0), c, min(cy + s, y1))
            p.draw.ellipse(q, fill=(r, g, b))
        else:
            p.poly([(a, max(cy - s, y0)), (c, cy), (a, min(cy + s, y1))], (r, g, b))
