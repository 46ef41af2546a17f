"""Measure how well points marked on one object are found on the others of its category.

    python -m tools.synthetic validation --sequences 4 --seed 11 --out outputs/validation
    zsp-lite align outputs/validation --category drill --pairs 2 --out outputs/aligned/drill
    python -m tools.marks outputs/validation outputs/aligned [--fit]

The folder of alignments has a run of `zsp-lite align` for each category. The figures of evaluation
are of bicycle, car, chair, motorcycle and toyplane, in the same way, of

    zsp-lite synth --category bicycle ... --sequences 4 --seed 11 --out outputs/evaluation

and those of artist-made motorcycles of `data_samples` without `--pairs`.

Marks are patches of an
object with measured depth, as many of each part. Their true places on another object are known
exactly for procedural objects: the same point of the same face of the same part, that is of the
mesh that the same lines of the builder add, by the same count. For other objects with known poses,
it is the point of the same box coordinates.

PCK@0.1 is the share of marks whose place is within 0.1 of the diagonal of the other object's box.
Marks whose part the other object does not have by this definition are counted, but not judged:
another part may do as well, as a pedestal for legs.

Pairs of objects whose pose is 30 degrees off or more count in the first figures only. --fit fits
the coefficients of the confidence to the others, and tests them on categories left out of the fit.
"""

import sys
import traceback
from argparse import ArgumentParser
from collections import Counter
from itertools import permutations
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import roc_auc_score

from tools.validation_categories import VALIDATION
from zsp_lite.align import read_hypotheses
from zsp_lite.backbones.load import load_backbone
from zsp_lite.category import synchronise
from zsp_lite.course.synthetic.assembly import BODY, Assembly
from zsp_lite.course.synthetic.categories import CATEGORIES
from zsp_lite.course.synthetic.export import SETTINGS_FILE, make_object
from zsp_lite.course.synthetic.primitives import Mesh, area_normals
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.ground_truth import ObjectPose, object_poses
from zsp_lite.io.files import read_json
from zsp_lite.metrics import SAME_ANGLE, rotation_error
from zsp_lite.transfer import SurfaceView, surface_views, transfer

BUILDERS = CATEGORIES | VALIDATION
MARKS = 100  # per ordered pair of objects
SAMPLES = 40_000  # points of a surface among which the one nearest to a mark is sought
METHODS = ("descriptors alone", "nearest surface", "with features")
Points = Float[np.ndarray, "n 3"]


class Parts:
    """The faces of a procedural object by its parts."""

    def __init__(self, category: str, index: int, seed: int):
        lines: list[tuple] = []  # of the builder and its helpers that add each mesh
        meshes: list[Mesh] = []

        def recorded(assembly: Assembly) -> None:
            add = assembly.add

            def record(mesh: Mesh, material: int = BODY, mirror: bool = False) -> None:
                lines.append(tuple(frame.lineno for frame in traceback.extract_stack()))
                add(mesh, material, mirror)

            assembly.add = record
            BUILDERS[category](assembly)
            meshes.extend(assembly.meshes)

        whole = make_object(category, index, seed, {category: recorded})
        counts: Counter[tuple] = Counter()
        self.names = []  # of the parts: their lines, and how many the same lines added before
        for line in lines:
            self.names.append((line, counts[line]))
            counts[line] += 1
        self.starts = np.cumsum([0, *(len(mesh.faces) for mesh in meshes)])  # first faces
        self.corners = whole.vertices[whole.faces]  # (faces, 3 corners, 3)

        # Random points of the surface, each a face with weights of its corners.
        rng = np.random.default_rng(0)
        areas = np.linalg.norm(area_normals(whole.vertices, whole.faces), axis=1)
        self.faces = rng.choice(len(areas), SAMPLES, p=areas / areas.sum())
        self.weights = rng.dirichlet((1, 1, 1), SAMPLES)
        self.tree = KDTree(np.einsum("nc,ncd->nd", self.weights, self.corners[self.faces]))

    def part_of(self, points: Points) -> Int[np.ndarray, " n"]:
        """Return the part that each point is on."""
        face = self.faces[self.tree.query(points)[1]]
        return np.searchsorted(self.starts, face, "right") - 1

    def places_on(self, other: "Parts", marks: Points) -> Points:
        """Return the true places of marks on another object.

        They are infinite where it has no such part, NaN where its part has other faces.
        """
        places = np.full(marks.shape, np.inf)
        samples = self.tree.query(marks)[1]
        for k, (sample, part) in enumerate(zip(samples, self.part_of(marks), strict=True)):
            if self.names[part] in other.names:
                same = other.names.index(self.names[part])
                if np.diff(self.starts)[part] == np.diff(other.starts)[same]:
                    face = self.faces[sample] - self.starts[part] + other.starts[same]
                    places[k] = self.weights[sample] @ other.corners[face]
                else:
                    places[k] = np.nan
        return places


class Box:
    """The box of any object of known pose, as its only part."""

    def __init__(self, pose: ObjectPose):
        self.low = np.array(pose.low)
        self.size = np.array(pose.high) - pose.low

    def part_of(self, points: Points) -> Int[np.ndarray, " n"]:
        """Return 0 for each point."""
        return np.zeros(len(points), int)

    def places_on(self, other: "Box", marks: Points) -> Points:
        """Return the points of the same box coordinates on another object."""
        return other.low + (marks - self.low) / self.size * other.size


