"""Procedural objects: meshes composed of primitives, parts of several, and random materials."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from zsp_lite.course.synthetic.meshes import Material, TexturedMesh, smooth_normals
from zsp_lite.course.synthetic.primitives import (
    TAU,
    Coordinates,
    Mesh,
    box_centre,
    cylinder,
    extrusion,
    joined,
    point,
    surface_spread,
)
from zsp_lite.course.synthetic.textures import ANY_HUE, random_colour

# Axes.
X = (1.0, 0.0, 0.0)
Y = (0.0, 1.0, 0.0)

BODY = 0  # the material of the main part of most objects


class Draw:
    """Draws the random numbers of one object.

    With `variation`, noise from that source perturbs the proportions; the choices between parts
    stay.
    """

    def __init__(self, rng: np.random.Generator, variation: np.random.Generator | None = None):
        self.rng = rng
        self._variation = variation

    def __call__(self, low: float, high: float) -> float:
        """Draw a proportion uniformly from [low, high)."""
        value = float(self.rng.uniform(low, high))
        if self._variation is not None:
            # The standard deviation is 0.3 of the range.
            value += self._variation.normal(0, 0.3) * (high - low)
            value = float(np.clip(value, low, high))
        return value

    def chance(self, probability: float) -> bool:
        """Draw True with the given probability."""
        return bool(self.rng.random() < probability)

    def choice(self, n: int) -> int:
        """Draw uniformly from 0 .. n - 1."""
        return int(self.rng.integers(n))

    def pick(self, *options: Any) -> Any:
        """Draw one of the options."""
        return options[self.choice(len(options))]


# Meshes of one object, each with its material 0 .. 7.
Parts = Iterator[tuple[Mesh, int]]
# Builds one random object of a category.
Builder = Callable[[Draw], Parts]


def pair(mesh: Mesh, material: int = BODY, mirror: bool = True) -> Parts:
    """Build a part and, with `mirror`, its mirror image in the plane y = 0."""
    yield mesh, material
    if mirror:
        yield mesh.mirrored(), material


def make_shape(
    build: Builder, seed: int | list[int], variation: np.random.Generator | None = None
) -> TexturedMesh:
    """Return what `build` composes, centred, of unit `surface_spread`, without materials."""
    rng = np.random.default_rng(seed)
    meshes, materials = zip(*build(Draw(rng, variation)))
    vertices, faces = joined(meshes)
    material = np.repeat(materials, [len(mesh.faces) for mesh in meshes])
    # Each axis has a random scale of its own, by about 8 %.
    vertices *= np.exp(rng.normal(0, 0.08, 3))
    vertices -= box_centre(vertices)
    vertices /= surface_spread(vertices, faces)
    n = len(faces)
    uv = np.zeros((n, 3, 2), np.float32)
    white = np.ones((n, 3, 3), np.float32)
    return TexturedMesh(vertices, faces, smooth_normals(vertices, faces), uv, white, material)


def rounded_box(
    size: Coordinates, centre: Coordinates = (0, 0, 0), squareness: float = 5.0
) -> Mesh:
    """Return a superellipsoid of the given size (3,).

    Squareness 2 gives an ellipsoid, 10 nearly a box.
    """
    # The surface of the cube from -1 to 1 has a grid of n x n points on each of its sides. They are
    # denser at the edges, where the curvature is largest. `sign * u` mirrors the grid of one of two
    # opposite sides, so that both have the same order seen from outside.
    n = 11
    line = np.sin(np.linspace(-TAU / 4, TAU / 4, n))
    u, v = np.meshgrid(line, line, indexing="ij")
    sides = [np.dstack([np.full_like(u, sign), sign * u, v]) for sign in (-1.0, 1.0)]
    grids = [np.roll(side, axis, axis=2) for axis in range(3) for side in sides]
    vertices = np.reshape(grids, (-1, 3))
    # Two triangles fill each cell of a grid, counter-clockwise seen from outside; `corner` is the
    # cell's vertex of the lowest index.
    corner = np.arange(6 * n * n).reshape(6, n, n)[:, :-1, :-1].reshape(-1, 1)
    faces = np.concatenate([corner + [0, n, n + 1], corner + [0, n + 1, 1]])
    # The points move along their rays to where |x|^p + |y|^p + |z|^p = 1, p the squareness.
    vertices /= np.linalg.norm(vertices, squareness, axis=1, keepdims=True)
    return Mesh(vertices, faces).scaled(np.asarray(size) / 2).translated(centre)


def tapered(mesh: Mesh, low: float, high: float, factor: float) -> Mesh:
    """Scale the width (y) of a mesh: by 1 up to height `low`, by `factor` from height `high` on.

    If `high` is the lower one of the two, the width changes downwards.
    """
    share = np.clip((mesh.vertices[:, 2] - low) / (high - low), 0, 1)
    vertices = mesh.vertices.copy()
    vertices[:, 1] *= 1 + (factor - 1) * share
    return Mesh(vertices, mesh.faces)


def pane(start: Coordinates, end: Coordinates, width: float, thickness: float = 0.04) -> Mesh:
    """Return a slab between two points (x, z), for example a windscreen; the width is along y.

    All vectors here are (x, z), in the plane of the slab's outline.
    """
    x, z = np.subtract(end, start) / np.linalg.norm(np.subtract(end, start))
    # Half the thickness, perpendicular to the line from start to end.
    across = thickness / 2 * point(-z, x)
    return extrusion([start - across, end - across, end + across, start + across], width)


def disc(radius: float, thickness: float, centre: Coordinates) -> Mesh:
    """Return a disc at `centre` whose axis is y, for example a wheel."""
    return cylinder(radius, radius, thickness, 22).rotated("x", TAU / 4).translated(centre)


def wheels(x: float, y: float, radius: float, width: float) -> Parts:
    """Build the two wheels of an axle at x, standing on the ground at y and -y."""
    # Materials of all wheels; vehicles use the same numbers for other parts as well.
    RIM = 2
    TYRE = 3

    yield from pair(disc(radius, width, (x, y, radius)), TYRE)
    # The rim sticks out of the tyre.
    yield from pair(disc(radius * 0.6, width * 1.2, (x, y, radius)), RIM)


class _Kind(NamedTuple):
    """A kind of material; pairs are ranges to draw from."""

    share: float  # of all materials
    hue: tuple[float, float]  # degrees
    saturation: tuple[float, float]
    value: tuple[float, float]
    roughness: tuple[float, float]
    specular: float = 0.04
    # The pattern has one of these numbers of waves: 1 for stripes, 2 for checks, more for patches.
    waves: tuple[int, ...] = (5,)
    frequency: tuple[float, float] = (2, 8)  # of the pattern, in radians per unit
    contrast: tuple[float, float] = (0.05, 0.2)  # of the pattern
    two_hues: bool = False  # else the pattern's second colour is a darker shade of the first


_MUTED = (0, 0.8)  # saturation of painted and woven surfaces
_NO_EXTREMES = (0.25, 0.95)  # value: neither black nor white
# The numbers in a row, chosen by hand, are share, hue, saturation, value and roughness.
_KINDS = (
    # paint
    _Kind(0.22, ANY_HUE, _MUTED, _NO_EXTREMES, (0.35, 0.75)),
    # printed paint
    _Kind(
        0.13,
        ANY_HUE,
        _MUTED,
        _NO_EXTREMES,
        (0.35, 0.75),
        waves=(1, 2, 5),
        frequency=(3, 14),
        contrast=(0.3, 1),
        two_hues=True,
    ),
    # plastic
    _Kind(0.23, ANY_HUE, (0, 0.9), _NO_EXTREMES, (0.15, 0.4), specular=0.05),
    # wood
    _Kind(
        0.12,
        (18, 38),
        (0.3, 0.65),
        (0.4, 0.85),
        (0.4, 0.8),
        waves=(1,),
        frequency=(10, 24),
        contrast=(0.2, 0.4),
    ),
    # cloth
    _Kind(
        0.14,
        ANY_HUE,
        _MUTED,
        _NO_EXTREMES,
        (0.95, 0.95),
        specular=0.02,
        waves=(3,),
        frequency=(28, 40),
        contrast=(0.15, 0.4),
    ),
    # metal
    _Kind(0.08, (20, 60), (0, 0.3), (0.65, 0.95), (0.2, 0.55), specular=0.4),
    # rubber
    _Kind(0.08, ANY_HUE, (0, 0), (0.08, 0.3), (0.7, 0.95)),
)


def random_materials(seed: int | list[int] | np.random.Generator) -> tuple[Material, ...]:
    """Draw the materials 0 .. 7 of an object, independently of its category and of its shape."""
    rng = np.random.default_rng(seed)
    kinds = rng.choice(len(_KINDS), 8, p=[kind.share for kind in _KINDS])
    return tuple(_random_material(_KINDS[kind], rng) for kind in kinds)


def _random_material(kind: _Kind, rng: np.random.Generator) -> Material:
    """Draw a material of a kind: two sRGB colours that sine waves through the object mix."""
    colour = random_colour(rng, kind.hue, kind.saturation, kind.value)
    second = random_colour(rng, kind.hue, kind.saturation, kind.value)
    # The second colour is drawn for all kinds: without the draw, those of one hue would get other
    # random numbers from here on, and seeds other objects.
    if not kind.two_hues:
        second = 0  # black
    contrasting = colour + rng.uniform(*kind.contrast) * (second - colour)
    # The wave vectors (k, 3) have one length, the drawn frequency.
    waves = rng.normal(size=(rng.choice(kind.waves), 3))
    waves *= rng.uniform(*kind.frequency) / np.linalg.norm(waves, axis=1, keepdims=True)
    phases = rng.uniform(0, TAU, len(waves))
    warp = rng.normal(0, 2, 3)  # vector of a wave that bends all others
    sharpness = float(rng.choice([1.0, 2.0, 6.0]))  # 1 for a sine, more for clear edges

    def pattern(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        # The waves (n, k) are bent by one more wave (n, 1); their mean (n, 1) mixes the colours.
        bend = np.sin(points @ warp)[:, None]
        value = np.sin(points @ waves.T + phases + bend).mean(1, keepdims=True)
        share = np.clip(0.5 + 0.5 * sharpness * value, 0, 1)
        return (colour + share * (contrasting - colour)).astype(np.float32)

    return Material(
        colour=np.ones(4),
        pattern=pattern,
        specular=kind.specular,
        roughness=rng.uniform(*kind.roughness),
    )
