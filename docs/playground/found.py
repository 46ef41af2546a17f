"""Write what docs/find_on_all.md loads.

    python -m docs.playground.found outputs/found docs/playground/found

The first folder keeps the rendered objects and the hypotheses of their alignment.
"""

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial import KDTree

from docs.playground.build import packed, webp
from zsp_lite import Co3D, align_category, load_backbone
from zsp_lite.backbones.named import BackboneLike
from zsp_lite.course.synthetic.export import export_categories
from zsp_lite.data.frames import Frame, mask_to_bbox, resize_frame
from zsp_lite.scans.category import CategoryAlignment
from zsp_lite.scans.transfer import VIEWS, SurfaceView, object_size, surface_views, transfer

CATEGORIES = ["chair", "toyplane"]
RENDERED = {"frames": VIEWS, "seed": 17, "image_size": 384}
OBJECTS = 8  # of each category
SIDES = 6  # from which objects are shown
PICTURE = 288  # side in pixels
# Coordinates are stored in bytes: whole multiples, 0 to 254, of this share of a picture's side.
STEP = 1 / 254
HIDDEN = 255  # coordinate of a point that a picture does not show
# A point is hidden if it is farther than this behind the surface that a picture shows, in sizes of
# the object.
_BEHIND = 0.02


@dataclass
class ShownObject:
    """An object with its pictures and its surface, which begins with the patches of the pictures:
    the points that can be marked."""

    views: list[SurfaceView]
    pictures: list[Frame]
    sides: list[int]  # the picture of each side
    starts: list[int]  # the first point of each picture, and the number of points of all pictures
    surface: Float[np.ndarray, "n 3"]  # in the object's world


def category_data(
    dataset: Co3D, category: str, alignment: CategoryAlignment, backbone: BackboneLike
) -> list[dict]:
    """Compute what the page knows of each object of a category.

    The place of a mark on another object is an index of that object's surface.
    """
    names = list(alignment.objects)
    all_views = [surface_views(alignment, dataset, category, name, backbone) for name in names]
    # The views of the first object go around it.
    around = all_views[0]
    directions = [view.direction for view in around[:: len(around) // SIDES][:SIDES]]
    shown = [
        shown_object(dataset, category, name, views, directions)
        for name, views in zip(names, all_views)
    ]
    trees = [KDTree(target.surface) for target in shown]
    data = []
    for name, source in zip(names, shown):
        marks = source.surface[: source.starts[-1]]
        places = []
        confidences = []
        for target, tree in zip(shown, trees):
            if target is source:
                places.append(np.arange(len(marks)))
                confidences.append(np.ones(len(marks)))
            else:
                found = transfer(marks, source.views, target.views)
                places.append(tree.query(found.world)[1])
                confidences.append(found.confidence)
        # A confidence of at least a half is at least 128.
        rounded_down = (256 * np.array(confidences)).clip(0, 255).astype(np.uint8)
        data.append(
            {
                "name": name,
                "pose": alignment.objects[name].sim3.matrix.tolist(),
                "pictures": [webp(frame.rgb) for frame in source.pictures],
                "sides": source.sides,
                "starts": source.starts,
                "pixels": packed(stored_pixels(source)),
                "places": packed(np.array(places, "<u2")),
                "confidences": packed(rounded_down),
            }
        )
    return data


def shown_object(
    dataset: Co3D,
    category: str,
    name: str,
    views: list[SurfaceView],
    directions: list[Float[np.ndarray, "3"]],
) -> ShownObject:
    """Show an object in those of its views that are nearest to some directions."""
    nearest = [
        int(np.argmax([view.direction @ direction for view in views])) for direction in directions
    ]
    chosen = sorted(set(nearest))
    every = {frame.name: frame for frame in map(dataset.load, dataset.frames(category, name))}
    frames = [every[views[k].name] for k in chosen]
    # The points of the shown views come first: these can be marked.
    others = sorted(set(range(len(views))) - set(chosen))
    points = [views[k].points for k in chosen + others]
    # The points of views are in the common frame; all views of an object have one `sim3`.
    return ShownObject(
        views=views,
        pictures=[square_crop(frame) for frame in frames],
        sides=[chosen.index(k) for k in nearest],
        starts=[sum(map(len, points[:k])) for k in range(len(chosen) + 1)],
        surface=views[0].sim3.inverse().apply(np.concatenate(points)),
    )


def square_crop(frame: Frame) -> Frame:
    """Crop a frame to a square around its object, inside the image, of `PICTURE` pixels."""
    top, left, height, width = mask_to_bbox(frame.mask)
    rows, columns = frame.camera.size
    side = min(max(height, width), rows, columns)
    top = min(max(top + (height - side) // 2, 0), rows - side)
    left = min(max(left + (width - side) // 2, 0), columns - side)
    inside = np.s_[top : top + side, left : left + side]
    cropped = Frame(
        frame.rgb[inside],
        frame.depth[inside],
        frame.mask[inside],
        frame.camera.crop((top, left, side, side)),
    )
    return resize_frame(cropped, (PICTURE, PICTURE))


def stored_pixels(shown: ShownObject) -> UInt8[np.ndarray, "n pictures 2"]:
    """Project the surface into all pictures; `HIDDEN` where a picture does not show a point."""
    # From the common frame to the object's world.
    behind = _BEHIND * object_size(shown.views) / shown.views[0].sim3.scale
    projected = []
    for frame in shown.pictures:
        pixels, depth = frame.camera.project(shown.surface)
        inside = ((pixels >= 0) & (pixels < PICTURE)).all(axis=1)
        # The farthest depth next to a pixel, so that a point at an edge is not hidden by rounding.
        farthest = cv2.dilate(frame.depth, np.ones((3, 3), np.uint8))
        column, row = np.where(inside[:, None], pixels, 0).astype(int).T
        seen = inside & (depth < farthest[row, column] + behind)
        steps = np.round(pixels / PICTURE / STEP)
        projected.append(np.where(seen[:, None], steps, HIDDEN).astype(np.uint8))
    return np.stack(projected, axis=1)


def main(work: Path, folder: Path) -> None:
    """Render and align the objects, and write a script for each category."""
    export_categories(CATEGORIES, work / "data", OBJECTS, **RENDERED)
    dataset = Co3D(work / "data")
    backbone = load_backbone("zsp-tiny", "cpu")
    folder.mkdir(parents=True, exist_ok=True)
    for category in CATEGORIES:
        alignment = align_category(dataset, category, backbone, out=work / category)
        data = category_data(dataset, category, alignment, backbone)
        text = json.dumps(data, separators=(",", ":"))
        (folder / f"{category}.js").write_text(f"FOUND.{category} = {text};\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
