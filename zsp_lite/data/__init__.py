"""Data sets in CO3D's layout.

cameras: pinhole cameras, and conversion from and to PyTorch3D
depth: encoding, in-painting and unprojection of depth maps
frames: RGB-D frames with masks, crops, image files
annotations: records of CO3D's annotation files
co3d: reader and writer of data sets
labels: pose labels and ground-truth poses
pairs: evaluation pairs
label_import: import of published labels, transfer of labels from CO3D v1 to v2
check: missing and broken files
samples: default data folders, and a photograph with depth
photograph: depth and mask of that photograph
"""
