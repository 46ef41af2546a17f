"""Objects composed of primitives: parts with materials, in one coordinate frame and of unit size."""

from collections.abc import Callable

import numpy as np

from zsp_lite.synthetic.meshes import TexturedMesh, smooth_normals
from zsp_lite.synthetic.primitives import Mesh, joined, surface_spread


class Assembly:
    """Collects the parts of one object, and draws the random numbers that its builder asks for.

    With `variation`, every proportion (`u`) is perturbed by normal noise from that source, with a standard deviation of
    30 % of its range, while the choices between parts (`chance`, `choice`) stay.
    """

    def __init__(self, rng: np.random.Generator, variation: np.random.Generator | None = None):
        self.rng, self._variation = rng, variation
        self.meshes: list[Mesh] = []
        self.materials: list[int] = []  # of each mesh

    def u(self, low: float, high: float) -> float:
        """Draw a proportion uniformly from [low, high)."""
        value = float(self.rng.uniform(low, high))
        if self._variation is not None:
            value = float(np.clip(value + self._variation.normal(0, 0.3) * (high - low), low, high))
        return value

    def chance(self, probability: float) -> bool:
        """Draw True with the given probability."""
        return bool(self.rng.random() < probability)

    def choice(self, n: int) -> int:
        """Draw uniformly from 0 .. n - 1."""
        return int(self.rng.integers(n))

    def add(self, mesh: Mesh, material: int, mirror: bool = False) -> None:
        """Add a part of material 0 .. 7; with `mirror`, also its mirror image in the plane y = 0."""
        self.meshes.append(mesh)
        self.materials.append(material)
        if mirror:
            self.add(mesh.mirrored(), material)


Builder = Callable[[Assembly], None]  # adds the parts of one random object of a category


def make_shape(build: Builder, seed: int | list[int], variation: np.random.Generator | None = None) -> TexturedMesh:
    """Return the object that `build` composes, with other proportions if `variation` is given (see `Assembly`).

    Its bounding box is centred at the origin, its `surface_spread` is 1, and its materials are not drawn yet. Vertex i
    stays the same point of the same part, if the parts depend on the builder's choices only.
    """
    assembly = Assembly(np.random.default_rng(seed), variation)
    build(assembly)
    vertices, faces = joined(assembly.meshes)
    material = np.repeat(assembly.materials, [len(mesh.faces) for mesh in assembly.meshes])
    vertices = vertices * np.exp(assembly.rng.normal(0, 0.08, 3))  # a small random scale along each axis
    vertices = vertices - (vertices.max(0) + vertices.min(0)) / 2
    vertices, n = vertices / surface_spread(vertices, faces), len(faces)
    uv, white = np.zeros((n, 3, 2), np.float32), np.ones((n, 3, 3), np.float32)
    return TexturedMesh(vertices, faces, smooth_normals(vertices, faces), uv, white, material)
