"""Files, downloads, point clouds, locks, imports by name, and threads."""
