"""Trees, cars, people and street furniture as small cut-out pictures.

Invariant: a cut-out depends on its arguments alone and is drawn once a process.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from PIL import Image, ImageDraw

from shards.sources.miniature.styles import RGB


@dataclass(frozen=True)
class Cutout:
    """A picture (RGB) with its outline (L), `width` times its height wide; `lights` in pixels shine at night."""

    picture: Image.Image
    alpha: Image.Image
    width: float
    lights: tuple[tuple[float, float, float, float], ...] = ()
    _levels: dict[int, tuple[Image.Image, Image.Image]] = field(default_factory=dict)

    def level(self, shrink: int) -> tuple[Image.Image, Image.Image]:
        """Picture and outline at 1 / shrink of their size."""
        if shrink not in self._levels:
            self._levels[shrink] = (self.picture.reduce(shrink), self.alpha.reduce(shrink))
        return self._levels[shrink]


SPECIES = ("round", "poplar", "plane", "palm", "conifer", "cypress")
LEAVES: dict[str, tuple[RGB, ...]] = {
    "spring": ((122, 158, 74), (142, 172, 88), (216, 176, 186)),
    "summer": ((62, 106, 50), (76, 120, 56), (54, 96, 52)),
    "autumn": ((196, 124, 46), (176, 84, 40), (206, 164, 62)),
    "winter": ((96, 84, 70), (92, 80, 70), (88, 78, 66)),
}


def _canvas(
    width: int, height: int, base: RGB
) -> tuple[Image.Image, Image.Image, ImageDraw.ImageDraw, ImageDraw.ImageDraw]:
    picture, alpha = Image.new("RGB", (width, height), base), Image.new("L", (width, height), 0)
    return picture, alpha, ImageDraw.Draw(picture), ImageDraw.Draw(alpha)


@lru_cache(maxsize=256)
def tree(species: str, season: str, snow: bool, variant: int) -> Cutout:
    """A tree 180 pixels high, foot at the bottom centre."""
    rng = np.random.default_rng([len(species), variant, sum(map(ord, species))])
    height, width = 180, {"poplar": 70, "cypress": 46, "conifer": 100, "palm": 120}.get(species, 140)
    evergreen = species in ("conifer", "cypress", "palm")
    leaf = LEAVES["summer" if evergreen else season][variant % 3 if not evergreen else 0]
    if evergreen:
        leaf = (52, 84, 58) if species != "palm" else (86, 118, 62)
    bare = season == "winter" and not evergreen
    picture, alpha, draw, cut = _canvas(width, height, leaf if not bare else (84, 72, 62))
    bark: RGB = (92, 76, 62) if species != "plane" else (134, 124, 104)
    middle = width / 2

    def stroke(x0: float, y0: float, x1: float, y1: float, thick: int, colour: RGB = bark) -> None:
        draw.line((x0, y0, x1, y1), fill=colour, width=thick)
        cut.line((x0, y0, x1, y1), fill=255, width=thick)

    def blob(x: float, y: float, r: float, colour: tuple[int, ...], flat: float = 0.8) -> None:
        draw.ellipse((x - r, y - r * flat, x + r, y + r * flat), fill=colour)
        cut.ellipse((x - r, y - r * flat, x + r, y + r * flat), fill=255)

    stroke(middle, height, middle, height * 0.45, 9 if species in ("plane", "round") else 6)
    if species == "palm":
        for k in range(13):
            a = math.pi * (0.02 + 0.96 * k / 12) + float(rng.normal(0, 0.08))
            x, y = middle, height * 0.42
            for step in range(9):
                nx, ny = x + 7.5 * math.cos(a), y - 7.5 * math.sin(a) + step * 1.5
                stroke(x, y, nx, ny, 6 - step // 2, tuple(int(c * (0.75 + 0.05 * step)) for c in leaf))  # type: ignore[arg-type]
                x, y = nx, ny
        stroke(middle, height, middle + 1, height * 0.42, 6, (126, 106, 84))
    elif species in ("conifer", "cypress"):
        for _ in range(150 if species == "conifer" else 110):
            t = rng.random()
            y = height * (0.03 + 0.85 * t)
            half = (
                (width * 0.46 * t + 2)
                if species == "conifer"
                else width * 0.40 * math.sin(math.pi * (0.12 + 0.82 * t)) + 2
            )
            x = middle + rng.uniform(-half, half)
            f = 0.75 + 0.4 * rng.random() - 0.15 * t
            white = snow and rng.random() < 0.4
            blob(x, y, 5.5, (236, 240, 246) if white else tuple(int(c * f) for c in leaf), 0.6)
    else:
        crown = 0.40 if species != "poplar" else 0.46
        _branches(
            stroke, rng, middle, height * 0.55, -math.pi / 2, height * 0.17, 5, 0.5 if species != "poplar" else 0.25
        )
        if not bare:
            n = 520 if species != "poplar" else 380
            for k in range(n):
                a, r = rng.uniform(0, 2 * math.pi), math.sqrt(rng.random())
                x, y = (
                    middle + r * math.cos(a) * width * 0.42,
                    height * (crown - 0.02) + r * math.sin(a) * height * (crown - 0.06),
                )
                lit = 0.72 + 0.5 * (k / n) - 0.28 * math.sin(a) * r * -1 * -1 + 0.12 * rng.normal()
                lit = min(max(lit, 0.5), 1.35)
                blob(x, y, float(rng.uniform(2.6, 6.4)), tuple(int(min(c * lit, 255)) for c in leaf))
    if snow and bare:
        noise = rng.random((height, width)) < 0.35
        picture.paste((232, 236, 242), mask=Image.fromarray((noise * 255).astype(np.uint8)))
    return Cutout(picture, alpha, width / height)


def _branches(stroke, rng, x: float, y: float, angle: float, length: float, thick: int, spread: float) -> None:  # type: ignore[no-untyped-def]
    nx, ny = x + length * math.cos(angle), y + length * math.sin(angle)
    stroke(x, y, nx, ny, thick)
    if length > 9:
        for turn in (-1, 1) if length < 20 else (-1, 0.1, 1):
            _branches(
                stroke,
                rng,
                nx,
                ny,
                angle + turn * spread * float(rng.uniform(0.6, 1.3)),
                length * float(rng.uniform(0.6, 0.78)),
                max(thick - 1, 1),
                spread,
            )


PAINTS: tuple[RGB, ...] = (
    (186, 190, 194), (44, 48, 54), (150, 34, 36), (40, 70, 122), (232, 232, 228),
    (92, 98, 92), (196, 168, 66), (64, 110, 92),
)  # fmt: skip
CAR_SIZES = {"car": (4.3, 1.5), "van": (5.2, 2.2), "bus": (10.5, 3.0), "truck": (7.0, 3.0), "bike": (1.8, 1.7)}


@lru_cache(maxsize=256)
def vehicle(kind: str, paint: int, rear: bool) -> Cutout:
    """A vehicle from its side (driving right) or its rear, 40 pixels a metre."""
    length, high = CAR_SIZES[kind]
    w, h = int((length if not rear else min(length, 1.85 if high < 2.5 else 2.5)) * 40), int(high * 40)
    body = PAINTS[paint % len(PAINTS)]
    if kind == "bus":
        body = ((176, 40, 40), (40, 96, 150), (220, 176, 60))[paint % 3]
    picture, alpha, draw, cut = _canvas(w, h, body)
    glass, black = (46, 56, 66), (26, 26, 28)

    def both(points: list[tuple[float, float]], colour: RGB) -> None:
        scaled = [(x * w, y * h) for x, y in points]
        draw.polygon(scaled, fill=colour)
        cut.polygon(scaled, fill=255)

    dark = (int(body[0] * 0.7), int(body[1] * 0.7), int(body[2] * 0.7))
    if kind == "bike":
        for x in (0.2, 0.8):
            box = (x * w - 13, h - 28, x * w + 13, h - 2)
            draw.ellipse(box, outline=black, width=3)
            cut.ellipse(box, outline=255, width=3)
        both([(0.2, 0.8), (0.45, 0.5), (0.75, 0.55), (0.5, 0.85)], dark)
        both([(0.35, 0.5), (0.6, 0.5), (0.62, 0.15), (0.42, 0.15)], PAINTS[(paint + 3) % 8])
        both([(0.46, 0.0), (0.58, 0.0), (0.58, 0.14), (0.46, 0.14)], (196, 156, 132))
        return Cutout(picture, alpha, w / h)
    if rear:
        top = 0.04 if high > 2 else 0.0
        both([(0.04, 0.92), (0.02, 0.5), (0.14, top), (0.86, top), (0.98, 0.5), (0.96, 0.92)], body)
        both([(0.16, 0.42), (0.22, top + 0.07), (0.78, top + 0.07), (0.84, 0.42)], glass)
        both([(0.08, 0.8), (0.25, 0.8), (0.25, 1.0), (0.08, 1.0)], black)
        both([(0.75, 0.8), (0.92, 0.8), (0.92, 1.0), (0.75, 1.0)], black)
        draw.rectangle((0.36 * w, 0.66 * h, 0.64 * w, 0.76 * h), fill=(232, 230, 214))
        lamps = ((0.05 * w, 0.52 * h, 0.2 * w, 0.62 * h), (0.8 * w, 0.52 * h, 0.95 * w, 0.62 * h))
        for lamp in lamps:
            draw.rectangle(lamp, fill=(176, 32, 30))
        return Cutout(picture, alpha, w / h, lamps)
    if kind == "car":
        both(
            [
                (0.0, 0.82),
                (0.01, 0.5),
                (0.1, 0.42),
                (0.26, 0.04),
                (0.66, 0.02),
                (0.82, 0.42),
                (0.98, 0.54),
                (1.0, 0.82),
            ],
            body,
        )
        both([(0.2, 0.4), (0.29, 0.1), (0.46, 0.09), (0.46, 0.4)], glass)
        both([(0.49, 0.4), (0.49, 0.09), (0.64, 0.09), (0.77, 0.4)], glass)
        draw.line((0.475 * w, 0.42 * h, 0.475 * w, 0.8 * h), fill=dark, width=2)
        draw.rectangle((0, 0.74 * h, w, 0.82 * h), fill=dark)
        wheels, r = (0.2, 0.8), 0.075 * w
    elif kind == "bus":
        both([(0.0, 0.9), (0.0, 0.06), (0.02, 0.0), (0.98, 0.0), (1.0, 0.08), (1.0, 0.9)], body)
        for k in range(7):
            x = 0.03 + k * 0.137
            draw.rectangle((x * w, 0.16 * h, (x + 0.12) * w, 0.5 * h), fill=glass)
        draw.rectangle((0, 0.62 * h, w, 0.68 * h), fill=(236, 232, 222))
        wheels, r = (0.2, 0.78), 0.05 * w
    else:
        both(
            [
                (0.0, 0.86),
                (0.0, 0.06),
                (0.62 if kind == "truck" else 0.72, 0.04),
                (0.72, 0.3),
                (0.93, 0.46),
                (1.0, 0.6),
                (1.0, 0.86),
            ],
            body,
        )
        if kind == "truck":
            both([(0.0, 0.74), (0.0, 0.0), (0.68, 0.0), (0.68, 0.74)], (222, 218, 206))
        both([(0.74, 0.5), (0.74, 0.32), (0.84, 0.36), (0.91, 0.5)], glass)
        wheels, r = (0.2, 0.8), 0.065 * w
    for x in wheels:
        for radius, colour in ((r, black), (r * 0.5, (150, 150, 152))):
            rim = (x * w - radius, h - r - radius, x * w + radius, h - r + radius)
            draw.ellipse(rim, fill=colour)
            cut.ellipse(rim, fill=255)
    front_and_rear = ((w * 0.955, h * 0.56, w * 0.998, h * 0.66), (w * 0.002, h * 0.54, w * 0.03, h * 0.64))
    draw.rectangle(front_and_rear[0], fill=(236, 230, 206))
    draw.rectangle(front_and_rear[1], fill=(170, 36, 34))
    return Cutout(picture, alpha, w / h, front_and_rear)


@lru_cache(maxsize=128)
def person(variant: int, umbrella: bool) -> Cutout:
    """Someone walking, 80 pixels high."""
    rng = np.random.default_rng([variant, 5])
    w, h = 64, 88
    picture, alpha, draw, cut = _canvas(w, h, (70, 66, 66))
    coat, legs = tuple(rng.integers(30, 200, 3).tolist()), tuple(rng.integers(25, 90, 3).tolist())
    skin = ((226, 184, 156), (176, 128, 96), (112, 78, 60))[variant % 3]

    def part(points: list[tuple[float, float]], colour: tuple[int, ...]) -> None:
        draw.polygon(points, fill=colour)
        cut.polygon(points, fill=255)

    part([(27, 50), (33, 50), (30 - 4, 87), (22, 87)], legs)
    part([(31, 50), (37, 50), (42, 87), (38, 87)], legs)
    part([(24, 28), (28, 24), (36, 24), (40, 28), (39, 56), (25, 56)], coat)
    for d, fill in ((draw, skin), (cut, 255)):
        d.ellipse((27, 13, 37, 25), fill=fill)
    if umbrella:
        cloth = tuple(rng.integers(30, 220, 3).tolist())
        for d, ink in ((draw, cloth), (cut, 255)):
            d.pieslice((8, 0, 56, 30), 180, 360, fill=ink)
        part([(40, 14), (41, 14), (41, 36), (40, 36)], (40, 40, 40))
    return Cutout(picture, alpha, w / h)


@lru_cache(maxsize=128)
def furniture(kind: str, variant: int, lamp: str) -> Cutout:
    """Lamps, benches, signs and other small things; `lamp` is the town's pattern of street lamp."""
    iron, colour = (52, 56, 58), PAINTS[variant % len(PAINTS)]
    w, h = {
        "lamp": (60, 180),
        "bench": (120, 60),
        "roadsign": (40, 150),
        "postbox": (40, 80),
        "bollards": (160, 50),
        "kiosk": (130, 150),
        "hedge": (60 * max(variant, 1), 60),
        "statue": (80, 160),
    }[kind]
    picture, alpha, draw, cut = _canvas(w, h, iron)
    lights: list[tuple[float, float, float, float]] = []

    def rect(box: tuple[float, float, float, float], ink: RGB) -> None:
        draw.rectangle(box, fill=ink)
        cut.rectangle(box, fill=255)

    def disc(box: tuple[float, float, float, float], ink: RGB) -> None:
        draw.ellipse(box, fill=ink)
        cut.ellipse(box, fill=255)

    if kind == "lamp":
        rect((28, 20, 32, 180), iron)
        if lamp == "arm":
            rect((28, 12, 58, 15), iron)
            lights = [(42, 13, 58, 19)]
        elif lamp == "globe":
            lights = [(21, 4, 39, 22)]
        else:
            lights = [(22, 6, 38, 24)]
            rect((20, 2, 40, 6), iron)
        disc(lights[0], (214, 214, 206))
    elif kind == "bench":
        rect((4, 10, 116, 22), (120, 84, 56))
        rect((4, 30, 116, 38), (110, 76, 50))
        rect((14, 10, 19, 60), iron)
        rect((101, 10, 106, 60), iron)
    elif kind == "roadsign":
        rect((18, 30, 22, 150), (140, 142, 144))
        disc((2, 2, 38, 38), ((30, 70, 150), (190, 40, 40), (236, 236, 230))[variant % 3])
        disc((9, 9, 31, 31), ((236, 236, 236), (240, 236, 232), (190, 40, 40))[variant % 3])
    elif kind == "postbox":
        rect((6, 8, 34, 80), ((176, 34, 36), (30, 76, 130), (214, 170, 40))[variant % 3])
        rect((11, 22, 29, 26), (30, 30, 30))
    elif kind == "bollards":
        for k in range(5):
            rect((8 + k * 34, 10, 14 + k * 34, 50), iron)
    elif kind == "kiosk":
        rect((10, 30, 120, 150), colour)
        rect((2, 18, 128, 34), (52, 70, 60))
        rect((20, 50, 110, 100), (70, 80, 88))
        lights = [(20, 50, 110, 100)]
    elif kind == "hedge":
        rng = np.random.default_rng(variant)
        for x, y in zip(rng.uniform(0, w, 12 * variant), rng.uniform(14, 60, 12 * variant), strict=True):
            f = float(rng.uniform(0.7, 1.2))
            disc((x - 9, y - 9, x + 9, y + 9), (int(62 * f), int(92 * f), int(54 * f)))
    else:
        rect((18, 90, 62, 160), (168, 162, 150))
        rect((12, 148, 68, 160), (150, 144, 134))
        rect((32, 34, 50, 92), (86, 110, 100))
        disc((33, 14, 49, 36), (86, 110, 100))
        rect((46, 30 + 4 * variant, 64, 38 + 4 * variant), (80, 104, 94))
    return Cutout(picture, alpha, w / h, tuple(lights))