def ground_truth(data: Co3D, category: str) -> dict[str, Parts] | dict[str, Box]:
    """Describe the objects of a category, by parts if they are procedural, else by boxes."""
    poses = object_poses(data, category)
    settings = data.root / SETTINGS_FILE
    if not settings.is_file():
        return {name: Box(pose) for name, pose in poses.items()}
    seed = read_json(settings, dict[str, int], "settings")["seed"]
    # The names of sequences begin with 100 + index.
    return {name: Parts(category, int(name[:3]) - 100, seed) for name in poses}


def measure(data: Co3D, category: str, run: Path) -> Float[np.ndarray, "n 7"]:
    """Transfer marks between all objects of a category.

    Returns:
        For each mark: the error of each of the `METHODS` in diagonals of the object's box, infinite
        where it has no such part; cosine, distance and confidence of the place; 1 if the pose of
        the two objects is right, else 0.
    """
    alignment = synchronise(list(read_hypotheses(run).values()))
    poses = object_poses(data, category)
    truth = ground_truth(data, category)
    backbone = load_backbone()
    surfaces = {
        name: surface_views(alignment, data, category, name, backbone) for name in alignment.objects
    }
    rng = np.random.default_rng(0)
    rows = []
    for first, second in permutations(surfaces, 2):
        source = surfaces[first]
        target = surfaces[second]
        to_world = target[0].sim3.inverse()
        # Marks: patches of all views, as many of each part, so that small parts count.
        points = np.concatenate([view.points for view in source])
        world = source[0].sim3.inverse().apply(points)
        part = truth[first].part_of(poses[first].to_object(world))
        share = 1 / np.bincount(part)[part]
        marked = rng.choice(len(points), MARKS, replace=False, p=share / share.sum())
        marks = world[marked]
        found = transfer(marks, source, target)
        surface = np.concatenate([view.points for view in target])
        nearest = KDTree(surface).query(points[marked])[1]
        alike = most_similar(source, marked, target)
        places = [to_world.apply(surface[alike]), to_world.apply(surface[nearest]), found.world]

        pose = poses[second]
        true = truth[first].places_on(truth[second], poses[first].to_object(marks))
        diagonal = np.linalg.norm(np.subtract(pose.high, pose.low))
        errors = [
            np.linalg.norm(pose.to_object(place) - true, axis=1) / diagonal for place in places
        ]
        turn = pose.R @ poses[first].R.T
        off = rotation_error(alignment.between(first, second).R, turn)
        right = np.full(MARKS, float(off < SAME_ANGLE))
        columns = [*errors, found.cosine, found.distance, found.confidence, right]
        rows.append(np.stack(columns, axis=1)[~np.isnan(true[:, 0])])
    return np.concatenate(rows)


def most_similar(
    source: list[SurfaceView], marked: Int[np.ndarray, " n"], target: list[SurfaceView]
) -> Int[np.ndarray, " n"]:
    """Return the target's patch of the most similar descriptor, for some patches of the source."""
    descriptors = torch.cat([view.descriptors for view in source])[marked]
    others = torch.cat([view.descriptors for view in target])
    return (descriptors @ others.T).argmax(dim=1).numpy()


def print_measured(name: str, table: Float[np.ndarray, "n 7"]) -> None:
    """Print the figures of a category, or of all."""
    placed = table[np.isfinite(table[:, 0])]
    print(f"{name}: {len(placed)} marks, beside {len(table) - len(placed)} without a true place")
    for method, error in zip(METHODS, placed[:, :3].T, strict=True):
        shares = f"PCK@0.1 {(error < 0.1).mean():.3f}, PCK@0.05 {(error < 0.05).mean():.3f}"
        print(f"  {method:18} {shares}, median {np.median(error):.3f}")
    right = placed[:, 2] < 0.1
    found = placed[:, 5] >= 0.5
    shares = [f"{part.mean():.3f}" for part in (found, right[found], right[~found])]
    print("  found {}; right of those found {}, of the others {}".format(*shares))
    print(f"  AUC of the confidence {roc_auc_score(right, placed[:, 5]):.3f}")


def print_fit(tables: dict[str, Float[np.ndarray, "n 7"]]) -> None:
    """Fit the confidence to all categories, and test fits that have not seen a category on it."""

    def fitted(names: list[str]) -> LogisticRegression:
        table = np.concatenate([tables[name] for name in names])
        return LogisticRegression(C=1e3).fit(table[:, 3:5], table[:, 2] < 0.1)

    whole = fitted(list(tables))
    print("CONFIDENCE:", (*whole.intercept_.round(1), *whole.coef_[0].round(1)))
    right = []
    confidence = []
    for name, table in tables.items():
        held_out = fitted([other for other in tables if other != name])
        right.append(table[:, 2] < 0.1)
        confidence.append(held_out.predict_proba(table[:, 3:5])[:, 1])
    print(f"AUC held out: {roc_auc_score(np.concatenate(right), np.concatenate(confidence)):.3f}")


def main(arguments: list[str]) -> None:
    """Measure all categories that are aligned, and print."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("aligned", type=Path)
    parser.add_argument("--fit", action="store_true")
    options = parser.parse_args(arguments)
    tables = {}
    for run in sorted(options.aligned.iterdir()):
        tables[run.name] = measure(Co3D(options.data), run.name, run)
        print_measured(run.name, tables[run.name])
    print_measured("all", np.concatenate(list(tables.values())))
    # Without marks that have no true place, too: their errors are infinite.
    posed = {
        name: table[(table[:, 6] == 1) & np.isfinite(table[:, 0])] for name, table in tables.items()
    }
    print_measured("all of right pose", np.concatenate(list(posed.values())))
    if options.fit:
        print_fit(posed)


if __name__ == "__main__":
    main(sys.argv[1:])
