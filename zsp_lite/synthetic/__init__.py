"""A procedural world: objects composed of primitives, rendered on the CPU, written like CO3D.

Frame of every category: z up, the front looks along +x, the left side lies at +y.
"""
