"""Facades: flat pictures of walls with windows, doors, shops and signs, later laid on the walls in perspective.

Invariant: a facade depends on its building and face alone.
"""

from __future__ import annotations

import itertools

import numpy as np
from PIL import Image, ImageDraw

from shards.sources.miniature.landmark import church, mural, tower
from shards.sources.miniature.painter import PX, Painter, Wall, pattern, tone, window
from shards.sources.miniature.place import Building
from shards.sources.miniature.styles import RGB, SIGN_COLOURS, SIGNS


def front(building: Building) -> Wall:
    """The street face of a house, with its gable."""
    rng = np.random.default_rng([building.seed, 7])
    family = building.family
    depth_axis = building.fronts[0] in ("east", "west")
    width = building.z1 - building.z0 if depth_axis else building.x1 - building.x0
    if building.landmark == "church":
        return church(building, width, rng)
    extra = {"gable": width * 0.5, "stepped": width * 0.5 + 0.6}.get(family.roof, 0.0)
    colour = tone(family.walls[int(rng.integers(len(family.walls)))], float(rng.uniform(0.93, 1.07)))
    p = Painter(width, building.height + extra, colour)
    pattern(p, family, colour, rng)
    if building.landmark == "tower":
        tower(p, building, rng)
        return p.wall
    shop = rng.random() < family.shops and width > 4.5
    _floors(p, building, rng, shop)
    _ground(p, building, rng, shop, colour)
    if extra:
        _gable(p, building, extra, rng)
    else:
        top = building.height
        p.rect(0, top - 0.35, width, top, tone(family.trim, 0.92))
        p.rect(0, top - 0.5, width, top - 0.35, tone(family.trim, 0.6))
        p.wall.ledges.append((0, width * PX, (p.height - top) * PX))
    return p.wall


def side(building: Building, width: float) -> Wall:
    """A plain side or back wall: few windows, sometimes a mural."""
    rng = np.random.default_rng([building.seed, 11])
    family = building.family
    chosen = np.random.default_rng([building.seed, 7])
    colour = tone(family.walls[int(chosen.integers(len(family.walls)))], float(chosen.uniform(0.93, 1.07)))
    p = Painter(width, building.height, colour)
    pattern(p, family, colour, rng)
    if building.mural:
        mural(p, 0.6, 0.8, width - 0.6, min(building.height - 1.0, 9.0), rng)
    else:
        for floor in range(building.floors):
            for x in np.arange(1.6, width - 1.6, family.bay * 2):
                if rng.random() < 0.35:
                    window(p, family, float(x), floor * family.storey + 1.2, 0.9, 1.4, rng)
    return p.wall


def _floors(p: Painter, b: Building, rng: np.random.Generator, shop: bool) -> None:
    """The grid of windows above the ground floor."""
    f = b.family
    usable = p.width - 0.8
    count = max(int(usable / f.bay), 1)
    step = usable / count
    band = rng.random() < 0.4
    railing = rng.random(b.floors) < f.balconies
    for floor in range(1, b.floors):
        y = floor * f.storey
        if f.window == "curtain":
            p.rect(0.3, y + 0.5, p.width - 0.3, y + f.storey - 0.1, tone((96, 122, 142), float(rng.uniform(0.8, 1.1))))
            for k in range(count):
                x = 0.4 + k * step
                if rng.random() < 0.35:
                    p.rect(
                        x, y + 0.5, x + step, y + f.storey - 0.1, tone((132, 158, 172), float(rng.uniform(0.6, 1.2)))
                    )
                p.wall.lights.append(p.box(x + 0.1, y + 0.5, x + step - 0.1, y + f.storey - 0.1))
                p.rect(x - 0.06, y + 0.2, x + 0.06, y + f.storey, f.trim)
            continue
        if f.window == "ribbon":
            p.rect(0.6, y + 0.9, p.width - 0.6, y + 2.3, tone((88, 104, 118), float(rng.uniform(0.8, 1.1))))
            for k in range(count):
                x = 0.4 + k * step
                p.wall.lights.append(p.box(max(x, 0.6) + 0.1, y + 0.9, x + step - 0.1, y + 2.3))
                if rng.random() < 0.3:
                    p.rect(x + 0.1, y + 1.5, x + step - 0.1, y + 2.3, (196, 190, 180))
                p.rect(x - 0.07, y + 0.9, x + 0.07, y + 2.3, f.trim)
            p.rect(0.4, y + 0.75, p.width - 0.4, y + 0.9, tone(f.trim, 0.9))
            continue
        if band:
            p.rect(0, y - 0.1, p.width, y + 0.12, tone(f.trim, 0.88))
        tall = f.window == "french"
        w, h = min(step * 0.5, 1.15), (2.2 if tall else 1.55)
        for k in range(count):
            x = 0.4 + (k + 0.5) * step - w / 2
            window(p, f, x, y + (0.25 if tall else 0.85), w, h, rng)
            if tall and not railing[floor]:
                p.rect(x - 0.15, y + 0.25, x + w + 0.15, y + 0.33, f.accent)
                p.rect(x - 0.15, y + 1.0, x + w + 0.15, y + 1.1, f.accent)
        if railing[floor]:
            start, end = (0.2, p.width - 0.2) if tall else (0.4 + step * 0.1, 0.4 + step * max(1, count - 1) * 0.95)
            p.rect(start, y - 0.05, end, y + 0.2, tone(f.trim, 0.75))
            p.rect(start, y + 1.0, end, y + 1.1, f.accent)
            for x in np.arange(start, end, 0.27):
                p.rect(float(x), y + 0.2, float(x) + 0.07, y + 1.0, f.accent)


