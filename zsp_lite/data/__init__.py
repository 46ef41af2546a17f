"""Data sets in CO3D's layout: frames and cameras, pose labels, evaluation pairs, download and
check."""
