"""The paper's benchmark on any folder in CO3D's layout, and what the library costs in time and memory."""
