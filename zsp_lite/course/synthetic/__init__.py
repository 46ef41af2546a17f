"""Procedural objects (front +x, left +y, up +z) from primitives, rendered on the CPU, exported in
CO3D's layout."""
