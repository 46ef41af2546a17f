"""Pictures for checking models: a contact sheet of their orientations, and an overlay of the labels."""

import base64
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from jinja2 import Environment, PackageLoader, StrictUndefined

from zsp_lite.data.cameras import Camera
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import read_labels
from zsp_lite.errors import InputError
from zsp_lite.io.files import write_atomic
from zsp_lite.synthetic.ground_truth import object_poses
from zsp_lite.synthetic.meshes import TexturedMesh
from zsp_lite.synthetic.models import MODELS_FILE, Model, list_models
from zsp_lite.synthetic.raytracing import MeshScene, Quality
from zsp_lite.synthetic.render import framed_camera, orbit_pose
from zsp_lite.synthetic.room import studio

# Azimuth and elevation in degrees; azimuth 0 is in front of the object, 90 on its left.
VIEWS = {"three-quarter": (35, 22), "front": (0, 4), "left side": (90, 4)}
AXIS_COLOURS = {"front": (213, 60, 40), "left": (20, 150, 70), "up": (30, 90, 215)}
_QUALITY = Quality(shadow_rays=2, ambient_rays=4)


def sheet_views(mesh: TexturedMesh, size: int = 200) -> list[UInt8[np.ndarray, "h w 3"]]:
    """Render a mesh from the directions of `VIEWS`, with its axes drawn into the first picture.

    Args:
        mesh: Mesh in canonical coordinates.
        size: Side of the pictures in pixels.
    """
    scene, pictures = MeshScene(mesh, studio(), _QUALITY), []
    reach = np.linalg.norm(mesh.vertices, axis=1).max()
    for azimuth, elevation in VIEWS.values():
        pose = orbit_pose(np.radians(azimuth), np.radians(elevation), 0.0, max(7.0, 2.5 * reach), np.zeros(3))
        camera = framed_camera(mesh.vertices, *pose, size, margin=1.25)
        pictures.append(scene.render(camera, 0).rgb)
        if len(pictures) == 1:
            pictures[0] = draw_frame(pictures[0], camera, np.eye(4), float(reach))
    return pictures


def draw_frame(
    image: UInt8[np.ndarray, "h w 3"], camera: Camera, pose: Float[np.ndarray, "4 4"], length: float
) -> UInt8[np.ndarray, "h w 3"]:
    """Draw the axes of an object: front in red, left in green, up in blue.

    Args:
        image: Picture to draw on; it is not changed.
        camera: Camera of the picture.
        pose: Pose of the object in the world of the camera.
        length: Length of the axes in units of the world.
    """
    image = np.ascontiguousarray(image.copy())
    tips, _ = camera.project(pose[:3, 3] + length * pose[:3, :3].T)
    start, _ = camera.project(pose[:3, 3])
    whole = lambda point: tuple(np.rint(np.clip(point, -1e4, 1e4)).astype(int).tolist())  # noqa: E731
    width = max(1, round(min(camera.size) / 110))
    for tip, colour in zip(tips, AXIS_COLOURS.values(), strict=True):
        cv2.arrowedLine(image, whole(start), whole(tip), (255, 255, 255), width + 2, cv2.LINE_AA, tipLength=0.15)
        cv2.arrowedLine(image, whole(start), whole(tip), colour, width, cv2.LINE_AA, tipLength=0.15)
    return image


