"""Render a scene file with Cycles. Runs in the Python of Blender's module `bpy`, and imports nothing of zsp_lite.

This file was written for zsp-lite and is under its licence (MIT). Blender's module is under the GPL; no part of it
is in zsp-lite.

    python blender_scene.py FOLDER SAMPLES THREADS

FOLDER/scene.npz holds the scene, see `zsp_lite.synthetic.path_tracing.write_scene`. The linear radiance of view K is
written to FOLDER/K.npy. THREADS 0 means all cores.
"""

import sys
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector


def image(name: str, pixels: np.ndarray, linear: bool):
    """Return an image of Blender, whose rows run from bottom to top."""
    height, width = pixels.shape[:2]
    made = bpy.data.images.new(name, width, height, alpha=True, float_buffer=linear)
    made.alpha_mode = "CHANNEL_PACKED"
    if not linear:
        made.colorspace_settings.name = "sRGB"
        pixels = pixels / 255
    alpha = np.ones((height, width, 4 - pixels.shape[2]))
    made.pixels.foreach_set(np.dstack([pixels, alpha])[::-1].astype(np.float32).ravel())
    made.pack()
    return made


class Nodes:
    """The nodes of a material; `add` links and sets the inputs of a new node."""

    def __init__(self, name: str):
        self.material = bpy.data.materials.new(name)
        self.material.use_nodes = True
        self.tree = self.material.node_tree
        self.tree.nodes.clear()

    def add(self, kind: str, inputs: dict, **settings):
        node = self.tree.nodes.new(kind)
        for key, value in settings.items():
            setattr(node, key, value)
        for key, value in inputs.items():
            if isinstance(value, bpy.types.NodeSocket):
                self.tree.links.new(value, node.inputs[key])
            else:
                node.inputs[key].default_value = value
        return node.outputs

    def texture(self, pixels: np.ndarray, linear: bool):
        uv = self.add("ShaderNodeUVMap", {}, uv_map="uv")["UV"]
        return self.add("ShaderNodeTexImage", {"Vector": uv}, image=image(self.material.name, pixels, linear))

    def glow(self, colour, gain: float):
        """Return a light that the camera sees in its own colour; `gain` is a factor of what it gives to the scene."""
        seen = self.add("ShaderNodeLightPath", {})["Is Camera Ray"]
        strength = self.add("ShaderNodeMath", {0: seen, 1: 1 - gain, 2: gain}, operation="MULTIPLY_ADD")[0]
        return self.add("ShaderNodeEmission", {"Color": colour, "Strength": strength})[0]

    def surface(self, shader):
        self.add("ShaderNodeOutputMaterial", {"Surface": shader})
        return self.material


def object_material(name: str, tint, opacity, specular, roughness, metallic, texture, holes):
    """Return the material of a part of the object: texture, cut-outs, glass, gloss."""
    nodes = Nodes(name)
    colour = nodes.add("ShaderNodeVertexColor", {}, layer_name="colour")["Color"]
    colour = nodes.add("ShaderNodeVectorMath", {0: colour, 1: tint}, operation="MULTIPLY")["Vector"]
    alpha = opacity
    if opacity < 1:  # glass reflects more and lets less pass at grazing angles
        fresnel = nodes.add("ShaderNodeFresnel", {"IOR": 1.45})[0]
        alpha = nodes.add("ShaderNodeMath", {0: fresnel, 1: float(opacity)}, operation="MAXIMUM")[0]
    if texture is not None:
        sample = nodes.texture(texture, linear=False)
        colour = nodes.add("ShaderNodeVectorMath", {0: colour, 1: sample["Color"]}, operation="MULTIPLY")["Vector"]
        if holes:
            cut = nodes.add("ShaderNodeMath", {0: sample["Alpha"], 1: 0.5}, operation="GREATER_THAN")[0]
            alpha = nodes.add("ShaderNodeMath", {0: cut, 1: alpha}, operation="MULTIPLY")[0]
    # Real surfaces reflect a few percent of all colours, as in the ray-casting renderer.
    scale, offset = (0.8,) * 3, (0.015,) * 3
    colour = nodes.add("ShaderNodeVectorMath", {0: colour, 1: scale, 2: offset}, operation="MULTIPLY_ADD")["Vector"]
    inputs = {"Base Color": colour, "Alpha": alpha, "Roughness": roughness, "Metallic": metallic,
              "Specular IOR Level": specular / 0.08}  # fmt: skip
    return nodes.surface(nodes.add("ShaderNodeBsdfPrincipled", inputs)["BSDF"])


def add_mesh(name: str, vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, materials: list):
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(vertices.tolist(), [], faces.tolist())
    mesh.uv_layers.new(name="uv").uv.foreach_set("vector", uv.astype(np.float32).ravel())
    for material in materials:
        mesh.materials.append(material)
    placed = bpy.data.objects.new(name, mesh)
    bpy.context.collection.objects.link(placed)
    return placed, mesh


