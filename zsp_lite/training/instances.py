"""The instances of an object that its training views show: variants of a procedural object, or models from files.

The differences between the instances are what the features are to ignore. Each instance carries coordinates in which
the points of different instances correspond.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from zsp_lite.synthetic.assembly import Shape, deform, make_shape, make_variant
from zsp_lite.synthetic.materials import random_materials, with_materials
from zsp_lite.synthetic.meshes import Material, TexturedMesh
from zsp_lite.synthetic.models import Model, list_models
from zsp_lite.synthetic.training_categories import TRAINING, random_assembly

_PLAIN = 0.2  # probability that a model gets random materials instead of its own
_OTHER = 0.5  # probability that the two instances of a model are two models of its category
# Categories whose models have no front in common.
_MIXED = frozenset(
    "appliance bathroom_fitting box clothes food hifi kitchen_device kitchenware misc plant playground rock shower "
    "sports stairs tableware tool tree vessel".split()
)
_MOST_UNLIKE = 1.6  # largest ratio of the sides of the bounding boxes of two models that are compared


@dataclass(frozen=True, eq=False)
class Instance:
    """A mesh to render, and the object coordinates of its vertices, which correspond between instances."""

    mesh: TexturedMesh
    coordinates: Float[np.ndarray, "v 3"]


class ProceduralInstances:
    """Variants of one procedural object, each with its own proportions, deformation and materials.

    Half of the objects are of the named training categories, half are random assemblies of parts.

    Args:
        seed: Number of the object.
        rng: Source of the draws.
        proportions: Amount by which proportions vary.
        deformation: Amount of the deformation.
    """

    def __init__(self, seed: int, rng: np.random.Generator, proportions: float, deformation: float):
        generators = list(TRAINING.values())
        self.generator = generators[rng.integers(len(generators))] if rng.random() < 0.5 else random_assembly
        self.seed, self.rng, self.proportions, self.deformation = [seed, 1], rng, proportions, deformation
        self.shape = make_shape(self.generator, self.seed)

    def instance(self, view: int) -> Instance:
        """Return a new variant for each view."""
        sibling = make_variant(self.generator, self.seed, self.rng, self.proportions)
        shape, vertices = _altered(self.shape, sibling, self.rng, self.deformation)
        return Instance(with_materials(shape, random_materials(self.rng), vertices), shape.vertices)


class ModelInstances:
    """Two instances of a model from a file: the even views show one of them, the odd views the other.

    They are two deformed copies of one model in other colours, or two models of one category whose bounding boxes have
    similar proportions. Points of two models correspond where their positions in the bounding boxes agree.

    Args:
        models: Folder of models. A category is drawn with a probability that grows with the root of its size.
        rng: Source of the draws.
        deformation: Amount of the deformation.
    """

    def __init__(self, models: Path, rng: np.random.Generator, deformation: float):
        categories = _categories(Path(models))
        weight = np.sqrt([len(category) for category in categories])
        category = categories[rng.choice(len(categories), p=weight / weight.sum())]
        one = category[rng.integers(len(category))]
        other = category[rng.integers(len(category))] if rng.random() < _OTHER else one
        meshes = [one.read(), other.read()]
        extents = [np.maximum(np.ptp(mesh.vertices, axis=0), 1e-6) for mesh in meshes]
        unlike = np.exp(np.abs(np.log(extents[0] / extents[1])).max())
        if one.category in _MIXED or unlike > _MOST_UNLIKE:
            meshes, extents = [meshes[0]] * 2, [extents[0]] * 2
        common = np.sqrt(extents[0] * extents[1])
        self._instances = [
            Instance(altered_copy(mesh, rng, deformation), mesh.vertices / extent * common)
            for mesh, extent in zip(meshes, extents, strict=True)
        ]

    def instance(self, view: int) -> Instance:
        """Return the instance of an even or odd view."""
        return self._instances[view % 2]


def altered_copy(mesh: TexturedMesh, rng: np.random.Generator, deformation: float = 1.0) -> TexturedMesh:
    """Return a deformed copy of a mesh in other colours; vertices correspond.

    Args:
        mesh: The mesh.
        rng: Source of the draws.
        deformation: Amount of the deformation.
    """
    return _deformed(_recoloured(mesh, rng), rng, deformation)


@lru_cache(maxsize=2)
def _categories(folder: Path) -> list[list[Model]]:
    """Return the models of a folder by category."""
    categories: dict[str, list[Model]] = {}
    for model in list_models(folder):
        categories.setdefault(model.category, []).append(model)
    return list(categories.values())


def _deformed(mesh: TexturedMesh, rng: np.random.Generator, amount: float) -> TexturedMesh:
    """Warp and stretch a mesh as one part; the shading normals stay."""
    part = np.zeros(len(mesh.vertices), int)
    return replace(mesh, vertices=deform(Shape(mesh.vertices, mesh.faces, part, mesh.material), rng, amount))


def _recoloured(mesh: TexturedMesh, rng: np.random.Generator) -> TexturedMesh:
    """Change hue, saturation and brightness of all materials alike, or replace the materials by random ones."""
    if rng.random() < _PLAIN:
        given = random_materials(rng)
        materials = tuple(given[index % len(given)] for index in rng.permutation(len(mesh.materials)))
        return replace(mesh, materials=materials, colours=np.ones_like(mesh.colours))
    hue = rng.uniform(-180, 180) if rng.random() < 0.5 else 0.0
    saturation, value = np.exp(rng.normal(0, 0.25, 2))

    def changed(material: Material) -> Material:
        colour = _shift(material.colour[None, None, :3], hue, saturation, value)[0, 0]
        texture = material.texture
        if texture is not None:
            rgb = _shift(texture[..., :3] / np.float32(255), hue, saturation, value)
            texture = np.dstack([np.round(255 * rgb).astype(np.uint8), texture[..., 3]])
            colour = material.colour[:3]
        return replace(material, colour=np.append(colour, material.colour[3]), texture=texture)

    return replace(mesh, materials=tuple(map(changed, mesh.materials)))


def _shift(rgb: np.ndarray, hue: float, saturation: float, value: float) -> np.ndarray:
    """Add to the hue (degrees) of an RGB image in [0, 1], and multiply its saturation and value."""
    h, s, v = cv2.split(cv2.cvtColor(rgb.astype(np.float32), cv2.COLOR_RGB2HSV))
    hsv = cv2.merge(
        [(h + np.float32(hue)) % 360, np.minimum(s * np.float32(saturation), 1), np.minimum(v * np.float32(value), 1)]
    )
    return cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)


def _altered(
    shape: Shape, sibling: Shape, rng: np.random.Generator, deformation: float
) -> tuple[Shape, Float[np.ndarray, "v 3"]]:
    """Return `shape` without some of its parts, and the vertices of its deformed `sibling`."""
    if not np.array_equal(shape.faces, sibling.faces):
        raise ValueError("the variant of an object has other parts than the object")
    vertices = deform(sibling, rng, deformation)
    part = shape.part[shape.faces[:, 0]]
    size = np.bincount(part)
    gone = (rng.random(len(size)) < 0.06) & (size < 0.3 * len(part))
    kept = ~gone[part]
    return replace(shape, faces=shape.faces[kept], material=shape.material[kept]), vertices
