"""Random materials of procedural objects: paint, plastic, wood, cloth, metal and rubber.

They are drawn independently of the category and of the shape of the object.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from zsp_lite.synthetic.assembly import N_MATERIALS, Shape
from zsp_lite.synthetic.meshes import Material, TexturedMesh, smooth_normals
from zsp_lite.synthetic.textures import hsv


@dataclass(frozen=True, eq=False)
class WavePattern:
    """Two sRGB colours, mixed by k sine waves through the object: stripes, grain, checks, a weave or patches.

    Wave vectors are in radians per unit of object coordinates. `warp` is the wave vector of the displacement that bends
    all waves, `warp_amount` its amplitude in radians. A sharpness of 1 is a sine.
    """

    colours: Float[np.ndarray, "2 3"]
    waves: Float[np.ndarray, "k 3"]
    phases: Float[np.ndarray, " k"]
    warp: Float[np.ndarray, "3"]
    warp_amount: float
    sharpness: float

    def __call__(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        points = points.astype(np.float32)
        bend = self.warp_amount * np.sin(points @ self.warp.astype(np.float32))
        value = np.sin(points @ self.waves.T.astype(np.float32) + self.phases.astype(np.float32) + bend[:, None])
        share = np.clip(0.5 + 0.5 * self.sharpness * value.mean(1), 0, 1)[:, None]
        return (self.colours[0] + share * (self.colours[1] - self.colours[0])).astype(np.float32)


def random_materials(seed: int | list[int] | np.random.Generator) -> tuple[Material, ...]:
    """Draw the materials of one object."""
    rng = np.random.default_rng(seed)
    return tuple(_KINDS[kind](rng) for kind in rng.choice(len(_KINDS), N_MATERIALS, p=_SHARES))


def with_materials(
    shape: Shape, materials: tuple[Material, ...], vertices: Float[np.ndarray, "v 3"] | None = None
) -> TexturedMesh:
    """Return the mesh of a shape with materials; `vertices` replaces those of the shape, for a deformed copy."""
    vertices, n = shape.vertices if vertices is None else vertices, len(shape.faces)
    uv, white = np.zeros((n, 3, 2), np.float32), np.ones((n, 3, 3), np.float32)
    return TexturedMesh(
        vertices, shape.faces, smooth_normals(vertices, shape.faces), uv, white, shape.material, materials
    )


def _colour(rng: np.random.Generator) -> np.ndarray:
    """Draw an sRGB colour; pale and greyish ones are more frequent."""
    return hsv(rng.uniform(0, 360), rng.beta(1.2, 2.0), rng.uniform(0.25, 0.95))


def _pattern(
    rng: np.random.Generator, colour: np.ndarray, other: np.ndarray, count: int, frequency: float, sharpness: float
) -> WavePattern:
    """Draw a pattern of waves in random directions with about the same frequency, in radians per unit."""
    waves = rng.normal(size=(count, 3))
    waves *= frequency / np.linalg.norm(waves, axis=1, keepdims=True)
    warp, phases = rng.normal(0, 2.0, 3), rng.uniform(0, 2 * np.pi, count)
    return WavePattern(np.stack([colour, other]), waves, phases, warp, rng.uniform(0, 2.5), sharpness)


def _decorated(rng: np.random.Generator, roughness: float, specular: float) -> Material:
    """Draw a coloured surface, sometimes printed with stripes, checks or patches, and worn unevenly."""
    colour = _colour(rng)
    if rng.random() < 0.3:
        mixed = colour + rng.uniform(0.3, 1.0) * (_colour(rng) - colour)
        count, sharpness = int(rng.choice([1, 2, 5])), float(rng.choice([1.0, 6.0]))
        pattern = _pattern(rng, colour, mixed, count, rng.uniform(3, 14), sharpness)
    else:
        pattern = _pattern(rng, colour, colour * rng.uniform(0.82, 1.0), 5, rng.uniform(2, 8), 2.0)
    return Material(np.ones(4), pattern=pattern, specular=specular, roughness=roughness)


def _paint(rng: np.random.Generator) -> Material:
    return _decorated(rng, rng.uniform(0.35, 0.75), 0.04)


def _plastic(rng: np.random.Generator) -> Material:
    return _decorated(rng, rng.uniform(0.15, 0.4), 0.05)


def _wood(rng: np.random.Generator) -> Material:
    light = hsv(rng.uniform(18, 38), rng.uniform(0.3, 0.65), rng.uniform(0.4, 0.85))
    grain = WavePattern(
        np.stack([light, light * rng.uniform(0.65, 0.85) * np.array([1, 0.93, 0.85])]),
        rng.normal(size=(1, 3)) * rng.uniform(6, 14),
        rng.uniform(0, 2 * np.pi, 1),
        rng.normal(0, 1.5, 3),
        rng.uniform(0.5, 2),
        1.0,
    )
    return Material(np.ones(4), pattern=grain, roughness=rng.uniform(0.4, 0.8))


def _cloth(rng: np.random.Generator) -> Material:
    colour = _colour(rng)
    weave = _pattern(rng, colour, colour * rng.uniform(0.7, 0.9), 3, rng.uniform(28, 40), 1.5)
    return Material(np.ones(4), pattern=weave, specular=0.02, roughness=0.95)


def _metal(rng: np.random.Generator) -> Material:
    colour = hsv(rng.uniform(20, 60), rng.uniform(0, 0.3), rng.uniform(0.65, 0.95))
    return Material(np.append(colour, 1.0), specular=0.4, roughness=rng.uniform(0.2, 0.55))


def _rubber(rng: np.random.Generator) -> Material:
    return Material(np.append(np.full(3, rng.uniform(0.08, 0.3)), 1.0), roughness=rng.uniform(0.7, 0.95))


_KINDS = (_paint, _plastic, _wood, _cloth, _metal, _rubber)
_SHARES = (0.35, 0.23, 0.12, 0.14, 0.08, 0.08)
