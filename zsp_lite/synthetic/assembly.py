"""Objects as assemblies of primitives: parts with materials, one canonical frame, unit size."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from zsp_lite.synthetic.primitives import Mesh

N_MATERIALS = 8


@dataclass(frozen=True)
class Shape:
    """One object: a mesh whose vertices know their part and whose faces know their material.

    Vertices are centred on the bounding box and scaled so that the surface has unit standard deviation, averaged
    over the three axes (CO3D's convention for point clouds).
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    part: Int[np.ndarray, " v"]
    material: Int[np.ndarray, " f"]


class Assembly:
    """Collects the parts of one object; generators draw every proportion from its random generator.

    With `variation` every proportion moves from its draw by a normal deviate of `amount` of its range, while the
    choices between parts stay: another object of the same build.
    """

    def __init__(self, rng: np.random.Generator, variation: np.random.Generator | None = None, amount: float = 0.3):
        self.rng = rng
        self._variation, self._amount = variation, amount
        self._meshes: list[Mesh] = []
        self._materials: list[int] = []

    def u(self, low: float, high: float) -> float:
        """A uniform draw from [low, high)."""
        value = float(self.rng.uniform(low, high))
        if self._variation is not None:
            low, high = min(low, high), max(low, high)
            value = float(np.clip(value + self._variation.normal(0, self._amount) * (high - low), low, high))
        return value

    def chance(self, probability: float) -> bool:
        """True with the given probability."""
        return bool(self.rng.random() < probability)

    def pick(self, n: int) -> int:
        """A uniform draw from 0 .. n - 1."""
        return int(self.rng.integers(n))

    def add(self, mesh: Mesh, material: int, mirror: bool = False) -> None:
        """Add a part made of one of the object's materials (0 .. 7), and its mirror image in y = 0 if asked."""
        self._meshes.append(mesh)
        self._materials.append(material)
        if mirror:
            self.add(mesh.mirrored(), material)

    def shape(self) -> Shape:
        """The finished object, stretched a little along each axis as instances of a category are."""
        counts = [len(m.vertices) for m in self._meshes]
        starts = np.cumsum([0, *counts[:-1]])
        vertices = np.concatenate([m.vertices for m in self._meshes])
        faces = np.concatenate([m.faces + s for m, s in zip(self._meshes, starts, strict=True)])
        part = np.repeat(np.arange(len(counts)), counts)
        material = np.repeat(self._materials, [len(m.faces) for m in self._meshes])
        vertices = vertices * np.exp(self.rng.normal(0, 0.08, 3))
        vertices = vertices - (vertices.max(0) + vertices.min(0)) / 2
        return Shape(vertices / surface_spread(vertices, faces), faces, part, material)


def surface_spread(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> float:
    """Standard deviation of the surface, averaged over the three axes, in the unit of the vertices."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)[:, None]
    middle = (a + b + c) / 3
    mean = (middle * area).sum(0) / area.sum()
    return float(np.sqrt(((middle - mean) ** 2 * area).sum(0) / area.sum()).mean())


def make_shape(generator: Callable[[Assembly], None], seed: int | list[int]) -> Shape:
    """The object that `generator` builds from `seed`; the same seed gives the same object."""
    assembly = Assembly(np.random.default_rng(seed))
    generator(assembly)
    return assembly.shape()


def make_sibling(
    generator: Callable[[Assembly], None], seed: int | list[int], variation: np.random.Generator, amount: float = 0.3
) -> Shape:
    """The object that `generator` builds from `seed` with other proportions: the same parts in the same order.

    As long as the generator takes only choices, not proportions, to decide which parts there are, vertex i is the
    same place on all siblings: correspondence between objects that differ as instances of a category do.
    """
    assembly = Assembly(np.random.default_rng(seed), variation, amount)
    generator(assembly)
    return assembly.shape()


def deform(shape: Shape, seed: int | np.random.Generator, amount: float = 1.0) -> Float[np.ndarray, "v 3"]:
    """Vertices of a gently altered copy: parts scaled, the whole warped and stretched.

    A vertex keeps its index, so surface correspondence between the copies of one object stays known. This is the
    shape augmentation of the training; it needs no second instance.
    """
    rng = np.random.default_rng(seed)
    n_parts = shape.part.max() + 1
    size = np.bincount(shape.part, minlength=n_parts)
    centre = np.stack([np.bincount(shape.part, axis, n_parts) for axis in shape.vertices.T], 1) / size[:, None]
    stretch = np.exp(rng.normal(0, 0.12 * amount, (n_parts, 3)))
    vertices = (shape.vertices - centre[shape.part]) * stretch[shape.part] + centre[shape.part]
    for axis in range(3):
        wave = rng.normal(0, 0.7, 3)
        vertices[:, axis] += 0.12 * amount * np.sin(shape.vertices @ wave + rng.uniform(0, 2 * np.pi))
    return vertices * np.exp(rng.normal(0, 0.13 * amount, 3))
