"""Small pictures in the HTML representation of objects, as notebooks show them."""

import base64
import html

import cv2
import numpy as np
from jaxtyping import Float, UInt8

_HEIGHT = 128  # pixels
_BORDER = (0.01, 0.99)  # quantiles that are shown black and white


def picture_html(text: str, *images: UInt8[np.ndarray, "_ _ 3"] | Float[np.ndarray, "_ _"]) -> str:
    """Return HTML of images in a row, as inline PNG, above a plain text of any number of lines.

    Maps are shown in grey from their 1st to their 99th percentile.
    """
    tags = []
    for image in images:
        if image.ndim == 2:
            low, high = np.quantile(image, _BORDER)
            image = np.uint8(255 * np.clip((image - low) / max(high - low, 1e-9), 0, 1))[..., None].repeat(3, axis=2)
        width = max(1, round(image.shape[1] * _HEIGHT / image.shape[0]))
        shrinks = image.shape[0] > _HEIGHT
        small = cv2.resize(image, (width, _HEIGHT), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_NEAREST)
        png = cv2.imencode(".png", small[..., ::-1])[1].tobytes()
        tags.append(f'<img src="data:image/png;base64,{base64.b64encode(png).decode()}" style="margin-right: 4px">')
    return f"<div>{''.join(tags)}</div><pre>{html.escape(text)}</pre>"
