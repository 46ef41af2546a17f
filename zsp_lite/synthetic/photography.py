"""Simulation of a cheap camera: conversion of linear radiance to an 8-bit image."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from zsp_lite.synthetic.textures import linear_to_srgb


@dataclass(frozen=True, eq=False)
class CheapCamera:
    """Response of a camera: from linear radiance to 8-bit sRGB."""

    exposure: float = 0.2  # mean luminance after automatic exposure, with 1 for white
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)  # error of automatic balance, a factor per channel
    noise: float = 0.01  # standard deviation at mid-grey, relative to white
    vignetting: float = 0.1  # loss of light in the corners, as a fraction

    def exposure_gain(self, radiance: Float[np.ndarray, "h w 3"]) -> float:
        """Return the factor of automatic exposure, from mean and median, which limits the effect of bright windows."""
        luminance = radiance @ np.float32([0.2126, 0.7152, 0.0722])
        median = np.median(luminance)
        return float(2 * self.exposure / max(median + np.minimum(luminance, 4 * median).mean(), 1e-6))

    def develop(
        self, radiance: Float[np.ndarray, "h w 3"], gain: float, rng: np.random.Generator
    ) -> UInt8[np.ndarray, "h w 3"]:
        """Return the 8-bit picture of linear radiance; `gain` is that of `exposure_gain`."""
        height, width = radiance.shape[:2]
        pixel = min(height, width) / 256  # blurs are those of a picture of 256 pixels
        y, x = np.linspace(-1, 1, height)[:, None], np.linspace(-1, 1, width)
        falloff = 1 - self.vignetting * (x**2 + y**2) / 2
        image = (radiance * (gain * falloff)[..., None] * self.white_balance).astype(np.float32)
        image = _blur(image, 0.4 * pixel)  # of the lens
        noise = _blur(rng.standard_normal((height, width, 3), np.float32), 0.5 * pixel)  # smoothed by demosaicing
        image = np.maximum(image + 1.6 * self.noise * noise * np.sqrt(0.16 * image + 0.006), 0)
        # A filmic tone curve, Narkowicz's fit to ACES.
        image = linear_to_srgb(np.clip(image * (2.26 * image + 0.03) / (image * (2.19 * image + 0.59) + 0.16), 0, 1))
        image += 0.35 * (image - _blur(image, 0.9 * pixel))  # sharpening by the camera
        return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)


def _blur(image: np.ndarray, sigma: float) -> np.ndarray:
    return cv2.GaussianBlur(image, (0, 0), max(sigma, 0.2), borderType=cv2.BORDER_REFLECT)
