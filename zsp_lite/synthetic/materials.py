"""Random materials of procedural objects, drawn independently of their category and of their shape."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from zsp_lite.synthetic.meshes import Material
from zsp_lite.synthetic.textures import hsv


class _Kind(NamedTuple):
    share: float  # of all materials
    hue: tuple[float, float]  # degrees
    saturation: tuple[float, float]
    value: tuple[float, float]
    roughness: tuple[float, float]
    specular: float = 0.04
    waves: tuple[int, ...] = (5,)  # numbers of waves of the pattern: 1 for stripes, 2 for checks, more for patches
    frequency: tuple[float, float] = (2, 8)  # of the pattern, in radians per unit
    contrast: tuple[float, float] = (0.05, 0.2)  # of the pattern


_ANY = (0, 360)
_KINDS = (
    _Kind(0.22, _ANY, (0, 0.8), (0.25, 0.95), (0.35, 0.75)),  # paint
    _Kind(0.13, _ANY, (0, 0.8), (0.25, 0.95), (0.35, 0.75), 0.04, (1, 2, 5), (3, 14), (0.3, 1)),  # printed paint
    _Kind(0.23, _ANY, (0, 0.9), (0.25, 0.95), (0.15, 0.4), 0.05),  # plastic
    _Kind(0.12, (18, 38), (0.3, 0.65), (0.4, 0.85), (0.4, 0.8), 0.04, (1,), (10, 24), (0.2, 0.4)),  # wood
    _Kind(0.14, _ANY, (0, 0.8), (0.25, 0.95), (0.95, 0.95), 0.02, (3,), (28, 40), (0.15, 0.4)),  # cloth
    _Kind(0.08, (20, 60), (0, 0.3), (0.65, 0.95), (0.2, 0.55), 0.4),  # metal
    _Kind(0.08, _ANY, (0, 0), (0.08, 0.3), (0.7, 0.95)),  # rubber
)


@dataclass(frozen=True, eq=False)
class WavePattern:
    """Two sRGB colours, mixed by k sine waves through the object: stripes, grain, checks, a weave or patches."""

    colours: Float[np.ndarray, "2 3"]
    waves: Float[np.ndarray, "k 3"]  # wave vectors, in radians per unit of object coordinates
    phases: Float[np.ndarray, " k"]
    warp: Float[np.ndarray, "3"]  # wave vector of the displacement that bends all waves
    sharpness: float  # 1 for a sine, more for clear edges

    def __call__(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        bend = np.sin(points @ self.warp)[:, None]
        value = np.sin(points @ self.waves.T + self.phases + bend).mean(1, keepdims=True)
        share = np.clip(0.5 + 0.5 * self.sharpness * value, 0, 1)
        return (self.colours[0] + share * (self.colours[1] - self.colours[0])).astype(np.float32)


def random_materials(seed: int | list[int] | np.random.Generator) -> tuple[Material, ...]:
    """Draw the materials 0 .. 7 of one object."""
    rng = np.random.default_rng(seed)
    kinds = rng.choice(len(_KINDS), 8, p=[kind.share for kind in _KINDS])
    return tuple(_random_material(_KINDS[kind], rng) for kind in kinds)


def _random_material(kind: _Kind, rng: np.random.Generator) -> Material:
    ranges = (kind.hue, kind.saturation, kind.value)
    colour, other = (hsv(*(rng.uniform(*limits) for limits in ranges)) for _ in range(2))
    darker = len(kind.waves) == 1  # a printed pattern has a second colour
    other = colour + rng.uniform(*kind.contrast) * ((0 if darker else other) - colour)
    waves = rng.normal(size=(rng.choice(kind.waves), 3))
    waves *= rng.uniform(*kind.frequency) / np.linalg.norm(waves, axis=1, keepdims=True)
    phases, warp = rng.uniform(0, 2 * np.pi, len(waves)), rng.normal(0, 2, 3)
    pattern = WavePattern(np.stack([colour, other]), waves, phases, warp, float(rng.choice([1.0, 2.0, 6.0])))
    return Material(np.ones(4), pattern=pattern, specular=kind.specular, roughness=rng.uniform(*kind.roughness))
