"""The camera: where a pixel looks, and where a ray falls in the image.

Pinhole with the distortion polynomial that OpenCV and ROS calibrations use, or a field of view alone.
Rays are in the camera frame: x right, y down, z forward. Pixel centres have whole coordinates, so the image
reaches from -0.5 to width - 0.5 (the convention of OpenCV).
"""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

_DISTORTION_LENGTHS: Final = (0, 4, 5, 8)
_MIN_SIDE_PX: Final = 16
_MAX_SIDE_PX: Final = 16384
_MAX_HFOV_DEG: Final = 170.0  # beyond this a pinhole image is mostly stretched border
_NEWTON_STEPS: Final = 30
_NEWTON_TOLERANCE: Final = 1e-12  # in units of the focal length
_FOLD_SEARCH_RADIUS: Final = 12.0  # tan of 85 degrees, the widest half field of view allowed

_INTRINSIC_KEYS: Final = ("fx_px", "fy_px", "cx_px", "cy_px")
_ALL_KEYS: Final = ("width_px", "height_px", *_INTRINSIC_KEYS, "distortion", "hfov_deg")


class CameraError(ValueError):
    """A camera description cannot be used. From a file, the message names file, key, what was found and what is allowed."""


@dataclass(frozen=True, slots=True)
class CameraModel:
    """Pinhole camera, with distortion if there are coefficients.

    Parameters
    ----------
    width_px, height_px
        Size of the image that the other figures belong to.
    fx_px, fy_px
        Focal lengths.
    cx_px, cy_px
        Principal point; the middle of the image is ((width - 1) / 2, (height - 1) / 2).
    distortion
        OpenCV's coefficients: none, (k1, k2, p1, p2), the same and k3, or the same and (k4, k5, k6).

    Raises
    ------
    CameraError
        When a figure is out of range, or the distortion folds over inside the image (two rays for one pixel).
    """

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for name, side in (("width_px", self.width_px), ("height_px", self.height_px)):
            if not _MIN_SIDE_PX <= side <= _MAX_SIDE_PX:
                raise CameraError(f"{name}: found {side}, allowed {_MIN_SIDE_PX} to {_MAX_SIDE_PX}")
        for name, value, side in (
            ("fx_px", self.fx_px, self.width_px),
            ("fy_px", self.fy_px, self.height_px),
        ):
            least, most = 0.04 * side, 50.0 * side
            if not least <= value <= most:
                raise CameraError(
                    f"{name}: found {value}, allowed {least:g} to {most:g} for a side of {side} px"
                )
        for name, value, side in (
            ("cx_px", self.cx_px, self.width_px),
            ("cy_px", self.cy_px, self.height_px),
        ):
            if not 0.0 <= value <= side - 1:
                raise CameraError(f"{name}: found {value}, allowed 0 to {side - 1} (inside the image)")
        if len(self.distortion) not in _DISTORTION_LENGTHS:
            raise CameraError(
                f"distortion: found {len(self.distortion)} coefficients, allowed none, 4 (k1 k2 p1 p2), 5 (and k3) or 8 (and k4 k5 k6)"
            )
        if not all(math.isfinite(value) for value in self.distortion):
            raise CameraError(f"distortion: found {list(self.distortion)}, allowed finite numbers")
        if self.is_distorted and not np.isfinite(self.pixel_to_ray(self._border_px())).all():
            raise CameraError(
                f"distortion: found {list(self.distortion)}, which folds over inside the image; "
                "allowed are coefficients that give every pixel one ray: calibrate again with points near the corners"
            )

    @classmethod
    def from_hfov(cls, width_px: int, height_px: int, hfov_deg: float) -> Self:
        """Build a camera of which only the horizontal field of view is known: square pixels, no distortion.

        Parameters
        ----------
        width_px, height_px
            Size of the image.
        hfov_deg
            Angle between the left and the right border of the image.
        """
        if not 1.0 <= hfov_deg <= _MAX_HFOV_DEG:
            raise CameraError(f"hfov_deg: found {hfov_deg}, allowed 1 to {_MAX_HFOV_DEG:g}")
        focal_px = 0.5 * width_px / math.tan(0.5 * math.radians(hfov_deg))
        return cls(width_px, height_px, focal_px, focal_px, 0.5 * (width_px - 1), 0.5 * (height_px - 1))

    @classmethod
    def from_file(cls, path: Path | str) -> Self:
        """Read a camera file (TOML; its keys are described in docs/camera-file.md).

        Parameters
        ----------
        path
            Either ``width_px, height_px, fx_px, fy_px, cx_px, cy_px`` and optionally ``distortion``, or ``width_px, height_px, hfov_deg``.

        Raises
        ------
        CameraError
            When the file is missing, not TOML, or a key is missing, unknown, of the wrong type or out of range.
        """
        path = Path(path)
        try:
            table = tomllib.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise CameraError(f"{path}: cannot be read: {error.strerror or error}") from error
        except UnicodeDecodeError as error:
            raise CameraError(f"{path}: not a text file in UTF-8") from error
        except tomllib.TOMLDecodeError as error:
            raise CameraError(f"{path}: not valid TOML: {error}") from error
        try:
            return cls._from_table(table)
        except CameraError as error:
            raise CameraError(f"{path}: {error}") from error

    @classmethod
    def _from_table(cls, table: dict[str, Any]) -> Self:
        for key in table:
            if key not in _ALL_KEYS:
                raise CameraError(f"{key}: unknown key, allowed {', '.join(_ALL_KEYS)}")
        width_px, height_px = _whole_number(table, "width_px"), _whole_number(table, "height_px")
        if "hfov_deg" in table:
            for key in (*_INTRINSIC_KEYS, "distortion"):
                if key in table:
                    raise CameraError(f"{key}: found beside hfov_deg, allowed one or the other")
            return cls.from_hfov(width_px, height_px, _number(table, "hfov_deg"))
        fx_px, fy_px, cx_px, cy_px = (_number(table, key) for key in _INTRINSIC_KEYS)
        found = table.get("distortion", [])
        if not isinstance(found, list) or not all(_is_number(value) for value in found):
            raise CameraError(f"distortion: found {found!r}, allowed a list of numbers")
        return cls(width_px, height_px, fx_px, fy_px, cx_px, cy_px, tuple(float(value) for value in found))

    @property
    def is_distorted(self) -> bool:
        """Whether any distortion coefficient differs from zero."""
        return any(value != 0.0 for value in self.distortion)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """Camera matrix K, (3, 3): pixel = K ray, without distortion."""
        return np.array(
            [[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]], dtype=np.float64
        )

    @property
    def hfov_rad(self) -> float:
        """Angle between the left and the right border, in the principal point's row."""
        return self._angle_between((-0.5, self.cy_px), (self.width_px - 0.5, self.cy_px))

    @property
    def vfov_rad(self) -> float:
        """Angle between the upper and the lower border, in the principal point's column."""
        return self._angle_between((self.cx_px, -0.5), (self.cx_px, self.height_px - 0.5))

    def pixel_to_ray(self, points_px: ArrayLike) -> NDArray[np.float64]:
        """Give the directions that pixels look in.

        Parameters
        ----------
        points_px
            (N, 2) of x, y; they may lie outside the image.

        Returns
        -------
        (N, 3) unit vectors in the camera frame; NaN where the distortion has no inverse (only possible outside the image).
        """
        points = _checked(points_px, 2)
        normalised = (points - (self.cx_px, self.cy_px)) / (self.fx_px, self.fy_px)
        if self.is_distorted:
            normalised = self._undistort(normalised)
        rays = np.column_stack((normalised, np.ones(len(normalised))))
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        return rays

    def ray_to_pixel(self, rays: ArrayLike) -> NDArray[np.float64]:
        """Give the pixels that directions fall on.

        Parameters
        ----------
        rays
            (N, 3) in the camera frame, of any length.

        Returns
        -------
        (N, 2) of x, y, inside the image or not; NaN where the ray does not point forward, or beyond the angle where the
        distortion polynomial folds back (there it would put things from far outside into the image).
        """
        directions = _checked(rays, 3)
        with np.errstate(divide="ignore", invalid="ignore"):
            forward = directions[:, 2] > 1e-9 * np.linalg.norm(directions, axis=1)
            normalised = np.where(forward[:, None], directions[:, :2] / directions[:, 2:3], np.nan)
        if self.is_distorted:
            normalised[np.sum(normalised**2, axis=1) > _fold_radius(self.distortion) ** 2] = np.nan
            normalised, _ = _distort(normalised, self.distortion)
        return normalised * (self.fx_px, self.fy_px) + (self.cx_px, self.cy_px)

    def scaled_to(self, width_px: int, height_px: int) -> Self:
        """Return the model of the same camera after its image was resized."""
        scale_x, scale_y = width_px / self.width_px, height_px / self.height_px
        return type(self)(
            width_px,
            height_px,
            self.fx_px * scale_x,
            self.fy_px * scale_y,
            (self.cx_px + 0.5) * scale_x - 0.5,
            (self.cy_px + 0.5) * scale_y - 0.5,
            self.distortion,
        )

    def _undistort(self, distorted: NDArray[np.float64]) -> NDArray[np.float64]:
        # Newton's method on the polynomial; the fixed-point iteration that is often used here diverges for wide lenses.
        estimate = distorted.copy()
        fold = _fold_radius(self.distortion)
        with np.errstate(all="ignore"):  # points without an inverse run away and become NaN below
            for _ in range(_NEWTON_STEPS):
                value, jacobian = _distort(estimate, self.distortion)
                residual = value - distorted
                determinant = jacobian[:, 0] * jacobian[:, 3] - jacobian[:, 1] * jacobian[:, 2]
                step_x = (jacobian[:, 3] * residual[:, 0] - jacobian[:, 1] * residual[:, 1]) / determinant
                step_y = (jacobian[:, 0] * residual[:, 1] - jacobian[:, 2] * residual[:, 0]) / determinant
                step = np.column_stack((step_x, step_y))
                # A short leash keeps the iteration on the branch that contains the optical axis.
                length = np.linalg.norm(step, axis=1, keepdims=True)
                step *= np.minimum(1.0, 0.3 / np.maximum(length, 1e-300))
                estimate -= step
                if np.nanmax(length, initial=0.0) < _NEWTON_TOLERANCE:
                    break
            value, _ = _distort(estimate, self.distortion)
            good = (np.abs(value - distorted).max(axis=1) < 1e-9) & (np.sum(estimate**2, axis=1) <= fold**2)
        return np.where(good[:, None], estimate, np.nan)

    def _border_px(self) -> NDArray[np.float64]:
        x = np.linspace(-0.5, self.width_px - 0.5, 17)
        y = np.linspace(-0.5, self.height_px - 0.5, 17)
        top, bottom = np.full_like(x, y[0]), np.full_like(x, y[-1])
        left, right = np.full_like(y, x[0]), np.full_like(y, x[-1])
        return np.column_stack((np.concatenate((x, x, left, right)), np.concatenate((top, bottom, y, y))))

    def _angle_between(self, first_px: tuple[float, float], second_px: tuple[float, float]) -> float:
        first, second = self.pixel_to_ray([first_px, second_px])
        return math.atan2(float(np.linalg.norm(np.cross(first, second))), float(first @ second))


