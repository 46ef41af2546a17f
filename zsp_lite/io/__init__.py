"""Files, downloads, and point clouds."""