def _ground(p: Painter, b: Building, rng: np.random.Generator, shop: bool, colour: RGB) -> None:
    """Door, and a shop with sign and awning or plain windows."""
    f = b.family
    w = p.width
    door = float(rng.choice([0.7, w - 1.9, w / 2 - 0.6]))
    paint = SIGN_COLOURS[int(rng.integers(len(SIGN_COLOURS)))]
    if shop:
        p.rect(0.2, 0, w - 0.2, f.storey - 0.15, tone(paint, 0.8) if rng.random() < 0.6 else tone(f.trim, 0.7))
        for x0, x1 in ((0.5, door - 0.25), (door + 1.45, w - 0.5)):
            if x1 - x0 > 0.8:
                p.rect(x0, 0.5, x1, f.storey - 1.05, (70, 82, 90))
                p.rect(x0, 0.5, x1, 1.1, (112, 104, 92))
                for x in np.arange(x0 + 0.2, x1 - 0.3, 0.5):
                    p.rect(
                        float(x),
                        0.5,
                        float(x) + 0.3,
                        float(rng.uniform(0.8, 1.5)),
                        tone(SIGN_COLOURS[int(rng.integers(8))], 0.9),
                    )
                p.wall.shops.append(p.box(x0, 0.5, x1, f.storey - 1.05))
        p.rect(0.2, f.storey - 0.95, w - 0.2, f.storey - 0.2, paint)
        ink: RGB = (246, 240, 224) if sum(paint) < 420 else (44, 40, 44)
        word = SIGNS[int(rng.integers(len(SIGNS)))]
        p.text(w / 2, f.storey - 0.6, min(0.62, (w - 1.0) / (0.62 * len(word))), word, ink)
        if rng.random() < 0.45:
            stripes = (paint, (238, 232, 220))
            n = max(int(w / 0.6), 2)
            for k in range(n):
                x0, x1 = 0.2 + k * (w - 0.4) / n, 0.2 + (k + 1) * (w - 0.4) / n
                p.rect(x0, f.storey - 1.55, x1, f.storey - 0.95, stripes[k % 2])
            p.rect(0.2, f.storey - 1.62, w - 0.2, f.storey - 1.5, tone(paint, 0.6))
            p.wall.ledges.append((0.2 * PX, (w - 0.2) * PX, (p.height - f.storey + 0.95) * PX))
    else:
        count = max(int((w - 0.8) / f.bay), 1)
        step = (w - 0.8) / count
        for k in range(count):
            x = 0.4 + (k + 0.5) * step - 0.55
            if abs(x - door) > 1.5:
                window(p, f, x, 1.0, min(1.1, step * 0.55), 1.4, rng)
    leaf = f.accent if rng.random() < 0.6 else paint
    p.rect(door - 0.15, 0, door + 1.3, 2.5, tone(f.trim, 0.85))
    p.rect(door, 0, door + 1.15, 2.1, leaf)
    p.rect(door + 0.15, 1.1, door + 1.0, 1.9, tone(leaf, 0.7))
    p.rect(door, 2.15, door + 1.15, 2.4, (92, 104, 112))
    p.wall.lights.append(p.box(door, 2.15, door + 1.15, 2.4))


def _gable(p: Painter, b: Building, extra: float, rng: np.random.Generator) -> None:
    """Cuts the wall's top into a triangle or steps, and draws the attic's window and the coping."""
    w, eave, top = p.width, b.height, p.height - 0.05
    alpha = Image.new("L", p.size, 255)
    cut = ImageDraw.Draw(alpha)
    edge: list[tuple[float, float]] = [(0, eave)]
    if b.family.roof == "stepped":
        steps = 4
        for k in range(steps):
            x, y = w * 0.5 * (k / (steps + 0.8)), eave + (k + 1) * (top - eave) / (steps + 1)
            edge += [(x, y), (w * 0.5 * ((k + 1) / (steps + 0.8)), y)]
        edge += [(edge[-1][0], top)]
        edge += [(w - x, y) for x, y in reversed(edge)]
    else:
        edge += [(w / 2, top), (w, eave)]
    outside = [(0.0, p.height), *edge, (w, p.height)]
    cut.polygon([(x * PX, (p.height - y) * PX) for x, y in outside], fill=0)
    line = [(x * PX, (p.height - y) * PX) for x, y in edge]
    p.draw.line(line, fill=tone(b.family.trim, 0.95), width=5 if b.family.roof == "gable" else 4)
    p.wall.ledges += [(a[0], c[0], a[1]) for a, c in itertools.pairwise(line) if abs(a[1] - c[1]) < 1]
    window(p, b.family, w / 2 - 0.45, eave + extra * 0.12, 0.9, min(1.3, extra * 0.45), rng)
    p.wall.alpha = alpha