def write_contact_sheet(
    folder: str | Path, path: str | Path, progress: Callable[[Iterable], Iterable] | None = None, size: int = 200
) -> dict[str, str]:
    """Write an HTML page with three pictures of every model of a folder, to check the orientations.

    Args:
        folder: Folder of models, see `zsp_lite.synthetic.models`.
        path: HTML file to write; the pictures are inside it.
        progress: Wraps the loop over models, as tqdm does.
        size: Side of the pictures in pixels.

    Returns:
        Models that cannot be used ("CATEGORY/NAME"), with the reason.
    """
    rows, unusable, models = [], {}, list_models(folder)
    for model in progress(models) if progress else models:
        key = f"{model.category}/{model.name}"
        try:
            mesh = model.read()
        except InputError as error:
            unusable[key] = str(error)
            continue
        pictures = [_data_uri(picture) for picture in sheet_views(mesh, size)]
        rows.append({"key": key, "pictures": pictures, "faces": f"{len(mesh.faces):,}", "origin": _origin(model)})
    loader = PackageLoader("zsp_lite.synthetic")
    template = Environment(loader=loader, autoescape=True, undefined=StrictUndefined).get_template("models.html")
    page = template.render(
        folder=str(folder), views=list(VIEWS), rows=rows, unusable=unusable, models_file=MODELS_FILE,
        colours={axis: f"rgb{colour}" for axis, colour in AXIS_COLOURS.items()},
    )  # fmt: skip
    write_atomic(path, page.encode(errors="replace"))
    return unusable


def label_overlay(
    dataset: Co3D, category: str, size: int = 200
) -> dict[str, tuple[UInt8[np.ndarray, "h w 3"], Float[np.ndarray, "4 4"], Camera]]:
    """Draw the axes of the reference object on every labelled sequence of a category, placed by the labels alone.

    The frame of a sequence is the one whose viewpoint is closest to the front, slightly from the left.

    Args:
        dataset: Synthetic export; the object pose of its reference sequence gives the axes.
        category: Category.
        size: Side of the pictures in pixels.

    Returns:
        Sequence name to picture, pose of the reference object in the world of that sequence, and camera of the frame.
    """
    labels, poses = read_labels(dataset.root, category), object_poses(dataset, category)
    drawn = {}
    for name, label in labels.items():
        reference = poses[label.reference_seq]
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = reference.R, reference.t
        pose = label.trans @ pose
        cameras = [dataset.camera(frame) for frame in dataset.frames(category, name)]
        wanted = pose[:3, :3] @ [np.cos(0.6), np.sin(0.6), 0.3]
        best = int(np.argmax([wanted @ _unit(camera.centre - pose[:3, 3]) for camera in cameras]))
        frame = dataset.load(dataset.frames(category, name)[best])
        length = reference.scale * float(np.abs(reference.high).max())
        picture = draw_frame(frame.rgb, frame.camera, pose, length)
        drawn[name] = _fitted(picture, size), pose, frame.camera
    return drawn


def write_label_overlay(path: str | Path, dataset: Co3D, categories: Sequence[str] | None = None) -> Path:
    """Write one picture with the overlays of `label_overlay`: a row of sequences per category.

    Raises:
        InputError: If the extension is neither .jpg nor .png.
    """
    path, rows = Path(path), []
    if path.suffix.lower() not in (".jpg", ".png"):
        raise InputError(f"picture {path} has the extension {path.suffix!r}, expected .jpg or .png")
    for category in categories or dataset.categories():
        pictures = [picture for picture, _, _ in label_overlay(dataset, category).values()]
        caption = np.full((22, 200 * len(pictures), 3), 255, np.uint8)
        cv2.putText(caption, category, (4, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
        rows.append(np.concatenate([caption, np.concatenate(pictures, 1)]))
    width = max(row.shape[1] for row in rows)
    padded = [
        cv2.copyMakeBorder(row, 0, 0, 0, width - row.shape[1], cv2.BORDER_CONSTANT, value=(255,) * 3) for row in rows
    ]
    encoded = cv2.imencode(path.suffix, np.concatenate(padded)[..., ::-1])[1]
    write_atomic(path, encoded.tobytes())
    return path


def _origin(model: Model) -> str:
    info = model.info
    return ", ".join(filter(None, (info.author, info.licence, info.source, info.changes)))


def _data_uri(picture: np.ndarray) -> str:
    encoded = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
    return "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode()


def _fitted(picture: np.ndarray, size: int) -> np.ndarray:
    """Return the middle square of a picture, `size` pixels wide."""
    side = min(picture.shape[:2])
    top, left = (picture.shape[0] - side) // 2, (picture.shape[1] - side) // 2
    return cv2.resize(picture[top : top + side, left : left + side], (size, size), interpolation=cv2.INTER_AREA)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
