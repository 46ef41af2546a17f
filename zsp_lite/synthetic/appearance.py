"""Random appearance of a rendering: materials with textures, light, background and sensor noise."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from zsp_lite.synthetic.assembly import N_MATERIALS


@dataclass(frozen=True)
class Appearance:
    """Appearance of one rendering, with `m` materials.

    Colours are RGB in [0, 1]. A texture mixes the two colours of a material by a sine pattern over the canonical
    coordinates. `light` is the unit vector towards the light source. The background consists of a ground plane and
    a wall, each with two colours. `noise` is the standard deviation of the pixel noise, `gain` a factor per channel.
    """

    colour: Float[np.ndarray, "m 3"]
    second_colour: Float[np.ndarray, "m 3"]
    texture_amount: Float[np.ndarray, " m"]
    texture_wave: Float[np.ndarray, "m 3"]
    texture_warp: Float[np.ndarray, "m 3"]
    texture_warp_amount: Float[np.ndarray, " m"]
    texture_sharpness: Float[np.ndarray, " m"]
    light: Float[np.ndarray, "3"]
    ambient: float
    diffuse: float
    specular: float
    ground_colours: Float[np.ndarray, "2 3"]
    wall_colours: Float[np.ndarray, "2 3"]
    ground_waves: Float[np.ndarray, "3 3"]
    wall_waves: Float[np.ndarray, "3 3"]
    has_ground: bool
    noise: float
    gain: Float[np.ndarray, "3"]


def _colour(rng: np.random.Generator) -> np.ndarray:
    """Draw an RGB colour (3,) in [0, 1] by hue, saturation and value."""
    hue, saturation, value = rng.random(), rng.beta(1.2, 2.0), rng.uniform(0.25, 1)
    k = (np.array([5, 3, 1]) + hue * 6) % 6
    return value - value * saturation * np.clip(np.minimum(k, 4 - k), 0, 1)


def random_appearance(seed: int | np.random.Generator) -> Appearance:
    """Draw an appearance, independent of the category and the shape of the object."""
    rng = np.random.default_rng(seed)
    n = N_MATERIALS
    ground, wall = _colour(rng), _colour(rng)
    light = np.array([rng.normal(), rng.normal(), rng.uniform(0.6, 2.5)])
    return Appearance(
        colour=np.array([_colour(rng) for _ in range(n)]),
        second_colour=np.array([_colour(rng) for _ in range(n)]),
        texture_amount=np.where(rng.random(n) < 0.3, rng.uniform(0.15, 0.5, n), rng.uniform(0, 0.1, n)),
        texture_wave=rng.normal(0, 1, (n, 3)) * rng.uniform(2, 9, (n, 1)),
        texture_warp=rng.normal(0, 1, (n, 3)) * rng.uniform(1, 7, (n, 1)),
        texture_warp_amount=rng.uniform(0, 2.5, n),
        texture_sharpness=rng.choice([1.0, 1.0, 6.0], n),
        light=light / np.linalg.norm(light),
        ambient=rng.uniform(0.25, 0.55),
        diffuse=rng.uniform(0.5, 0.85),
        specular=rng.uniform(0, 0.35),
        ground_colours=np.stack([ground, 0.65 * ground + 0.35 * _colour(rng)]),
        wall_colours=np.stack([wall, 0.6 * wall + 0.4 * _colour(rng)]),
        ground_waves=rng.normal(0, 1, (3, 3)) * [[0.5], [1.2], [3.0]],
        wall_waves=rng.normal(0, 1, (3, 3)) * [[0.7], [2.0], [4.0]],
        has_ground=bool(rng.random() < 0.8),
        noise=rng.uniform(0, 0.03),
        gain=rng.uniform(0.85, 1.15, 3),
    )


def surface_albedo(
    appearance: Appearance, canonical: Float[np.ndarray, "n 3"], material: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """Return the albedo of surface points from their canonical coordinates and the indices of their materials."""
    phase = (canonical * appearance.texture_wave[material]).sum(1)
    phase += appearance.texture_warp_amount[material] * np.sin((canonical * appearance.texture_warp[material]).sum(1))
    pattern = 0.5 + 0.5 * np.clip(np.sin(phase) * appearance.texture_sharpness[material], -1, 1)
    share = (pattern * appearance.texture_amount[material])[:, None]
    return appearance.colour[material] * (1 - share) + appearance.second_colour[material] * share


def background_colour(
    points: Float[np.ndarray, "n 3"], waves: Float[np.ndarray, "3 3"], colours: Float[np.ndarray, "2 3"]
) -> Float[np.ndarray, "n 3"]:
    """Return the colours of background points: a smooth, irregular pattern of two colours."""
    first = points @ waves[0]
    pattern = np.sin(first + 1.3) + 0.6 * np.sin(points @ waves[1] + 1.5 * np.sin(first))
    pattern += 0.4 * np.sin(points @ waves[2] + 2 * np.sin(points @ waves[1]))
    share = np.clip(0.5 + 0.25 * pattern, 0, 1)[:, None]
    return colours[0] * (1 - share) + colours[1] * share
