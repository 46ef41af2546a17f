"""Files, downloads, PLY point clouds, and the import of Open3D."""
