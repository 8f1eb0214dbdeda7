"""Pairs made here with known flow, and the texture they are made of."""

from __future__ import annotations

import cv2
import numpy as np


def texture(width=640, height=480, seed=1):
    """Return blobs of several sizes: plenty of key points, and corners that Lucas-Kanade holds on to."""
    rng = np.random.default_rng(seed)
    image = np.zeros((height, width))
    for sigma in (2.0, 5.0, 12.0):
        layer = cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), sigma)
        image += layer / layer.std()
    return np.clip(110 + 28 * image, 0, 255).astype(np.uint8)


def zoomed(image, scale, about):
    """Return the image magnified about a point: what a camera sees that comes nearer to a plane met squarely."""
    x, y = about
    matrix = np.array([[scale, 0, (1 - scale) * x], [0, scale, (1 - scale) * y]])
    return cv2.warpAffine(
        image, matrix, image.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
    )


def approach():
    """A square wall, nearer by 4 %: flow is 0.04 of the distance from (320, 240)."""
    image = texture()
    return image, zoomed(image, 1.04, (320.0, 240.0))


def window():
    """A near plane with an opening right of the middle, through which a far one is seen, with floor lines in it."""
    near, far = texture(seed=2), texture(seed=3)
    for slope in (-0.75, -0.6, -0.5, 0.5, 0.6, 0.75):
        cv2.line(far, (430, 230), (round(430 + slope * 250), 480), 255, 2, cv2.LINE_AA)
    hole = np.zeros_like(near)
    cv2.rectangle(hole, (330, 60), (560, 420), 255, cv2.FILLED)

    def seen(near_scale, far_scale):
        mask = zoomed(hole, near_scale, (320.0, 240.0)) > 127
        return np.where(
            mask, zoomed(far, far_scale, (320.0, 240.0)), zoomed(near, near_scale, (320.0, 240.0))
        )

    return seen(1.0, 1.0), seen(1.18, 1.015)
