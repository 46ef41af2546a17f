"""The paper's benchmark on any folder in CO3D's layout, on one processor or many machines (see
docs/scale.md)."""
