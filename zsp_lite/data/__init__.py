"""Data sets in CO3D's layout.

cameras: pinhole cameras, and conversion from and to PyTorch3D
depth: encoding, in-painting and unprojection of depth maps
frames: RGB-D frames with masks, crops, image files
geometry: planes through points, regions of masks
annotations: records of CO3D's annotation files
co3d: reader and writer of data sets
labels: pose labels and ground-truth poses
pairs: evaluation pairs
published: import of the labels and pairs of the published code
transfer: transfer of labels from CO3D v1 to v2
archives: download of CO3D
check: missing and broken files
photograph: a photograph with depth
"""
