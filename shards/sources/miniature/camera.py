"""The camera of a drawn street, and upright walls seen through it in true perspective.

World axes of a place, in metres: x to the right along the street, y up, z away from the camera.
Invariant: a wall is one plane, so its picture is one homography; nothing behind the camera is ever drawn.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

Array = NDArray[np.float64]
Point = tuple[float, float, float]
Pixels = list[tuple[float, float]]
NEAR = 0.4  # metres


@dataclass(frozen=True)
class Camera:
    """A pinhole with a shifted lens, so that verticals stay vertical.

    Args:
        x, y, z: position in metres; yaw: heading from +z towards +x, in radians.
        focal: in pixels; horizon: its row in pixels; width, height: of the canvas in pixels.
    """

    x: float
    y: float
    z: float
    yaw: float
    focal: float
    horizon: float
    width: int
    height: int

    @cached_property
    def matrix(self) -> Array:
        """[3, 3] world directions to homogeneous pixels."""
        c, s, f, u, v = math.cos(self.yaw), math.sin(self.yaw), self.focal, self.width / 2, self.horizon
        return np.array([[f * c + u * s, 0.0, u * c - f * s], [v * s, -f, v * c], [s, 0.0, c]])

    def project(self, points: Sequence[Point]) -> Array:
        """[n, 3] homogeneous pixels; the last column is the depth in metres."""
        return np.asarray((np.array(points) - (self.x, self.y, self.z)) @ self.matrix.T)

    def polygon(self, points: Sequence[Point]) -> Pixels:
        """Pixels of a convex polygon, cut at the near plane; empty when it is out of sight."""
        rows = self.project(points).tolist()
        kept: list[tuple[float, float, float]] = []
        for (x0, y0, w0), (x1, y1, w1) in zip(rows, rows[1:] + rows[:1], strict=True):
            if w0 >= NEAR:
                kept.append((x0, y0, w0))
            if (w0 >= NEAR) != (w1 >= NEAR):
                t = (NEAR - w0) / (w1 - w0)
                kept.append((x0 + t * (x1 - x0), y0 + t * (y1 - y0), NEAR))
        pixels = [(x / w, y / w) for x, y, w in kept]
        if len(pixels) < 3:
            return []
        us, vs = [u for u, _ in pixels], [v for _, v in pixels]
        return pixels if max(us) > 0 and min(us) < self.width and max(vs) > 0 and min(vs) < self.height else []


def normal(points: Sequence[Point]) -> Array:
    """[3] unit vector towards the side from which a polygon's points run clockwise."""
    (a, b, c), (d, e, f) = points[0], points[len(points) // 2]
    (i, j, k), (p, q, o) = points[1], points[-1]
    (u, v, w), (r, s, t) = (d - a, e - b, f - c), (p - i, q - j, o - k)
    n = np.array([v * t - w * s, w * r - u * t, u * s - v * r])
    return np.asarray(n / math.sqrt(float(n @ n)))


def faces(points: Sequence[Point], camera: Camera) -> bool:
    """Whether the camera stands before a polygon, not behind it."""
    x, y, z = points[0]
    return float(normal(points) @ (camera.x - x, camera.y - y, camera.z - z)) > 0.01


def upright(x0: float, z0: float, x1: float, z1: float, low: float, high: float) -> list[Point]:
    """A wall from the foot (x0, z0) on its left to (x1, z1) on its right, clockwise from the top left."""
    return [(x0, high, z0), (x1, high, z1), (x1, low, z1), (x0, low, z0)]


def lay(
    canvas: Image.Image, camera: Camera, wall: list[Point], picture: Image.Image, alpha: Image.Image | None
) -> None:
    """Draws `picture` (RGB), cut out by `alpha` (L, same size) where given, on a rectangle as the camera sees it."""
    outline = camera.polygon(wall)
    if not outline:
        return
    us, vs = [u for u, _ in outline], [v for _, v in outline]
    left, top = max(math.floor(min(us)), 0), max(math.floor(min(vs)), 0)
    wide, high = min(math.ceil(max(us)), camera.width) - left, min(math.ceil(max(vs)), camera.height) - top
    if wide < 1 or high < 1:
        return
    shrink_x, shrink_y = (
        min(max(int(size / max(max(at) - min(at), 1.0)), 1), max(size // 4, 1))
        for size, at in zip(picture.size, (us, vs), strict=True)
    )
    if max(shrink_x, shrink_y) > 1:  # what would alias
        picture = picture.reduce((shrink_x, shrink_y))
        alpha = alpha.reduce((shrink_x, shrink_y)) if alpha else None
    (a, b, _, d), (width, height) = np.array(wall), picture.size
    right, down = (b - a) / (width - 2), (d - a) / (height - 2)
    start = a - right - down - (camera.x, camera.y, camera.z)  # one pixel of margin keeps the border's colour
    forward = camera.matrix @ np.stack([right, down, start], axis=1)
    back = np.linalg.inv(np.array([[1.0, 0.0, -left], [0.0, 1.0, -top], [0.0, 0.0, 1.0]]) @ forward)
    data = tuple((back / (back[2, 2] if abs(back[2, 2]) > 1e-12 else 1e-12)).ravel()[:8].tolist())
    kind, smooth = Image.Transform.PERSPECTIVE, Image.Resampling.BILINEAR
    patch = picture.transform((wide, high), kind, data, smooth)
    if alpha is not None:
        mask = alpha.transform((wide, high), kind, data, smooth)
    else:
        mask = Image.new("L", (wide, high), 0)
        ImageDraw.Draw(mask).polygon([(u - left, v - top) for u, v in outline], fill=255)
    canvas.paste(patch, (left, top), mask)
