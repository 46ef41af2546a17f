"""Path tracing of textured meshes with Blender's Cycles, in a process of its own.

Cycles makes the colours. Depth, mask and object coordinates come from ray casting, as with the other renderer, and
`CheapCamera` develops the pictures. Blender's module `bpy` is under the GPL; `make render-env` installs it in an
environment of its own, and the two processes exchange files.
"""

import os
import subprocess
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from zsp_lite.data.cameras import Camera
from zsp_lite.errors import InputError
from zsp_lite.synthetic.meshes import TexturedMesh
from zsp_lite.synthetic.raytracing import HARD_SHADOWS, MeshScene
from zsp_lite.synthetic.render import Rendering
from zsp_lite.synthetic.room import Room, random_room
from zsp_lite.synthetic.textures import srgb_to_linear

PYTHON_VARIABLE = "ZSP_RENDER_PYTHON"  # the environment variable that names the Python with bpy
_SCRIPT = Path(__file__).with_name("blender_scene.py")
_SAMPLES = 10  # per pixel; Intel's denoiser removes the noise
_GLOW = 0.9  # radiance of a wall's image above which it is a window or sky
_APERTURE = 0.02  # radius of the lens in units of the object, per unit of `CheapCamera.defocus`


def render_python() -> str:
    """Return the Python that has `bpy`. Raises InputError if there is none."""
    path = os.environ.get(PYTHON_VARIABLE) or ".render-env/bin/python"
    if not Path(path).is_file():
        raise InputError(
            f"--engine cycles needs Blender's module, but {path} does not exist; run `make render-env`, "
            f"or let {PYTHON_VARIABLE} name a Python with bpy"
        )
    return path


def path_traced_views(mesh: TexturedMesh, cameras: Sequence[Camera], rng: np.random.Generator) -> Iterable[Rendering]:
    """Render a mesh in a random room with Cycles; a `zsp_lite.synthetic.sequences.Renderer`.

    Args:
        mesh: Mesh in canonical coordinates.
        cameras: Cameras that map from these coordinates.
        rng: Source of the room and of the noise.

    Raises:
        InputError: If Blender's module is missing or fails.
    """
    room = random_room(rng, plain=True)
    scene = MeshScene(mesh, room, HARD_SHADOWS)
    with tempfile.TemporaryDirectory(prefix="zsp-lite-") as folder:
        write_scene(Path(folder) / "scene.npz", scene, cameras)
        pictures = trace(Path(folder), len(cameras), _SAMPLES)
    gain = room.camera.exposure_gain(pictures[0])
    return [
        Rendering(
            rgb=room.camera.develop(picture, gain * np.exp(rng.normal(0, 0.025)), rng),
            camera=camera,
            **scene.geometry(camera),
        )
        for picture, camera in zip(pictures, cameras, strict=True)
    ]


def trace(folder: Path, views: int, samples: int) -> list[Float[np.ndarray, "h w 3"]]:
    """Run Blender on the scene of a folder and return the linear radiance of its views.

    Raises:
        InputError: If Blender's module is missing, fails, or is killed.
    """
    command = [render_python(), str(_SCRIPT), str(folder), str(samples), os.environ.get("OMP_NUM_THREADS") or "0"]
    done = subprocess.run(command, capture_output=True, text=True, errors="replace")
    if done.returncode or not all((folder / f"{k}.npy").is_file() for k in range(views)):
        lines = done.stderr.strip().splitlines() or ["no message"]
        raise InputError(f"Blender failed in {command[0]} with exit code {done.returncode}: {lines[-1]}")
    return [np.load(folder / f"{k}.npy") for k in range(views)]


def write_scene(path: Path, scene: MeshScene, cameras: Sequence[Camera]) -> None:
    """Write mesh, materials, room, light and cameras to an npz file for `blender_scene.py`."""
    mesh, room, light = scene.mesh, scene.room, scene.lighting
    if any(material.pattern for material in mesh.materials):
        raise InputError(f"{mesh.name} has a pattern by position, expected textures for path tracing")
    focal = np.array([camera.focal_length for camera in cameras])
    if not np.allclose(focal[:, 0], focal[:, 1]) or len({camera.size for camera in cameras}) > 1:
        raise InputError("path tracing needs cameras of one image size with square pixels")
    flip = np.diag([1.0, -1, -1, 1])  # Blender's cameras look along -z, with +y up
    poses = np.stack([np.linalg.inv(camera.matrix) @ flip for camera in cameras])
    textures = {f"texture{k}": m.texture for k, m in enumerate(mesh.materials) if m.texture is not None}
    corners, uv = _room_faces(room, scene.origin)
    bright = [image.max(-1, keepdims=True) > _GLOW for image in room.images[:-1]] + [True]  # the ceiling is a lamp
    reflecting = [np.where(on, 0, image) for on, image in zip(bright, room.images, strict=True)]
    glowing = [np.where(on, image, 0) for on, image in zip(bright, room.images, strict=True)]
    np.savez(
        path,
        vertices=mesh.vertices,
        faces=mesh.faces,
        normals=mesh.normals,
        uv=mesh.uv,
        colours=srgb_to_linear(mesh.colours),
        material=mesh.material,
        tint=np.array([srgb_to_linear(m.colour[:3]) for m in mesh.materials]),
        opacity=np.array([m.colour[3] for m in mesh.materials]),
        surface=np.array([[m.specular, m.roughness, m.metallic] for m in mesh.materials]),
        holes=np.array([m.texture is not None and m.texture[..., 3].min() < 128 for m in mesh.materials]),
        room_corners=corners,
        room_uv=uv,
        gloss=room.gloss,
        gain=light.gain,
        light=room.light,
        light_radius=room.light_radius,
        light_colour=room.light_colour,
        camera_to_world=poses,
        focal=focal[:, 0],
        principal_point=np.array([camera.principal_point for camera in cameras]),
        focus=np.array([np.linalg.norm(camera.centre) for camera in cameras]),
        size=np.array(cameras[0].size),
        aperture=_APERTURE * room.camera.defocus,
        **textures,
        **{f"room{k}": image for k, image in enumerate(reflecting)},
        **{f"glow{k}": image for k, image in enumerate(glowing)},
    )


def _room_faces(room: Room, origin: np.ndarray) -> tuple[Float[np.ndarray, "6 4 3"], Float[np.ndarray, "6 4 2"]]:
    """Return the corners of the room's faces and their texture coordinates, in the order of `Room.images`."""
    square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
    corners, uv = [], []
    for face in range(6):
        axis, side = divmod(face, 2)
        share = np.insert(square, axis, side, axis=1)  # of the extent along x, y, z
        corners.append(room.low + share * (room.high - room.low) + origin)
        # Rows run downwards on walls, along y on floor and ceiling; texture coordinates run upwards.
        uv.append(square if axis < 2 else square * [1, -1] + [0, 1])
    return np.array(corners), np.array(uv)
