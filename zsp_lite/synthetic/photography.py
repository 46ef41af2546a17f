"""Simulation of a cheap camera: conversion of linear radiance to an 8-bit image."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from zsp_lite.synthetic.textures import linear_to_srgb


@dataclass(frozen=True, eq=False)
class CheapCamera:
    """Response of a camera: from linear radiance to 8-bit sRGB. Blurs are in pixels of an image of 256 pixels."""

    exposure: float = 0.2  # mean luminance after automatic exposure, with 1 for white
    white_balance: tuple[float, float, float] = (
        1.0,
        1.0,
        1.0,
    )  # remaining factor of each channel after automatic balance
    noise: float = 0.01  # standard deviation at mid-grey, relative to white; shot noise and read noise
    blur: float = 0.4  # standard deviation of the lens' point spread
    vignetting: float = 0.1  # loss of light in the corners, as a fraction
    defocus: float = 1.0  # blur of the background

    def exposure_gain(self, radiance: Float[np.ndarray, "h w 3"]) -> float:
        """Return the factor of automatic exposure, from mean and median, which limits the effect of bright windows."""
        luminance = radiance @ np.float32([0.2126, 0.7152, 0.0722])
        measured = 0.5 * np.median(luminance) + 0.5 * np.minimum(luminance, 4 * np.median(luminance)).mean()
        return float(self.exposure / max(measured, 1e-6))

    def develop(
        self, radiance: Float[np.ndarray, "h w 3"], gain: float, rng: np.random.Generator
    ) -> UInt8[np.ndarray, "h w 3"]:
        """Return the 8-bit picture of linear radiance; `gain` is that of `exposure_gain`."""
        h, w = radiance.shape[:2]
        scale = min(h, w) / 256
        y, x = np.linspace(-1, 1, h, dtype=np.float32)[:, None], np.linspace(-1, 1, w, dtype=np.float32)
        falloff = 1 - self.vignetting * (x**2 + y**2) / 2
        image = radiance.astype(np.float32) * (gain * falloff)[..., None] * np.float32(self.white_balance)
        image = _blur(image, self.blur * scale)
        noise = rng.standard_normal((h, w, 3), np.float32) * 0.7 + rng.standard_normal((h, w, 1), np.float32) * 0.7
        noise = _blur(noise, 0.5 * scale) * (1 + 0.6 * scale)  # smoothed by demosaicing and noise reduction
        image = np.maximum(image + noise * self.noise * np.sqrt(np.maximum(image, 0) * 0.16 + 0.006), 0)
        image = _tone_curve(image)
        image = image + 0.35 * (image - _blur(image, 0.9 * scale))  # sharpening of the camera
        return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)


def _blur(image: np.ndarray, sigma: float) -> np.ndarray:
    if sigma < 0.1:
        return image
    blurred = cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REFLECT)
    return blurred.reshape(image.shape)


def _tone_curve(x: np.ndarray) -> np.ndarray:
    """Return sRGB values of linear ones by a filmic curve (Narkowicz's fit to ACES)."""
    x = x * 0.9
    return linear_to_srgb(np.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0, 1))
