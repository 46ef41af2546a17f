"""Writes a small data set in the layout of uCO3D, made of sequences of a data folder."""

import sqlite3
from dataclasses import replace

import cv2
import h5py
import numpy as np

from zsp_lite.data.cameras import NDC_ISOTROPIC
from zsp_lite.data.labels import read_labels
from zsp_lite.importers.capture import HALF_PIXEL
from zsp_lite.io.ply import write_ply

# The columns of both tables; some of them hold paths and scores that the importer does not read.
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
STEP = 3  # Every third frame of the video has depth; in uCO3D 200 frames of a video have it.
# The distortion of a phone in OpenCV's order k1, k2, p1, p2, k3 to k6, s1 to s4. It moves pixels
# near the corners by ten pixels.
DISTORTION = np.array([-0.06, 0.004, 0.002, -0.003, 0, 0, 0, 0, 0.001, 0, -0.001, 0])
# Numbers that differ from 1, so that none can be left out unnoticed.
WORLD = 3.0  # length in uCO3D per length in the data folder
ADJUSTMENT = 0.25  # depth per stored depth
ALIGNED = 0.5  # scale of uCO3D's alignment


def blob(values, kind="<f4") -> bytes:
    """Numbers as the tables store them."""
    return np.asarray(values).astype(kind).tobytes()


def distort(image, K):
    """The image of a pinhole camera as the camera with the `DISTORTION` takes it."""
    size = image.shape[1::-1]
    maps = cv2.initInverseRectificationMap(K, DISTORTION, None, K, size, cv2.CV_32FC1)
    return cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def insert(metadata, table, **values):
    """Insert a row with values by column."""
    marks = ", ".join("?" * len(values))
    metadata.execute(
        f"INSERT INTO {table} ({', '.join(values)}) VALUES ({marks})", [*values.values()]
    )


def write_depth(path, shape, **options):
    """Write a file with one depth map of a shape, whose values are not stored."""
    with h5py.File(path, "w") as depths:
        depths.create_dataset("1", shape, np.float32, **options)


def open_metadata(root):
    """Connect with the tables."""
    return sqlite3.connect(root / "metadata.sqlite")


def write_uco3d(root, dataset, category, names):
    """Write sequences to ROOT/things/CATEGORY; the quality of the cameras rises in their order.

    The alignment of the objects is that of the labels of the data folder.
    """
    root.mkdir()
    metadata = open_metadata(root)
    metadata.execute(f"CREATE TABLE sequence_annots ({SEQUENCE_COLUMNS})")
    metadata.execute(f"CREATE TABLE frame_annots ({FRAME_COLUMNS})")
    labels = read_labels(dataset.root, category)
    for rank, name in enumerate(names):
        folder = f"things/{category}/{name}"
        (root / folder).mkdir(parents=True)
        # The label maps aligned points to the world, as column vectors: x = R a + t. uCO3D stores
        # the inverse for row vectors: a = x R - t R.
        R, t = labels[name].trans[:3, :3], labels[name].trans[:3, 3]
        insert(
            metadata,
            "sequence_annots",
            sequence_name=name,
            category=category,
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
        frames = [dataset.load(frame) for frame in dataset.frames(category, name)]
        _write_frames(root / folder, metadata, name, frames)
    metadata.commit()
    metadata.close()
    return root


def _write_frames(folder, metadata, name, frames):
    """Write the videos, the depth maps and the rows of the frames of a sequence."""
    height, width = size = frames[0].camera.size
    # Both codecs are lossless.
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
            K = camera.K - HALF_PIXEL  # OpenCV's pixel centres are integers
            has_depth = number % STEP == 0
            images = frame.rgb[..., ::-1], np.rint(255 * frame.mask).astype(np.uint8)
            for video, image in zip(videos, images):
                # The other frames are black, so that a test sees if they are read.
                seen = distort(image, K) if has_depth else np.zeros_like(image)
                video.write(np.ascontiguousarray(seen))
            view = replace(camera, t=WORLD * camera.t).to_pytorch3d(NDC_ISOTROPIC)
            del view["intrinsics_format"]
            insert(
                metadata,
                "frame_annots",
                sequence_name=name,
                frame_number=number,
                frame_timestamp=number / RATE,
                _image_size=blob(size, "<i4"),
                _depth_scale_adjustment=ADJUSTMENT if has_depth else None,
                _mask_mass=float(frame.mask.sum()),
                _viewpoint_colmap_distortion_coeffs=blob(DISTORTION),
                _viewpoint_intrinsics_format="ndc_norm_image_bounds",
                **{f"_viewpoint_{part}": blob(values) for part, values in view.items()},
            )
            if has_depth:
                depths[str(number + 1)] = _stored_depth(frame, K)
    for video in videos:
        video.release()


def _stored_depth(frame, K):
    """The depth of the undistorted image at twice its size, infinite where it is unknown."""
    size = frame.camera.size[::-1]
    straight, _ = cv2.getOptimalNewCameraMatrix(K, DISTORTION, size, 0)
    depth = cv2.warpPerspective(
        frame.depth, straight @ np.linalg.inv(K), size, flags=cv2.INTER_NEAREST
    )
    depth = np.where(depth > 0, WORLD * depth / ADJUSTMENT, np.inf).astype(np.float32)
    return depth.repeat(2, axis=0).repeat(2, axis=1)
