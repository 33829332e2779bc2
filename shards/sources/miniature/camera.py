"""The camera of a drawn street, and flat surfaces seen through it in true perspective.

World axes of a place, in metres: x to the right along the street, y up, z away from the camera.
Invariant: a surface is one plane, so its picture is one homography; nothing behind the camera is ever drawn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

Array = NDArray[np.float64]
NEAR = 0.4  # metres


@dataclass(frozen=True)
class Camera:
    """A pinhole with a shifted lens (verticals stay vertical) and a little roll.

    Args:
        x, y, z: position in metres.
        yaw: heading from +z towards +x, in radians; roll: in radians.
        focal: in pixels; horizon: its row in pixels; width, height: of the canvas in pixels.
    """

    x: float
    y: float
    z: float
    yaw: float
    focal: float
    horizon: float
    roll: float
    width: int
    height: int

    @cached_property
    def place(self) -> Array:
        return np.array([self.x, self.y, self.z])

    @cached_property
    def matrix(self) -> Array:
        """[3, 3] world directions to homogeneous pixels."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        turn = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
        lens = np.array(
            [[self.focal, 0.0, self.width / 2], [0.0, -self.focal, self.horizon], [0.0, 0.0, 1.0]], dtype=np.float64
        )
        a, b, u, v = math.cos(self.roll), math.sin(self.roll), self.width / 2, self.height / 2
        tilt = np.array([[a, -b, u - a * u + b * v], [b, a, v - b * u - a * v], [0.0, 0.0, 1.0]])
        return np.asarray(tilt @ lens @ turn)

    def polygon(self, points: Array) -> list[tuple[float, float]]:
        """Pixels of a convex polygon [n, 3], cut at the near plane; under 3 points when it is out of sight."""
        rows = ((points - self.place) @ self.matrix.T).tolist()
        kept: list[tuple[float, float, float]] = []
        for (x0, y0, w0), (x1, y1, w1) in zip(rows, rows[1:] + rows[:1], strict=True):
            if w0 >= NEAR:
                kept.append((x0, y0, w0))
            if (w0 >= NEAR) != (w1 >= NEAR):
                t = (NEAR - w0) / (w1 - w0)
                kept.append((x0 + t * (x1 - x0), y0 + t * (y1 - y0), NEAR))
        pixels = [(x / w, y / w) for x, y, w in kept]
        us, vs = [p[0] for p in pixels], [p[1] for p in pixels]
        if len(pixels) < 3 or max(us) <= 0 or min(us) >= self.width or max(vs) <= 0 or min(vs) >= self.height:
            return []
        return pixels

    def depth(self, x: float, z: float) -> float:
        """Metres along the optical axis."""
        return math.sin(self.yaw) * (x - self.x) + math.cos(self.yaw) * (z - self.z)


@dataclass(frozen=True)
class Surface:
    """A rectangle in the world: its top left corner, and its edges to the right and down, in metres."""

    corner: tuple[float, float, float]
    right: tuple[float, float, float]
    down: tuple[float, float, float]

    @cached_property
    def corners(self) -> Array:
        """[4, 3], clockwise from the top left as its front is seen."""
        o, r, d = np.array(self.corner), np.array(self.right), np.array(self.down)
        return np.stack([o, o + r, o + r + d, o + d])

    @cached_property
    def normal(self) -> Array:
        """Unit vector towards the side from which it is seen."""
        (a, b, c), (d, e, f) = self.right, self.down
        n = np.array([b * f - c * e, c * d - a * f, a * e - b * d])
        return np.asarray(n / math.sqrt(float(n @ n)))

    def faces(self, camera: Camera) -> bool:
        x, y, z = self.normal.tolist()
        u, v, w = self.corner
        return bool(x * (camera.x - u) + y * (camera.y - v) + z * (camera.z - w) > 0.01)


def lay(canvas: Image.Image, camera: Camera, surface: Surface, picture: Image.Image, alpha: Image.Image | None) -> None:
    """Draws `picture` (RGB), cut out by `alpha` (L, same size) where given, on the surface as the camera sees it."""
    outline = camera.polygon(surface.corners)
    if not outline:
        return
    us, vs = [p[0] for p in outline], [p[1] for p in outline]
    left, top = max(math.floor(min(us)), 0), max(math.floor(min(vs)), 0)
    wide, high = min(math.ceil(max(us)), camera.width) - left, min(math.ceil(max(vs)), camera.height) - top
    if wide < 1 or high < 1:
        return
    width, height = picture.size
    right, down = np.array(surface.right) / (width - 2), np.array(surface.down) / (height - 2)
    start = np.array(surface.corner) - right - down  # one pixel of margin keeps the border's colour at the edges
    forward = camera.matrix @ np.stack([right, down, start - camera.place], axis=1)
    forward = np.array([[1.0, 0.0, -left], [0.0, 1.0, -top], [0.0, 0.0, 1.0]]) @ forward
    back = np.linalg.inv(forward)
    # texture pixels for a canvas pixel in the middle of the outline: shrink first what would alias
    u, v = sum(us) / len(us) - left, sum(vs) / len(vs) - top
    s, t, w = back @ np.array([u, v, 1.0])
    shrink_x = min(max(int(abs(back[0, 0] - s / w * back[2, 0]) / abs(w) + 0.25), 1), max(width // 4, 1))
    shrink_y = min(max(int(abs(back[1, 1] - t / w * back[2, 1]) / abs(w) + 0.25), 1), max(height // 4, 1))
    if shrink_x > 1 or shrink_y > 1:
        picture = picture.reduce((shrink_x, shrink_y))
        alpha = alpha.reduce((shrink_x, shrink_y)) if alpha is not None else None
        back = np.diag([1 / shrink_x, 1 / shrink_y, 1.0]) @ back
    scale = back[2, 2] if abs(back[2, 2]) > 1e-12 else 1e-12
    data = tuple((back / scale).ravel()[:8].tolist())
    kind, smooth = Image.Transform.PERSPECTIVE, Image.Resampling.BILINEAR
    patch = picture.transform((wide, high), kind, data, smooth)
    if alpha is not None:
        mask = alpha.transform((wide, high), kind, data, smooth)
    else:
        mask = Image.new("L", (wide, high), 0)
        ImageDraw.Draw(mask).polygon([(x - left, y - top) for x, y in outline], fill=255)
    canvas.paste(patch, (left, top), mask)