def add_object(data) -> None:
    materials = [
        object_material(f"part{k}", data["tint"][k].tolist(), float(data["opacity"][k]), *data["surface"][k].tolist(),
                        data.get(f"texture{k}"), bool(data["holes"][k]))
        for k in range(len(data["tint"]))
    ]  # fmt: skip
    _, mesh = add_mesh("object", data["vertices"], data["faces"], data["uv"], materials)
    mesh.polygons.foreach_set("material_index", data["material"].astype(np.int32))
    colours = mesh.color_attributes.new("colour", "FLOAT_COLOR", "CORNER")
    rgba = np.concatenate([data["colours"].reshape(-1, 3), np.ones((data["colours"].size // 3, 1))], 1)
    colours.data.foreach_set("color", rgba.astype(np.float32).ravel())
    mesh.polygons.foreach_set("use_smooth", np.ones(len(mesh.polygons), bool))
    mesh.normals_split_custom_set(data["normals"].reshape(-1, 3).tolist())
    mesh.update()


def add_room(data) -> None:
    """Add the floor, and walls and ceiling, whose images are split into what reflects and what gives off light."""
    quad = np.arange(4).reshape(1, 4)
    for k, (corners, uv) in enumerate(zip(data["room_corners"], data["room_uv"], strict=True)):
        nodes = Nodes(f"room{k}")
        colour = nodes.texture(data[f"room{k}"], linear=True)["Color"]
        if k == 4:
            inputs = {"Base Color": colour, "Roughness": 0.35 if data["gloss"] else 0.9,
                      "Specular IOR Level": float(data["gloss"]) / 0.08}  # fmt: skip
            shader = nodes.add("ShaderNodeBsdfPrincipled", inputs)["BSDF"]
        else:
            bright = nodes.texture(data[f"glow{k}"], linear=True)["Color"]
            shader = nodes.add("ShaderNodeBsdfDiffuse", {"Color": colour})[0]
            shader = nodes.add("ShaderNodeAddShader", {0: shader, 1: nodes.glow(bright, float(data["gain"]))})[0]
        placed, _ = add_mesh(f"room{k}", corners, quad, uv, [nodes.surface(shader)])
        placed.visible_shadow = k == 4  # the key light stands outside the room


def add_key_light(data) -> None:
    lamp = bpy.data.lights.new("key", "SUN")
    strength = float(data["light_colour"].max())
    lamp.energy, lamp.color = np.pi * strength, (data["light_colour"] / strength).tolist()
    lamp.angle = float(2 * data["light_radius"])
    placed = bpy.data.objects.new("key", lamp)
    placed.rotation_euler = Vector(data["light"].tolist()).to_track_quat("Z", "Y").to_euler()
    bpy.context.collection.objects.link(placed)


def prepare(samples: int, threads: int, size) -> None:
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.device = "CYCLES", "CPU"
    scene.cycles.samples, scene.cycles.use_adaptive_sampling = samples, False
    scene.cycles.use_denoising, scene.cycles.denoiser = True, "OPENIMAGEDENOISE"
    scene.cycles.denoising_input_passes, scene.cycles.denoising_prefilter = "RGB_ALBEDO_NORMAL", "FAST"
    scene.cycles.denoising_quality = "BALANCED"
    scene.cycles.max_bounces, scene.cycles.transparent_max_bounces = 3, 8
    scene.cycles.sample_clamp_indirect = 4.0
    scene.cycles.caustics_reflective = scene.cycles.caustics_refractive = False
    scene.cycles.use_light_tree = False  # with six lights it only costs time
    scene.cycles.filter_width = 1.2
    scene.render.use_persistent_data = True
    if threads:
        scene.render.threads_mode, scene.render.threads = "FIXED", threads
    scene.render.resolution_x, scene.render.resolution_y = int(size[1]), int(size[0])
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    scene.world = bpy.data.worlds.new("world")
    scene.world.color = (0, 0, 0)


def main(folder: Path, samples: int, threads: int) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with np.load(folder / "scene.npz") as stored:
        data = dict(stored)
    height, width = data["size"]
    prepare(samples, threads, data["size"])
    add_object(data)
    add_room(data)
    add_key_light(data)
    lens = bpy.data.cameras.new("camera")
    camera = bpy.data.objects.new("camera", lens)
    bpy.context.collection.objects.link(camera)
    scene = bpy.context.scene
    scene.camera = camera
    lens.sensor_fit, lens.sensor_width, lens.clip_start, lens.clip_end = "HORIZONTAL", 36, 0.01, 1000
    lens.dof.use_dof = bool(data["aperture"] > 0)
    for k, (pose, focal, centre, focus) in enumerate(
        zip(data["camera_to_world"], data["focal"], data["principal_point"], data["focus"], strict=True)
    ):
        lens.lens = 36 * float(focal) / width
        lens.shift_x, lens.shift_y = (width / 2 - centre[0]) / width, (centre[1] - height / 2) / width
        lens.dof.focus_distance = float(focus)
        if lens.dof.use_dof:
            lens.dof.aperture_fstop = lens.lens / 1000 / (2 * float(data["aperture"]))  # mm to units of the scene
        camera.matrix_world = Matrix(pose.tolist())
        scene.cycles.seed = k
        scene.render.filepath = str(folder / f"{k}.exr")
        bpy.ops.render.render(write_still=True)
        written = bpy.data.images.load(scene.render.filepath)
        pixels = np.empty(width * height * 4, np.float32)
        written.pixels.foreach_get(pixels)
        np.save(folder / f"{k}.npy", pixels.reshape(height, width, 4)[::-1, :, :3])
        bpy.data.images.remove(written)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
