"""A small uCO3D, made from sequences of a data folder in the layout of the published one."""

import functools
import sqlite3
from dataclasses import replace

import cv2
import h5py
import numpy as np

from zsp_lite.data.cameras import NDC_ISOTROPIC
from zsp_lite.data.labels import read_labels
from zsp_lite.importers.capture import HALF_PIXEL
from zsp_lite.io.ply import write_ply

# The columns of both tables, those of paths and scores that the importer does not read included
SEQUENCE_COLUMNS = """sequence_name VARCHAR, category VARCHAR, super_category VARCHAR,
_video_path VARCHAR, _mask_video_path VARCHAR, _depth_video_path VARCHAR,
_segmented_point_cloud_path VARCHAR, _reconstruction_quality_viewpoint FLOAT,
_caption_text VARCHAR, _alignment_R BLOB, _alignment_T BLOB, _alignment_scale FLOAT,
PRIMARY KEY (sequence_name)"""
FRAME_COLUMNS = """sequence_name VARCHAR, frame_number INTEGER, frame_timestamp FLOAT,
_image_path VARCHAR, _image_size BLOB, _depth_scale_adjustment FLOAT, _mask_mass FLOAT,
_mask_bounding_box_xywh BLOB, _viewpoint_R BLOB, _viewpoint_T BLOB,
_viewpoint_focal_length BLOB, _viewpoint_principal_point BLOB,
_viewpoint_colmap_distortion_coeffs BLOB, _viewpoint_intrinsics_format VARCHAR,
PRIMARY KEY (sequence_name, frame_number)"""
RATE = 10.0  # frames of the videos per second
STEP = 3  # every third frame has depth, as 200 frames of a video of uCO3D
# k1, k2, p1, p2, k3 to k6, s1 to s4; of a phone, which moves pixels near the corners by ten
DISTORTION = np.array([-0.06, 0.004, 0.002, -0.003, 0, 0, 0, 0, 0.001, 0, -0.001, 0])
WORLD = 3.0  # uCO3D's lengths per length of the data folder
ADJUSTMENT = 0.25  # depth per stored depth
ALIGNED = 0.5  # scale of uCO3D's alignment


def blob(values, kind="<f4") -> bytes:
    return np.asarray(values).astype(kind).tobytes()


@functools.cache
def distortion_maps(size, K):
    """For each pixel that a camera with the `DISTORTION` takes, the pixel of a pinhole camera."""
    K = np.reshape(K, (3, 3))
    rows, columns = np.indices(size, dtype=np.float64)
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 1, 2)
    precisely = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-9)
    straight = cv2.undistortPoints(pixels, K, DISTORTION, R=None, P=K, criteria=precisely)
    return straight.reshape(*size, 2).astype(np.float32)


def distort(image, K):
    maps = distortion_maps(image.shape[:2], tuple(K.ravel()))
    return cv2.remap(image, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def insert(metadata, table, **values):
    places = ", ".join("?" * len(values))
    metadata.execute(
        f"INSERT INTO {table} ({', '.join(values)}) VALUES ({places})", [*values.values()]
    )


def open_metadata(root):
    return sqlite3.connect(root / "metadata.sqlite")


def write_uco3d(root, dataset, category, names):
    """Write sequences to ROOT/things/CATEGORY; later ones have the better cameras.

    The objects are aligned as the labels of the data folder say.
    """
    root.mkdir()
    metadata = open_metadata(root)
    metadata.execute(f"CREATE TABLE sequence_annots ({SEQUENCE_COLUMNS})")
    metadata.execute(f"CREATE TABLE frame_annots ({FRAME_COLUMNS})")
    labels = read_labels(dataset.root, category)
    for rank, name in enumerate(names):
        folder = f"things/{category}/{name}"
        (root / folder).mkdir(parents=True)
        # Of column vectors, x = label @ aligned; so for rows, aligned = x @ R + T.
        R, t = labels[name].trans[:3, :3], labels[name].trans[:3, 3]
        insert(
            metadata,
            "sequence_annots",
            sequence_name=name,
            category=category,
            super_category="things",
            _video_path=f"{folder}/rgb_video.mp4",
            _mask_video_path=f"{folder}/mask_video.mkv",
            _depth_video_path=f"{folder}/depth_maps.h5",
            _segmented_point_cloud_path=f"{folder}/segmented_point_cloud.ply",
            _reconstruction_quality_viewpoint=float(rank),
            _alignment_R=blob(R),
            _alignment_T=blob(-WORLD * t @ R),
            _alignment_scale=ALIGNED,
        )
        points, colours = dataset.point_cloud(category, name)
        write_ply(root / folder / "segmented_point_cloud.ply", WORLD * points, colours)
        frames = [dataset.load(one) for one in dataset.frames(category, name)]
        _write_frames(root / folder, metadata, name, frames)
    metadata.commit()
    metadata.close()
    return root


def _write_frames(folder, metadata, name, frames):
    """Write the videos, the depth maps and the rows of the frames of a sequence."""
    height, width = size = frames[0].camera.size
    videos = [
        cv2.VideoWriter(
            str(folder / file),
            cv2.CAP_FFMPEG,
            cv2.VideoWriter_fourcc(*codec),
            RATE,
            (width, height),
            [cv2.VIDEOWRITER_PROP_IS_COLOR, colours],
        )
        for file, codec, colours in (("rgb_video.mp4", "png ", 1), ("mask_video.mkv", "FFV1", 0))
    ]
    with h5py.File(folder / "depth_maps.h5", "w") as depths:
        for number in range(STEP * len(frames)):
            frame = frames[number // STEP]
            camera = frame.camera
            K = camera.K - HALF_PIXEL
            sharp = number % STEP == 0  # the others are black
            rgb = frame.rgb if sharp else np.zeros_like(frame.rgb)
            mask = frame.mask if sharp else np.zeros_like(frame.mask)
            videos[0].write(np.ascontiguousarray(distort(rgb, K)[..., ::-1]))
            videos[1].write(np.rint(255 * distort(mask, K)).astype(np.uint8))
            view = replace(camera, t=WORLD * camera.t).to_pytorch3d(NDC_ISOTROPIC)
            insert(
                metadata,
                "frame_annots",
                sequence_name=name,
                frame_number=number,
                frame_timestamp=number / RATE,
                _image_size=blob(size, "<i4"),
                _depth_scale_adjustment=ADJUSTMENT if sharp else None,
                _mask_mass=float(frame.mask.sum()),
                _viewpoint_R=blob(view["R"]),
                _viewpoint_T=blob(view["T"]),
                _viewpoint_focal_length=blob(view["focal_length"]),
                _viewpoint_principal_point=blob(view["principal_point"]),
                _viewpoint_colmap_distortion_coeffs=blob(DISTORTION),
                _viewpoint_intrinsics_format="ndc_norm_image_bounds",
            )
            if sharp:
                depths[str(number + 1)] = _stored_depth(frame, K)
    for video in videos:
        video.release()


def _stored_depth(frame, K):
    """The depth in the view of the undistorted image, of twice its size, infinite where unknown."""
    size = frame.camera.size[::-1]
    straight, _ = cv2.getOptimalNewCameraMatrix(K, DISTORTION, size, 0)
    depth = cv2.warpPerspective(
        frame.depth, straight @ np.linalg.inv(K), size, flags=cv2.INTER_NEAREST
    )
    depth = np.where(depth > 0, WORLD * depth / ADJUSTMENT, np.inf).astype(np.float32)
    return depth.repeat(2, axis=0).repeat(2, axis=1)
