"""Synthetic data: procedural objects from primitives, rendered on the CPU, exported in CO3D's layout.

Object coordinates of every category: front +x, left +y, up +z.
"""