def _distort(
    points: NDArray[np.float64], coefficients: tuple[float, ...]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distort normalised points (N, 2); also the Jacobian, (N, 4) row by row.

    The model is OpenCV's: x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2), y' alike.
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, *([0.0] * (8 - len(coefficients))))
    x, y = points[:, 0], points[:, 1]
    r2 = x * x + y * y
    numerator = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    denominator = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = numerator / denominator
    slope = (
        (k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2)) - radial * (k4 + r2 * (2.0 * k5 + 3.0 * k6 * r2))
    ) / denominator  # d radial / d r2
    distorted = np.column_stack(
        (
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        )
    )
    cross = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
    jacobian = np.column_stack(
        (
            radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
            cross,
            cross,
            radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x,
        )
    )
    return distorted, jacobian


def _fold_radius(coefficients: tuple[float, ...]) -> float:
    """Least normalised radius at which the radial distortion stops growing (infinite where it never does)."""
    k1, k2, _, _, k3, k4, k5, k6 = (*coefficients, *([0.0] * (8 - len(coefficients))))
    # With s = r^2 and radial = a(s) / b(s): d(r a/b)/dr = 0  <=>  a b + 2 s (a' b - a b') = 0.
    a = np.polynomial.Polynomial([1.0, k1, k2, k3])
    b = np.polynomial.Polynomial([1.0, k4, k5, k6])
    s = np.polynomial.Polynomial([0.0, 1.0])
    derivative = (a * b + 2.0 * s * (a.deriv() * b - a * b.deriv())).trim()
    candidates = [
        math.sqrt(root.real)
        for polynomial in (derivative, b.trim())
        for root in np.atleast_1d(polynomial.roots())
        if abs(root.imag) < 1e-9 * max(1.0, abs(root.real)) and root.real > 0.0
    ]
    least = min(candidates, default=math.inf)
    return least if least < _FOLD_SEARCH_RADIUS else math.inf


def _checked(values: ArrayLike, columns: int) -> NDArray[np.float64]:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != columns:
        raise ValueError(f"expected (N, {columns}), got {array.shape}")
    return array


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _number(table: dict[str, Any], key: str) -> float:
    if key not in table:
        raise CameraError(
            f"{key}: missing; needed are width_px, height_px and either hfov_deg or fx_px, fy_px, cx_px, cy_px"
        )
    value = table[key]
    if not _is_number(value) or not math.isfinite(value):
        raise CameraError(f"{key}: found {value!r}, allowed a finite number")
    return float(value)


def _whole_number(table: dict[str, Any], key: str) -> int:
    value = _number(table, key)
    if not isinstance(table[key], int):
        raise CameraError(f"{key}: found {value!r}, allowed a whole number")
    return int(value)
